"""Version of the package, which the build backend reads from this file."""

__version__ = "0.3.0"
