"""Point cloud formats, each of which has a module that writes and reads it."""
