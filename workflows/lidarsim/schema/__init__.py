"""Names, limits and error messages of the settings in scenario files and function calls."""
