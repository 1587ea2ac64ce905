"""Write data sets of many jobs with their job tables, and read them for training."""
