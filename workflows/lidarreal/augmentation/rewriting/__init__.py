"""Write augmented sweeps back to a copy of their recording, in the format of the recording."""
