"""Actors of a scenario, and how they move."""
