"""Point columns, sweeps, and in-memory point clouds."""
