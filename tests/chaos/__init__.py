"""Faults on purpose: a nemesis, what it is done to, and a checker that judges the outcome."""
