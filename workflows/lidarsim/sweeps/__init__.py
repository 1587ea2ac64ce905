"""Times, poses and instruments of a survey's sweeps."""
