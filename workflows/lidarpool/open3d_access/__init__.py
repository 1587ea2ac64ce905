"""Access to Open3D without its viewers, and to its nearest neighbor search."""
