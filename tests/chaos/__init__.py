"""Fault injection: a nemesis injects faults into clusters, and a checker judges the results."""
