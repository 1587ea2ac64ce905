"""Read OpenDRIVE roads with reference lines, lanes, road marks, objects, and signals."""
