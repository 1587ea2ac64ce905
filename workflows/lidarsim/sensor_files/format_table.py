"""The table of files of sensors: the module of each format, its endings, and what it holds.

It is quick to import: help of the command reads it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.errors import LidarError
from ..base.extras import need
from ..base.words import did_you_mean

if TYPE_CHECKING:
    from .fired_rays import FiredRays

# What a format may hold of a sensor besides directions. {name: words for what it does not hold}
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
}


@dataclass(frozen=True)
class SensorFormat:
    """A format of files of sensors.

    Parameters
    ----------
    name
        Name of the format, as in ``--as``.
    endings
        Endings of its files, such as ``.csv``.
    module
        Dotted name of the module of the format. `write(path, rays, left_out)` there writes rays,
        and returns all that the file does not hold of the sensor, a clause each, `left_out` by
        `PROPERTIES` first; `read(path)` returns `FiredRays`, or None for a file of
        another format. If the format `describes`, it is
        `write(path, sensor, duration_s, left_out)`, for a duration of the pattern in seconds.
    words
        Description in a few words.
    holds
        Names in `PROPERTIES` of what the format holds.
    by_ending
        Whether the ending alone chooses the format; else ``--as`` does.
    reads
        Whether there is a function `read`.
    describes
        Whether the file describes the sensor's optics, and does not list its rays.
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
        """Import the module and return its function of a name.

        Raises LidarError if a package that the module needs is not installed.
        """
        for package in self.packages:
            need(package, self.extra, f"The sensor format {self.name}")
        return getattr(import_module(self.module), name)


def _row(
    name: str, endings: str, words: str, holds: Sequence[str] = (), **options: Any
) -> SensorFormat:
    """Return a row of the table whose module stands beside this module."""
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
    SensorFormat(  # its module needs the sensor, which stands above this package
        "helios",
        (".xml",),
        "lidarsim.sensor.helios_scanner",
        "a HELIOS++ scanner",
        frozenset(PROPERTIES) - {"returns"},
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
    """Return the format of a file that is to be written, by its name or by the ending.

    Raises
    ------
    LidarError
        If there is no such format, or the file has another ending than the format.
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
    """Return a sentence on the formats of an ending, or on all endings."""
    names = [row.name for row in FORMATS if ending in row.endings]
    if names:
        return f"Select a format with {' or '.join(f'--as {name}' for name in names)}."
    endings = dict.fromkeys(ending for row in FORMATS for ending in row.endings)
    return (
        f"The supported extensions are {', '.join(endings)}, and .png for a picture of the beams."
    )


def read_rays(path: Path) -> FiredRays | None:
    """Return the rays of a file by its ending, or None for the ending of an unread format.

    Raises
    ------
    ValueError
        If the file has none of the formats of its ending.
    LidarError
        If a package is missing, or the file is larger than the memory.
    OSError
        If the file cannot be read.
    """
    rows = [row for row in FORMATS if row.reads and path.suffix.lower() in row.endings]
    for row in rows:
        rays: FiredRays | None = row.function("read")(path)
        if rays is not None:
            return rays
    return None
