"""The Python interface: `simulate`, and its result."""
