"""Occupancy grids of sweeps, in the layouts of Occ3D-nuScenes and SemanticKITTI."""
