"""Show sweeps in Foxglove or Rerun while they are being simulated."""
