"""Formats of clouds: a module writes and reads each."""
