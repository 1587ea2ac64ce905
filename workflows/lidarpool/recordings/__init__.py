"""Reading of clouds and recordings in any supported format, sweep by sweep."""
