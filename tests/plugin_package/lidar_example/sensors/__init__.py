"""Data files of sensors: a folder for each maker."""
