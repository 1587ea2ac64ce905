"""Public classes for plug-ins that read or write point clouds.

See docs/how-to/plugins.md for an example. The names are those of `lidarfiles.plugins`.
"""

from lidarfiles import plugins
from lidarfiles.plugins import *  # noqa: F403

__all__ = plugins.__all__
