"""Runs: one way from jobs to results, on a cluster, that can be resumed."""
