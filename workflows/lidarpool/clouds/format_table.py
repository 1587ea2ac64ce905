"""The table of formats, a row a format: modules that write and read each, and its requirements.

It is quick to import: help and completion of the command read it. Packages add formats as plug-ins
of the group `GROUP`, whose names are the names of the formats.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from lidarsim.base.errors import LidarError
from lidarsim.base.extras import need
from lidarsim.base.plugins import Plugin, PluginTable, plugins_of

GROUP = "lidarpool.clouds"
Reading = Literal["sweeps", "points"]


@dataclass(frozen=True)
class FormatRow:
    """A format of clouds: its module and files, required and supported columns.

    Parameters
    ----------
    file
        File or folder in the folder of a result; an ending chooses the format.
    module
        Dotted name of the module that writes the format. If the module has a class `Reader`, which
        derives from `Reader` in `clouds/sweep_reader.py`, this class reads single sweeps of data
        sets.
    title
        Proper name in sentences, such as KITTI; by default the name of the format.
    write
        Name of the function of the module that writes it, `write(path, cloud, sweeps)`, or with
        `in_pieces` of a subclass of `Pieces` (`clouds/pieces.py`), which defines the content of
        each file.
    suffixes
        Endings of the files that are read, in lower case with their dots.
    reads
        What the module reads of such files: "sweeps" by `open_file(source)`, which returns a
        `Recording` of a `RecordingSource` (`recording.py`); "points" if scenes can be made of
        them.
    folders
        Patterns of names in the folders that are read, by `open_folder(source)` as by `open_file`.
    in_pieces
        Whether it has many files, which workers can write.
    packages
        Import packages that write and read it, and `extra`, the extra of lidarpool that installs
        them.
    needs
        Columns that a cloud must have; formats that need `scan` store single sweeps.
    holds
        Columns that it can hold; None for all.
    named
        Columns that it holds in addition if classes have names.
    layouts
        {layout: columns that it needs and holds in addition}, where there are layouts. The
        function that writes it then takes `layout`, `compensated`, `organized` and `pose_rate_hz`
        as well.
    organized_layouts
        Layouts that have an option for organized clouds: a point for each ray.
    raw_or_compensated
        Whether it has an option for points at the start of the sweep.
    one_system
        Whether readers expect all points in one coordinate system.
    as_measured
        Whether it stores measurements, such as ranges, instead of positions.
    compensates
        Whether its points are always compensated for motion.
    first_sensor
        Name that the first sensor has there, whatever its own name, because readers expect it.
    laser_scans
        Whether it has a LaserScan of 2D scanners.
    integer_intensities
        Whether intensities are integers. The function that writes the format then takes
        `intensity_full_scale`, the intensity that is stored as the highest integer, as well; None
        for a cloud without intensities.
    with_scene
        Whether it has scene and planned path. The function that writes it then takes `content`, the
        content of pictures, as well; None if unknown.
    inside
        Pattern of the names of the files in its folder.
    data_set
        Name of the data sets whose jobs are written in it; empty without data sets, as of plug-ins.
    of_job
        In data sets: path of a job's file or folder, if it has one, by `Entry`.
    boxes
        In data sets: whether its pieces are sweeps, and each comes with its boxes of actors.
    actor_boxes
        Whether its files have the boxes of actors.
    raw
        In data sets: whether each sweep has separate files, which hold rows of numbers.
    plugin
        The plug-in that provides the row; filled in when the plug-in is loaded.
    """

    file: str
    module: str
    write: str = ""
    title: str = ""
    suffixes: tuple[str, ...] = ()
    reads: tuple[Reading, ...] = ()
    folders: tuple[str, ...] = ()
    in_pieces: bool = False
    packages: tuple[str, ...] = ()
    extra: str = ""
    needs: tuple[str, ...] = ()
    holds: tuple[str, ...] | None = None
    named: tuple[str, ...] = ()
    layouts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    organized_layouts: tuple[str, ...] = ()
    raw_or_compensated: bool = False
    one_system: bool = False
    as_measured: bool = False
    compensates: bool = False
    first_sensor: str = ""
    laser_scans: bool = False
    integer_intensities: bool = False
    with_scene: bool = False
    inside: str = ""
    data_set: str = ""
    of_job: str = ""
    boxes: bool = False
    actor_boxes: bool = False
    raw: bool = False
    plugin: Plugin | None = field(default=None, compare=False)

    def holds_column(self, name: str, *, classes_have_names: bool = False) -> bool:
        """Return True if the format holds a column of any layout.

        Some formats hold classes only if the classes have names.
        """
        if self.holds is None or name in self.holds:
            return True
        return classes_have_names and name in self.named

    @property
    def positions_of_sweeps(self) -> bool:
        """Whether it stores the positions of points sweep by sweep."""
        return "scan" in self.needs and not self.as_measured

    @property
    def missing_packages(self) -> list[str]:
        """Packages that write the format and are not installed in this environment."""
        return [package for package in self.packages if find_spec(package) is None]

    def provides(self, name: str) -> Any:
        """Import the module, and return its function or class of a name.

        Raises
        ------
        LidarError
            If the module is of a plug-in and cannot be imported, or lacks the name.
        """
        if self.plugin is None:
            return getattr(import_module(self.module), name)
        module = replace(self.plugin, value=self.module).load(object)
        if not hasattr(module, name):
            raise self.plugin.lacks(f"{self.module}.{name}")
        return getattr(module, name)

    def reader(self, function: str, name: str) -> Any:
        """Return a function of the module that reads.

        Raises LidarError without a required package.

        `name` is the name of the file or folder in the message.
        """
        for package in self.packages:
            need(package, self.extra, f"Reading {name}")
        return self.provides(function)


_ALL_RAYS = ("ray", "range")  # and every return (`check_whole`)
LAYOUTS = {
    "velodyne": ("intensity", "time"),
    "autoware": ("intensity", "time", "return_number", "returns"),
    "ouster": ("signal", "time", "reflectivity", "range"),
    "images": ("intensity", "time", *_ALL_RAYS),
    "livox": ("reflectivity", "time"),
    "hesai": ("reflectivity", "time"),
    "robosense": ("reflectivity", "time"),
}
_ORGANIZED_LAYOUTS = ("velodyne", "ouster", "images", "robosense")
_COLORS = ("red", "green", "blue")
_SURFACES = (
    "normal_x", "normal_y", "normal_z", "incidence_deg", "origin_x", "origin_y", "origin_z",
)  # fmt: skip
_E57 = ("intensity", *_COLORS, *_SURFACES[:3])
_LABELS = ("object", "intensity", "class")
_KITTI_COLUMNS = ("object", "reflectivity", "class")
_RINGS = ("channel", "intensity")
_OSI = ("object", "channel", "intensity", "reflectance", "radial_velocity", "sensor")
_BAG_COLUMNS = ("channel", *_COLORS, "radial_velocity", *_SURFACES, "material")

_KITTI_FILES = (
    r"semantic-kitti\.yaml|(poses|label_02)/[^/]+\.txt|"
    r"sequences/[^/]+/((poses|times|calib)\.txt|(velodyne|labels|label_2)/\d+\.(bin|label|txt))"
)
_NUSCENES_FILES = (
    r"(samples|sweeps)/[^/]+/([^/]+/)?\d+\.pcd\.bin|v1\.0-lidarpool/\w+\.json|maps/none\.png|"
    r"lidarseg/v1\.0-lidarpool/[^/]+\.pcd\.bin"
)


def _las(name: str) -> FormatRow:
    return FormatRow(
        f"cloud.{name}",
        "lidarpool.clouds.las",
        f"write_{name}",
        name.upper(),
        packages=("laspy", "lazrs"),
        extra="las",
        one_system=True,
        integer_intensities=True,
        suffixes=(f".{name}",),
        reads=("sweeps", "points"),
    )


def _osi(name: str, file: str, title: str) -> FormatRow:
    return FormatRow(
        file,
        "lidarpool.clouds.osi",
        f"write_{name}",
        title,
        packages=("betterosi",),
        extra="osi",
        needs=("scan", *_OSI[:3]),
        holds=_OSI,
        compensates=True,
        actor_boxes=True,
    )


def _bag(name: str, file: str, **fields: Any) -> FormatRow:
    return FormatRow(
        file,
        "lidarpool.clouds.ros.bags",
        f"write_{name}",
        packages=("rosbags",),
        extra="ros",
        needs=("scan", "object", "channel"),
        holds=_BAG_COLUMNS,
        named=("class",),
        layouts=LAYOUTS,
        organized_layouts=_ORGANIZED_LAYOUTS,
        raw_or_compensated=True,
        laser_scans=True,
        actor_boxes=True,
        **fields,
    )


FORMATS = {
    "ply": FormatRow(
        "cloud.ply",
        "lidarpool.clouds.ply",
        "write_ply",
        "PLY",
        data_set="folder",
        of_job="jobs/{name}/cloud.ply",
        suffixes=(".ply",),
        reads=("sweeps", "points"),
        folders=("cloud.ply",),
    ),
    "las": _las("las"),
    "laz": _las("laz"),
    "parquet": FormatRow(
        "cloud.parquet",
        "lidarpool.clouds.parquet",
        "Pieces",
        "Parquet",
        in_pieces=True,
        packages=("pyarrow",),
        extra="parquet",
        inside=r"part-\d+\.parquet",
        data_set="parquet",
        of_job="points/job={number}",
        suffixes=(".parquet",),
        reads=("sweeps", "points"),
        folders=("**/*.parquet",),
    ),
    "pcd": FormatRow(
        "pcd",
        "lidarpool.clouds.pcd",
        "Pieces",
        "PCD",
        in_pieces=True,
        needs=("scan",),
        raw_or_compensated=True,
        inside=r"\d+\.pcd",
        suffixes=(".pcd",),
        reads=("sweeps", "points"),
        folders=("*.[pP][cC][dD]",),
    ),
    "e57": FormatRow(
        "cloud.e57",
        "lidarpool.clouds.e57",
        "write_e57",
        "E57",
        packages=("pye57",),
        extra="e57",
        needs=("scan",),
        holds=_E57,
        compensates=True,
        suffixes=(".e57",),
        reads=("sweeps", "points"),
    ),
    "kitti": FormatRow(
        "kitti",
        "lidarpool.clouds.kitti",
        "Pieces",
        "KITTI",
        in_pieces=True,
        needs=("scan", *_KITTI_COLUMNS),
        holds=_KITTI_COLUMNS,
        compensates=True,
        inside=_KITTI_FILES,
        data_set="kitti",
        boxes=True,
        actor_boxes=True,
        raw=True,
        suffixes=(".bin",),
        reads=("sweeps", "points"),
        folders=("sequences/*/velodyne", "velodyne/*.bin", "velodyne_points/data/*.bin", "*.bin"),
    ),
    "nuscenes": FormatRow(
        "nuscenes",
        "lidarpool.clouds.nuscenes",
        "Pieces",
        "nuScenes",
        in_pieces=True,
        needs=("scan", "object", *_RINGS),
        holds=_RINGS,
        named=("class",),
        compensates=True,
        first_sensor="LIDAR_TOP",
        inside=_NUSCENES_FILES,
        data_set="nuscenes",
        boxes=True,
        actor_boxes=True,
        raw=True,
        folders=("v1.0-*/sample_data.json", "sample_data.json"),
    ),
    "webdataset": FormatRow(
        "webdataset",
        "lidarpool.clouds.webdataset",
        "Pieces",
        "WebDataset",
        in_pieces=True,
        needs=("scan", *_LABELS),
        inside=r"shards/([^/]+/)?[^/]+\.tar|offsets/[^/]+\.npz",
        data_set="webdataset",
        boxes=True,
        actor_boxes=True,
        suffixes=(".tar",),
        reads=("sweeps",),
        folders=("**/*.tar",),
    ),
    "images": FormatRow(
        "images",
        "lidarpool.clouds.images",
        "Pieces",
        "range images",
        in_pieces=True,
        needs=("scan", *_ALL_RAYS),
        inside=r"[^/]+/\d+\.npz",
        data_set="images",
        of_job="images/{name}",
        boxes=True,
        folders=("*/*.npz",),
    ),
    "pcap": FormatRow(
        "packets",
        "lidarpool.clouds.packets",
        "write_pcap",
        "PCAP",
        needs=("scan", *_ALL_RAYS),
        holds=("scan", "sensor", "channel", *_ALL_RAYS, "time", "reflectivity", "signal"),
        inside=r"[^/]+\.(pcap|json)",
        as_measured=True,
        suffixes=(".pcap", ".pcapng", ".osf"),
        reads=("sweeps",),
    ),
    "rrd": FormatRow(
        "cloud.rrd",
        "lidarpool.clouds.rrd",
        "write_rrd",
        "RRD",
        packages=("rerun",),
        extra="rerun",
        needs=("scan", "object"),
        compensates=True,
        with_scene=True,
        actor_boxes=True,
    ),
    # Readers take the type of messages from the part «sd» of the file's name.
    "osi": _osi("osi", "cloud_sd.osi", "OSI"),
    "osi_mcap": _osi("osi_mcap", "cloud_osi.mcap", "OSI in MCAP"),
    "mcap": _bag(
        "mcap",
        "cloud.mcap",
        title="MCAP",
        suffixes=(".mcap",),
        reads=("sweeps",),
        data_set="mcap",
        of_job="bags/{name}.mcap",
    ),
    "rosbag2": _bag(
        "rosbag2", "rosbag2", folders=("metadata.yaml",), inside=r"metadata\.yaml|rosbag2\w*\.mcap"
    ),
}
# Formats that are only read.
_READ_ONLY = {
    "text": FormatRow(
        "",
        "lidarpool.clouds.text_and_arrays",
        suffixes=(".xyz", ".txt", ".asc", ".csv", ".pts", ".ptx", ".npy"),
        reads=("sweeps", "points"),
    ),
}
DATA_SETS = {row.data_set: name for name, row in FORMATS.items() if row.data_set}  # {its: of jobs}
EXPORTS = tuple(name for name in FORMATS if name != "ply")  # what a result has if it is asked for


def data_set_title(data_set: str) -> str:
    """Return the proper name of the format of a data set's jobs, such as KITTI."""
    return FORMATS[DATA_SETS[data_set]].title if data_set in DATA_SETS else data_set


def _row_of_plugin(plugin: Plugin) -> FormatRow:
    """Return the row of a plug-in.

    Raises LidarError for a plug-in that cannot be used.
    """
    row = plugin.load(FormatRow)
    if row.data_set:
        raise LidarError(
            f"{plugin} defines the data set {row.data_set!r}, but plug-ins cannot define data "
            "sets. Remove `data_set`."
        )
    if "/" in row.file or (row.write and row.file in _FILES):
        raise LidarError(
            f"{plugin} writes {row.file!r}, which contains a parent folder or is used by another "
            "format. Set `file` to a unique file or folder name."
        )
    return replace(row, plugin=plugin)


_FILES = [row.file for row in FORMATS.values()]
_TABLE = PluginTable(GROUP, "cloud format", FORMATS, _row_of_plugin)


def row_of(name: str) -> FormatRow:
    """Return the row of a format that is written, of the table or of a plug-in.

    Raises
    ------
    LidarError
        If the format is unknown, or is only read, or its plug-in cannot be used.
    """
    row = _TABLE[name]
    if not row.write:
        raise LidarError(
            f"The format {name!r} can be read, but not written. Write another format, such as ply."
        )
    return row


def _rows_of_all() -> Iterator[FormatRow]:
    """Yield the rows of the table, then the rows of plug-ins that can be used."""
    yield from (*FORMATS.values(), *_READ_ONLY.values())
    for name in plugins_of(GROUP):
        with suppress(LidarError):
            yield _TABLE[name]


def _row_that_reads(kind: Reading, path: Path) -> FormatRow | None:
    """Return the row that reads a kind of the file's suffix, or None."""
    suffix = path.suffix.lower()
    rows = (row for row in _rows_of_all() if kind in row.reads and suffix in row.suffixes)
    return next(rows, None)


def reader_of(path: Path, name: str) -> Callable[[Any], Any] | None:
    """Return the function that opens a file or folder as a recording, or None if there is none.

    Raises
    ------
    LidarError
        If a package that reads it is not installed; `name` is the name of the file in messages.
    """
    if path.is_dir():
        rows = (row for row in _rows_of_all() if any(map(partial(_contains, path), row.folders)))
        row = next(rows, None)
        return None if row is None else row.reader("open_folder", name)
    row = _row_that_reads("sweeps", path)
    return None if row is None else row.reader("open_file", name)


def _contains(folder: Path, pattern: str) -> bool:
    return next(folder.glob(pattern), None) is not None


def points_reader(path: Path) -> Callable[[Any], Any] | None:
    """Return the function that opens a file for a scene, or None for an unknown suffix.

    Raises
    ------
    LidarError
        If a package that reads it is not installed.
    """
    row = _row_that_reads("points", path)
    return None if row is None else row.reader("open_file", str(path))


def point_suffixes() -> tuple[str, ...]:
    """Return the suffixes of files whose points are read."""
    rows = [row for row in _rows_of_all() if "points" in row.reads]
    return tuple(suffix for row in rows for suffix in row.suffixes)


def plugin_rows(files: Collection[str]) -> list[FormatRow]:
    """Return the rows of plug-ins whose file or folder is in `files`.

    Plug-ins that cannot be used are left out.
    """
    rows: list[FormatRow] = []
    if not files:
        return rows
    for name in plugins_of(GROUP):
        with suppress(LidarError):
            rows += [row for row in [row_of(name)] if row.file in files]
    return rows


def check_whole(needs: Iterable[str], keep_every: int) -> None:
    """Raise LidarError if returns are thinned out for a format of all rays."""
    if "ray" in needs and keep_every > 1:
        raise LidarError(
            "Range images and organized clouds require all returns, but `keep_every` is "
            f"{keep_every}. Set `cloud.keep_every: 1`."
        )
