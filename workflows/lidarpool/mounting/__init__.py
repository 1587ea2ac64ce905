"""Evaluation of the mounting positions of lidars on a vehicle."""
