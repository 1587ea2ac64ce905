"""The version of the distribution, which its build reads."""

__version__ = "0.3.0"
