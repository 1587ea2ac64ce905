"""Steps: each is an effect on pulses, in a separate module with its loops beside it."""
