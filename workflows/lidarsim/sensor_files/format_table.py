"""Table of the sensor file formats, with their modules, extensions and supported properties.

This module must be quick to import, because command-line help reads it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..environment.extras import require_package
from ..errors import LidarError
from ..words import did_you_mean

if TYPE_CHECKING:
    from .fired_rays import RayList

# Properties other than directions that a format can store, as {name: phrase for a missing
# property}.
PROPERTIES = {
    "times": "times of the rays",
    "channels": "channels",
    "origins": "ray origins outside the sensor's center",
    "min_range": "minimum range",
    "max_range": "maximum range",
    "rate": "frame rate",
    "divergence": "beam divergence",
    "returns": "returns per pulse",
    "noise": "noise",
    "blocked": "directions that the platform blocks",
}


@dataclass(frozen=True)
class SensorFormat:
    """A sensor file format.

    Parameters
    ----------
    name
        Name of the format, as used with ``--as``.
    endings
        File name extensions, such as ``.csv``.
    module
        Dotted name of the module that implements the format. Its function
        `write(path, rays, left_out)` writes rays and returns phrases for everything that the file
        does not store, starting with `left_out`, which come from `PROPERTIES`. Its function
        `read(path)` returns `RayList`, or None if the file has another format. If `describes` is
        set, the function is `write(path, sensor, duration_s, left_out)` instead, which writes a
        pattern that lasts `duration_s` seconds.
    words
        Short description.
    holds
        Names in `PROPERTIES` that the format stores.
    by_ending
        Whether the extension alone selects the format. Otherwise ``--as`` is required.
    reads
        Whether the module has a function `read`.
    describes
        Whether the file describes the sensor's optics instead of listing its rays.
    packages, extra
        Import packages that the module needs, and the extra that installs them.
    """

    name: str
    endings: tuple[str, ...]
    module: str
    words: str
    holds: frozenset[str] = frozenset()
    by_ending: bool = False
    reads: bool = True
    describes: bool = False
    packages: tuple[str, ...] = ()
    extra: str = ""

    def function(self, name: str) -> Any:
        """Import the module and return one of its functions.

        Raises LidarError if a package that the module needs is not installed.
        """
        for package in self.packages:
            require_package(package, self.extra, f"The sensor format {self.name}")
        return getattr(import_module(self.module), name)


def _row(
    name: str, endings: str, words: str, holds: Sequence[str] = (), **options: Any
) -> SensorFormat:
    module = options.pop("module", name)
    return SensorFormat(
        name,
        tuple(endings.split()),
        f"{__package__}.{module}",
        words,
        frozenset(holds),
        **options,
    )


_COLUMNS = ("times", "channels", "origins", "min_range", "max_range", "rate")

FORMATS: tuple[SensorFormat, ...] = (
    _row(
        "mujoco",
        ".npz .py",
        "angles for MuJoCo-LiDAR",
        ("times", "min_range", "max_range", "rate"),
        module="mujoco_rays",
    ),
    _row("mjcf", ".xml", "MuJoCo rangefinders", ("origins", "max_range"), reads=False),
    _row(
        "sdf",
        ".sdf",
        "Gazebo gpu_lidar",
        ("channels", "min_range", "max_range", "rate"),
        by_ending=True,
        reads=False,
    ),
    _row(
        "warp",
        ".py",
        "a Python file with arrays for Isaac Lab, mjlab and Genesis",
        ("times", "origins", "min_range", "max_range", "rate"),
        module="warp_module",
        by_ending=True,
        reads=False,
    ),
    _row(
        "rgl",
        ".npz",
        "RobotecGPULidar",
        ("times", "channels", "origins", "min_range", "max_range", "rate"),
    ),
    _row(
        "omnilidar",
        ".usda",
        "Isaac Sim OmniLidar",
        ("times", "channels", "min_range", "max_range", "rate"),
        by_ending=True,
        reads=False,
    ),
    SensorFormat(  # in another package, because its module needs the sensor classes
        "helios",
        (".xml",),
        "lidarsim.sensor.helios_scanner",
        "a HELIOS++ scanner",
        frozenset(PROPERTIES) - {"returns", "blocked"},
        reads=False,
        describes=True,
    ),
    _row("npz", ".npz", "NumPy arrays", _COLUMNS, module="ray_npz", by_ending=True),
    _row("livox", ".csv", "scan_mode of the Livox plug-in for Gazebo", ("times",)),
    _row("csv", ".csv", "a table of rays", _COLUMNS, module="ray_csv", by_ending=True),
    _row(
        "parquet",
        ".parquet",
        "a table of rays",
        _COLUMNS,
        module="ray_parquet",
        by_ending=True,
        packages=("pyarrow",),
        extra="parquet",
    ),
)


_BY_NAME = {row.name: row for row in FORMATS}


def format_of(path: Path, name: str | None) -> SensorFormat:
    """Return the format for writing a file, selected by name or by file extension.

    Raises
    ------
    LidarError
        If there is no such format, or the extension does not match it.
    """
    ending = path.suffix.lower()
    if name is not None and name not in _BY_NAME:
        names = ", ".join(_BY_NAME)
        raise LidarError(
            f"Unknown sensor format {name!r}.{did_you_mean(name, [*_BY_NAME])} The formats are "
            f"{names}."
        )
    if name is None:
        row = next((row for row in FORMATS if row.by_ending and ending in row.endings), None)
        if row is None:
            raise LidarError(f"The extension of {path} is not a sensor format. {_choices(ending)}")
        return row
    row = _BY_NAME[name]
    if ending not in row.endings:
        expected = " or ".join(row.endings)
        raise LidarError(f"{path} must end in {expected} for the format {name}.")
    return row


def _choices(ending: str) -> str:
    """Return advice that lists the formats for a file extension, or else all extensions."""
    names = [row.name for row in FORMATS if ending in row.endings]
    if names:
        return f"Select a format with {' or '.join(f'--as {name}' for name in names)}."
    endings = dict.fromkeys(ending for row in FORMATS for ending in row.endings)
    return (
        f"The supported extensions are {', '.join(endings)}, and .png for a picture of the beams."
    )


def read_rays(path: Path) -> RayList | None:
    """Read the rays in a file. Return None if the file has no readable format.

    Raises
    ------
    ValueError
        If the content of the file is invalid.
    LidarError
        If a package is missing, or the file exceeds the memory limit.
    OSError
        If the file cannot be read.
    """
    rows = [row for row in FORMATS if row.reads and path.suffix.lower() in row.endings]
    for row in rows:
        rays: RayList | None = row.function("read")(path)
        if rays is not None:
            return rays
    return None
