"""Open3D, imported without its viewers, and its neighbor search."""
