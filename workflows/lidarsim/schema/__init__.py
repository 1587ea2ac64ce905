"""Names, limits and error messages for settings in scenario files and function calls."""
