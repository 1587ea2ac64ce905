"""Runs, which process jobs on a cluster and can be resumed."""
