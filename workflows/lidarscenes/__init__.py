"""Kinds of scenes that lidarsim lacks: files, robots, procedural worlds, HELIOS++ surveys."""
