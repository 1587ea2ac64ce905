"""Runs: simulate, checks before a run, what is kept, resume, progress."""
