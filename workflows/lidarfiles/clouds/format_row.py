"""Description of a cloud format that is available without importing its class."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from lidarsim.environment.extras import require_package
from lidarsim.environment.plugins import Plugin


@dataclass(frozen=True)
class FormatRow:
    """Files, required packages and class of a cloud format.

    Parameters
    ----------
    file
        Name of the file or folder in the output folder of a result. Its extension selects the
        format. Empty for formats that can only be read.
    location
        Class of the format as ``module:class``. Not needed for plug-ins.
    suffixes
        Extensions of the files that the format opens, in lower case and with a dot.
    folders
        Glob patterns. The format opens a folder that contains a match for any of them.
    packages
        Import names of the packages that are required to write and read the format.
    extra
        Extra of lidarpool that installs the packages.
    plugin
        The plug-in that provides the format, which is set when the plug-in is loaded.
    """

    file: str
    location: str = ""
    suffixes: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    extra: str = ""
    plugin: Plugin | None = field(default=None, compare=False)

    @property
    def missing_packages(self) -> list[str]:
        """Required packages that are not installed."""
        return [package for package in self.packages if find_spec(package) is None]

    def load(self, reading: str = "") -> type[Any]:
        """Import the class of the format.

        If `reading` is the name of a file to read, raises LidarError unless the required packages
        are installed.
        """
        for package in self.packages if reading else ():
            require_package(package, self.extra, f"Reading {reading}")
        if self.plugin is not None:
            return self.plugin.load(type)
        module, _, name = self.location.partition(":")
        cloud_format: type[Any] = getattr(import_module(module), name)
        return cloud_format
