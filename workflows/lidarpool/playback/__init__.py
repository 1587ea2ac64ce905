"""Play back sweeps in real time over sensor protocols and to viewers."""
