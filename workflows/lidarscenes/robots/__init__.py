"""Robots of URDF files, whose joints move."""
