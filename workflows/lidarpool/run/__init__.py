"""Runs: checks before a run, stored runs, resuming, progress."""
