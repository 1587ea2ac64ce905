"""Point cloud formats, each of which is written and read by its own module."""
