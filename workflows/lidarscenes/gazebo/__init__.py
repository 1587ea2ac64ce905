"""Worlds and models of Gazebo, in SDFormat."""
