"""Readers of mesh and point cloud files."""
