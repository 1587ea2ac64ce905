"""Convert sensors from other programs to ray lists and scenarios."""
