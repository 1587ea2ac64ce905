"""Read robots from URDF files, and move their joints."""
