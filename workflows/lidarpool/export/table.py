"""The table of formats that clouds are written in: one row a format.

It is quick to import: help and completion of the command read it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class FormatRow:
    """What a format is.

    Parameters
    ----------
    file
        Its file, or its folder, in the folder of a result. An ending chooses the format.
    module
        Module of this room that writes it: by `write_NAME(path, cloud, sweeps)`, or by `Pieces`.
    in_pieces
        Whether it has many files, which workers can write: `Pieces` says which.
    needs
        Columns that a cloud must have. Formats that need `scan` store single sweeps.
    holds
        Columns that it can hold; None for all.
    layouts
        {layout: the columns that it needs and holds beside those}, where there are layouts.
    packages
        What writes it; the extra of lidarpool that installs them has the name of the module.
    """

    file: str
    module: str
    in_pieces: bool = False
    needs: tuple[str, ...] = ()
    holds: tuple[str, ...] | None = None
    layouts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    packages: tuple[str, ...] = ()


# Layouts of points in bags; `velodyne` is the default of all formats.
LAYOUTS = {
    "velodyne": ("intensity", "time"),
    "autoware": ("intensity", "time", "azimuth", "elevation", "range"),
    "ouster": ("intensity", "time", "reflectivity", "range"),
}


def _bag(file: str) -> FormatRow:
    needs, packages = ("scan", "object", "channel"), ("rosbags",)
    return FormatRow(file, "ros", False, needs, ("channel",), LAYOUTS, packages)


FORMATS = {
    "ply": FormatRow("cloud.ply", "ply"),
    "las": FormatRow("cloud.las", "las", packages=("laspy", "lazrs")),
    "laz": FormatRow("cloud.laz", "las", packages=("laspy", "lazrs")),
    "parquet": FormatRow("cloud.parquet", "parquet", True, packages=("pyarrow",)),
    "pcd": FormatRow("pcd", "pcd", True, ("scan",), packages=("pypcd4",)),
    "e57": FormatRow("cloud.e57", "e57", False, ("scan",), ("intensity",), packages=("pye57",)),
    "kitti": FormatRow(
        "kitti",
        "kitti",
        True,
        needs=("scan", "object", "intensity", "class"),
        holds=("object", "intensity", "class"),
    ),
    "nuscenes": FormatRow(
        "nuscenes",
        "nuscenes",
        True,
        needs=("scan", "object", "channel", "intensity"),
        holds=("channel", "intensity"),
    ),
    "mcap": _bag("cloud.mcap"),
    "rosbag2": _bag("rosbag2"),
}
EXPORTS = tuple(name for name in FORMATS if name != "ply")  # what a result has if it is asked for


def columns_needed(name: str, layout: str) -> tuple[str, ...]:
    """Names of the columns that a format needs, with a layout if it has layouts."""
    return FORMATS[name].needs + FORMATS[name].layouts.get(layout, ())
