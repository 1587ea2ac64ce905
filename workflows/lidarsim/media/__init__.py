"""Materials, leaves and weather, which determine how light is scattered."""
