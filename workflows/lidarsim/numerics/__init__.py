"""Bit-identical vector and elementary functions on every processor, and random numbers."""
