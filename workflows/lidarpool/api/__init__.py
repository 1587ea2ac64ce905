"""What Python programs use: `simulate`, and the result with all that can be made of it."""
