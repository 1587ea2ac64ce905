"""The simulation steps, with one module per effect.

The compiled loops of a step are in a separate module in this folder.
"""
