"""Distribution version, which is read by the build and by the version check on workers.

`raybeam/_version.py` and `poolpart/_version.py` have the same version, because each of these
packages is also a distribution of its own.
"""

__version__ = "0.3.0"
