"""Errors, interrupts and words: what every room uses."""
