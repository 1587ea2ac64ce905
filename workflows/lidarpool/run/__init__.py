"""Runs that process jobs on a cluster and can be resumed."""
