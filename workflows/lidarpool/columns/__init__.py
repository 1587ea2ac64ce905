"""Parts, the files that store points during a run, and clouds that are read from them."""
