"""Columns of points, and clouds in memory."""
