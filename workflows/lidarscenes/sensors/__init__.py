"""Sensors of other programs as lists of rays, and as scenarios."""
