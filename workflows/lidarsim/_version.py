"""The version of the distribution, read by the build and by the version check of workers."""

__version__ = "0.3.0.dev0"
