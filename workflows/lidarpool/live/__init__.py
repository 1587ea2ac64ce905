"""Runs and results in the browser, only on this machine and without the internet."""
