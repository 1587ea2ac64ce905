"""Runs and results in the browser, on this machine alone and without the internet."""
