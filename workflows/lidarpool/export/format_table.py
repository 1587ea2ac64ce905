"""The table of formats: what writes and reads each, and what it needs; one row a format.

It is quick to import: help and completion of the command read it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from lidarsim.base.errors import LidarError


@dataclass(frozen=True)
class FormatRow:
    """What a format is."""

    file: str  # or folder, in the folder of a result; an ending chooses the format
    # Of this room: writes it by `write_NAME(path, cloud, sweeps)`, or by `Pieces`, and reads single
    # sweeps of data sets by `Reader`.
    module: str
    in_pieces: bool = False  # it has many files, which workers can write: `Pieces` says which
    # What writes it; the extra of lidarpool that installs them has the name of the module.
    packages: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()  # columns; formats that need `scan` store single sweeps
    holds: tuple[str, ...] | None = None  # columns; None for all
    named: tuple[str, ...] = ()  # columns that it holds beside those if classes have names
    # {layout: columns that it needs and holds beside those}, where there are layouts
    layouts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    raw_or_compensated: bool = False  # it has an option for points at the start of the sweep
    inside: str = ""  # of a folder: pattern of the names of its files
    data_set: str = ""  # name of the data sets whose jobs are written in it, if there are such
    of_job: str = ""  # there: place of a job's file or folder, if it has one, by `Entry`
    boxes: bool = False  # there: its pieces are sweeps, and each comes with its boxes of actors
    raw: bool = False  # there: a sweep has files of its own, which hold rows of numbers

    def load(self) -> Any:
        """Import the module."""
        return import_module(f".{self.module}", __package__)


_ALL_RAYS = ("ray", "range")  # and every return: see `check_whole`
LAYOUTS = {
    "velodyne": ("intensity", "time"),
    "autoware": ("intensity", "time", "return_number", "returns"),
    "ouster": ("signal", "time", "reflectivity", "range"),
    "images": ("intensity", "time", *_ALL_RAYS),
}
_COLOURS = ("red", "green", "blue")
_SURFACES = (
    "normal_x", "normal_y", "normal_z", "incidence_deg", "origin_x", "origin_y", "origin_z",
)  # fmt: skip
_E57 = ("intensity", *_COLOURS, *_SURFACES[:3])
_LAS = ("laspy", "lazrs")
_LABELS = ("object", "intensity", "class")
_KITTI_COLUMNS = ("object", "reflectivity", "class")
_RINGS = ("channel", "intensity")
_BAG = (
    False,
    ("rosbags",),
    ("scan", "object", "channel"),
    ("channel", *_COLOURS, "radial_velocity", *_SURFACES, "material"),
    ("class",),
    LAYOUTS,
    True,
)

_KITTI = (
    r"semantic-kitti\.yaml|poses/[^/]+\.txt|"
    r"sequences/[^/]+/((poses|times|calib)\.txt|(velodyne|labels|label_2)/\d+\.(bin|label|txt))"
)
_NUSCENES = (
    r"(samples|sweeps)/[^/]+/([^/]+/)?\d+\.pcd\.bin|v1\.0-lidarpool/\w+\.json|maps/none\.png|"
    r"lidarseg/v1\.0-lidarpool/[^/]+\.pcd\.bin"
)
_SHARDS = r"shards/([^/]+/)?[^/]+\.tar|offsets/[^/]+\.npz"
_PARTS = r"part-\d+\.parquet"

FORMATS = {
    "ply": FormatRow(
        "cloud.ply", "ply", data_set="folder", of_job="jobs/{name}/cloud.ply"
    ),
    "las": FormatRow("cloud.las", "las", False, _LAS),
    "laz": FormatRow("cloud.laz", "las", False, _LAS),
    "parquet": FormatRow(
        "cloud.parquet", "parquet", True, ("pyarrow",), inside=_PARTS, data_set="parquet",
        of_job="points/job={number}",
    ),
    "pcd": FormatRow(
        "pcd", "pcd", True, ("pypcd4",), ("scan",), raw_or_compensated=True, inside=r"\d+\.pcd"
    ),
    "images": FormatRow(
        "images", "images", True, (), ("scan", *_ALL_RAYS), inside=r"[^/]+/\d+\.npz",
        data_set="images", of_job="images/{name}", boxes=True,
    ),
    "e57": FormatRow("cloud.e57", "e57", False, ("pye57",), ("scan",), _E57),
    "kitti": FormatRow(
        "kitti", "kitti", True, (), ("scan", *_KITTI_COLUMNS), _KITTI_COLUMNS, inside=_KITTI,
        data_set="kitti", boxes=True, raw=True,
    ),
    "nuscenes": FormatRow(
        "nuscenes", "nuscenes", True, (), ("scan", "object", *_RINGS), _RINGS, ("class",),
        inside=_NUSCENES, data_set="nuscenes", boxes=True, raw=True,
    ),
    "webdataset": FormatRow(
        "webdataset", "webdataset", True, (), ("scan", *_LABELS), inside=_SHARDS,
        data_set="webdataset", boxes=True,
    ),
    "mcap": FormatRow(
        "cloud.mcap", "ros", *_BAG, data_set="mcap", of_job="bags/{name}.mcap"
    ),
    "rosbag2": FormatRow("rosbag2", "ros", *_BAG, inside=r"metadata\.yaml|rosbag2\w*\.mcap"),
}  # fmt: skip
DATA_SETS = {row.data_set: name for name, row in FORMATS.items() if row.data_set}  # {its: of jobs}
EXPORTS = tuple(name for name in FORMATS if name != "ply")  # what a result has if it is asked for


def check_whole(needs: Iterable[str], keep_every: int) -> None:
    """Refuse to thin out the returns for a format that shows which rays had none."""
    if "ray" in needs and keep_every > 1:
        raise LidarError(
            f"Range images need every return, and keep_every is {keep_every}: set cloud.keep_every "
            "to 1."
        )
