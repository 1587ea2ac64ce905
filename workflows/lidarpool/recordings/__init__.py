"""Clouds and recordings of lidarpool and of other programs, read sweep by sweep."""
