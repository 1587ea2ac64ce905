"""Play: sweeps leave at their own time, over the protocols of sensors and messages of viewers."""
