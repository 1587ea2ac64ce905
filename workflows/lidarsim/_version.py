"""The version of the distribution, read by the build and by the version check of workers."""

__version__ = "0.2.0.dev0"
