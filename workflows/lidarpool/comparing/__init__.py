"""Comparison of two clouds or recordings of the same place, and its report."""
