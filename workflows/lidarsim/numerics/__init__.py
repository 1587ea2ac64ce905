"""Random numbers, vector operations and functions that are bit-identical on every processor."""
