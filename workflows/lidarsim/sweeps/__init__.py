"""Times, poses and instruments of the sweeps in a survey, which complement its points."""
