"""Evaluation of mounting positions of lidars on a vehicle."""
