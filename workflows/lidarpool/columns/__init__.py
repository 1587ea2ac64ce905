"""The points of a cloud and their columns."""
