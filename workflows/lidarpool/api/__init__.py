"""Python interface to simulations and their results."""
