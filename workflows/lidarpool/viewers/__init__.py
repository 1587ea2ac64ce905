"""Show sweeps in third-party viewers while they are simulated: Foxglove and Rerun."""
