"""What light meets: materials of surfaces, leaves, weather."""
