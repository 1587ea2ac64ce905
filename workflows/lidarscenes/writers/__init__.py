"""Scenes as mesh files."""
