"""Generated scenes: cities, terrain with forests, cars."""
