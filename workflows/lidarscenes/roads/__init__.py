"""Read OpenDRIVE roads with their reference lines, lanes, road marks, objects, and signals."""
