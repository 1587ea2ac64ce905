"""Play back sweeps in real time, using sensor protocols or viewers."""
