"""Storage of points: parts, and clouds that are read from parts."""
