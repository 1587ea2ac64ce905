"""Data sets of many jobs: writing, their table of jobs, and reading them again."""
