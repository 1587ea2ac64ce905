"""Open3D without its viewers, and nearest neighbor search based on Open3D."""
