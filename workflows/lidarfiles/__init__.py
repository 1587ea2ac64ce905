"""Files of lidars: point clouds, recordings, data sets, and resumable work on them."""
