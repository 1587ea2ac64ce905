"""Data sets of many jobs: writing them, their job tables, and reading them for training."""
