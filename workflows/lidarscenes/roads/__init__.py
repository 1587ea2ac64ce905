"""Read OpenDRIVE roads: reference lines, lanes, road marks, objects, and signals."""
