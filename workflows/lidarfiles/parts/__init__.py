"""Parts, which store the points of a run in files, and clouds that are read from parts."""
