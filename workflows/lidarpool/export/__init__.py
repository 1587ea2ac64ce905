"""Clouds in file formats."""
