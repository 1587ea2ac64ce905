"""The version of the distribution, which the build reads."""

__version__ = "0.3.0"
