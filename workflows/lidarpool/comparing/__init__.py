"""Comparison of two clouds or recordings of one place, and its page."""
