"""Surveys of other programs as scenarios."""
