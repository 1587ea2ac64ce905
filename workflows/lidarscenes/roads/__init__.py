"""Roads of OpenDRIVE as meshes: reference lines, lanes, road marks, objects and signals."""
