"""Network services of sensors, as their manufacturers document them."""
