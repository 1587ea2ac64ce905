"""Kinds of scenes beside those of lidarsim: files, robots, procedural worlds, HELIOS++ surveys."""
