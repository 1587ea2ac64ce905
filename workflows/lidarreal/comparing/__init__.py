"""Compare two clouds or recordings of the same scene, and report the differences."""
