"""Write data sets that consist of many jobs, and read them for training."""
