"""Viewers of other makers that show sweeps while these are made: Foxglove and Rerun."""
