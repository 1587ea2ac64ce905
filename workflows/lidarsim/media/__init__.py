"""Materials of surfaces, leaves and weather, which determine how light is scattered."""
