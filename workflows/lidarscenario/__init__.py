"""Scenario and campaign files, and the jobs that are created from these files."""
