"""Files with the rays of sensors, for other programs and from other programs."""
