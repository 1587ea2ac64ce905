"""Files called parts, which store points during a run, and point clouds that are read from them."""
