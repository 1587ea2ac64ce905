"""Parts, which are files that store points during a run, and point clouds read from parts."""
