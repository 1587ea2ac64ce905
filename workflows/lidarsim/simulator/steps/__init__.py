"""Steps: each is an effect on pulses, in a module of its own with its loops beside it."""
