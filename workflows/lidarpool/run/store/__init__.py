"""Stores of runs, which contain the database, the parts and the jobs in flight."""
