"""Errors, interrupts and words for all rooms."""
