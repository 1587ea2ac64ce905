"""Convert sensors of other programs to ray lists and scenarios."""
