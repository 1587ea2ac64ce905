"""Times, poses and instruments of the sweeps of a survey, beside its points."""
