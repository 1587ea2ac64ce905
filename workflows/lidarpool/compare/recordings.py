"""Clouds and recordings of ours and of other programs, sweep by sweep."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Indices, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.extras import need, reading
from lidarsim.base.input_files import input_size, open_input, read_input
from lidarsim.base.vocabulary import UNITS_M
from lidarsim.base.words import did_you_mean, natural
from lidarsim.columns.bags import POINT_CLOUD, open_bag, point_columns
from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.scene.files.las import las_units, open_las
from lidarsim.scene.files.pcd import checked_pcd
from lidarsim.scene.files.polygon_files import read_ply_columns
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Placed, Sweeps

from ..base.fingerprint import fingerprint
from ..columns.parts import StoredCloud
from ..datasets.dataset import INDEX_FILE
from ..datasets.loader import sweeps

KINDS = (
    "the folder of a result or data set, a .ply, a .pcd or a folder of them, a .las or .laz, a bag "
    "of ROS 2 (.mcap or its folder), a .pcap of Velodyne, or a .pcap or .osf of Ouster"
)
# What programs call the number of a beam, and the light that came back; the first there is.
_RINGS = ("ring", "channel", "laser_id", "laser_number", "line", "beam")
_LIGHTS = ("intensity", "reflectivity", "i")
_WHITE = 100.0  # what Velodyne and Ouster report of a white surface, whatever its range
_VELODYNE = (1248, 554)  # bytes of the first frame of a Velodyne's .pcap: points, or a position

_CONVERTED = {  # {ending of recordings that are not read: what to do}
    ".e57": "write it as .las (pdal translate IN.e57 OUT.las)",
    **dict.fromkeys((".xyz", ".pts"), "write its points as .ply or .las"),
    ".bag": "it is a bag of ROS 1, convert it (rosbags-convert --src IN.bag --dst OUT)",
    ".db3": "it is a part of a bag of ROS 2, give the folder that it is in",
    **dict.fromkeys((".glb", ".gltf", ".obj", ".stl"), "it is a mesh, run a survey of it first"),
}
_UNIT_SUFFIXES = (".las", ".laz", ".ply", ".pcd")  # of clouds that may have another unit

Metres = tuple[float, float, float]  # in the units of x, y and z
_METRES: Metres = (1.0, 1.0, 1.0)
Columns = Mapping[str, AnyArray]
# Positions (n, 3), columns, and the pose of their axes in the world (4, 4); None if unknown.
Read = tuple[AnyArray, Columns, Floats | None]


@dataclass(frozen=True, eq=False)
class RecordedPoints:
    """Points of a sweep, or of a part of a cloud."""

    points: Floats  # (n, 3): metres
    rings: Ints | None = None  # (n,)
    light: Floats | None = None  # (n,): intensities, of any scale
    rays: Ints | None = None  # (n,): which ray and return; not of parts

    def __len__(self) -> int:
        return len(self.points)

    def part(self, rows: Indices) -> RecordedPoints:
        """Select points."""
        columns: Any = self.points, self.rings, self.light
        some: Any = (None if one is None else one[rows] for one in columns)
        return RecordedPoints(*some)

    @classmethod
    def joined(cls, parts: list[RecordedPoints]) -> RecordedPoints:
        """Concatenate parts of one recording, which have the same columns."""
        if not parts:
            return cls(np.empty((0, 3)))
        columns: Any = zip(*((part.points, part.rings, part.light) for part in parts), strict=True)
        whole: Any = (None if one[0] is None else np.concatenate(one) for one in columns)
        return cls(*whole)


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording of sweeps; or a cloud without any (`whole`), in parts instead."""

    name: str
    count: int  # of sweeps, or of parts
    read: Callable[[int], Read]
    light: str | None = None  # the column of intensities, if it has another name than usual
    is_cloud: bool = False
    points: int | None = None  # how many there are, if that is known before they are read
    times: Callable[[], Iterable[float]] | None = None  # start of each sweep, ns
    notes: tuple[str, ...] = ()
    thinned: bool = False  # whether hits were left out, so that gaps say nothing
    white: float | None = None  # intensity of a white surface, if it is the same at all ranges
    energies: bool = False  # whether intensities are energies, as those of results
    firings: str = ""  # recordings with the same have the same rays; "" for unknown
    metres: Metres = _METRES  # in the units of x, y and z

    def read_points(self, number: int, *, in_world: bool = False) -> RecordedPoints:
        """Read a sweep in its sensor's axes or the world's; LidarError if it cannot be."""
        with reading(self.name):
            points, columns, pose = self.read(number)
            if self.light is not None and self.light not in columns:
                raise LidarError(
                    f"it has no column {self.light!r} to compare as intensity."
                    + (did_you_mean(self.light, columns) or f" It has {', '.join(columns)}.")
                )
        places = np.asarray(points, np.float64)
        # Drivers write NaN or zeros for pulses without a return.
        there = np.isfinite(places).all(axis=1) & places.any(axis=1)
        places = places[there] * self.metres
        if in_world and not self.is_cloud:
            if pose is None:
                raise LidarError(
                    f"{self.name} is in the axes of its sensor, and does not say where that was: "
                    "compare it with a recording of sweeps."
                )
            places = places @ pose[:3, :3].T + pose[:3, 3] * self.metres
        lights = _LIGHTS if self.light is None else (self.light,)
        rings, light = (
            next((columns[name][there] for name in names if name in columns), None)
            for names in (_RINGS, lights)
        )
        return RecordedPoints(
            places,
            None if rings is None else np.asarray(rings).astype(np.int64),
            None if light is None else np.asarray(light).astype(np.float64),
            _rays(columns)[there] if self.firings and not in_world else None,
        )


def open_recording(
    place: str | Path | Cloud | StoredCloud,
    sensor: str | None = None,
    light: str | None = None,
    name: str = "the cloud",
    unit: str | None = None,
) -> Recording:
    """Open a cloud or recording: `KINDS`; or a cloud in memory, which has sweeps if of a result.

    `sensor` chooses one of several sensors, or the topic of a bag; `light` is the column of the
    intensity, if it has another name than usual; `name` is that of a cloud in memory; `unit` is
    that of a file of `_UNIT_SUFFIXES`, in place of metres or of the units that a .las states.
    LidarError if it is none, or cannot be opened.
    """
    if isinstance(place, Cloud | StoredCloud):
        if unit is not None:
            raise LidarError(f"{name} is in metres: leave out its unit, {unit!r}.")
        return _of_cloud(name, place, place.sweeps, sensor, light)
    path = Path(place)
    name = str(place)
    if unit is None:
        return _of_path(path, name, sensor, light, None)
    if path.suffix.lower() not in _UNIT_SUFFIXES:
        raise LidarError(
            f"{name} is in metres: leave out its unit, {unit!r}, which is for a file "
            f"{' '.join(_UNIT_SUFFIXES)}."
        )
    metre = UNITS_M[unit]
    return _of_path(path, name, sensor, light, (metre, metre, metre))


def _of_path(
    path: Path, name: str, sensor: str | None, light: str | None, metres: Metres | None
) -> Recording:
    """Open a file or folder; `metres` are given in place of those of its units."""
    kind = path.suffix.lower()
    if not path.exists() or (path.is_file() and not path.stat().st_size):
        raise LidarError(f"{name} does not exist, or is empty: give {KINDS}.")
    if path.is_dir():
        if (path / "cloud.ply").exists():
            return _of_ply(path / "cloud.ply", name, sensor, light)
        if (path / INDEX_FILE).exists():
            return _of_data_set(path, name, sensor, light)
        if (path / "metadata.yaml").exists():
            return _of_bag(path, name, sensor, light)
        files = [file for file in path.iterdir() if file.suffix.lower() == ".pcd"]
        if files:
            return _of_pcd(sorted(files, key=lambda file: natural(file.name)), name, light)
    elif kind == ".ply":
        return replace(_of_ply(path, name, sensor, light), metres=metres or _METRES)
    elif kind == ".pcd":
        return replace(_of_pcd([path], name, light), metres=metres or _METRES)
    elif kind in (".las", ".laz"):
        return _of_las(path, name, light, metres)
    elif kind == ".mcap":
        return _of_bag(path, name, sensor, light)
    elif kind in (".osf", ".pcap"):
        with reading(name), open_input(path) as file:
            first = int.from_bytes(file.read(36)[32:], "little")
        if first in _VELODYNE:
            return _of_velodyne(path, name, light)
        return _of_ouster(path, name, sensor, light)
    advice = f"{_CONVERTED[kind]}, or " if kind in _CONVERTED else ""
    raise LidarError(f"{name} cannot be compared: {advice}give {KINDS}.")


def _of_cloud(
    name: str, cloud: CloudLike, of: Callable[[], Sweeps] | None, sensor: str | None,
    light: str | None, **more: Any,
) -> Recording:  # fmt: skip
    """Open a cloud of ours, in parts or as the sweeps of a sensor."""
    if of is None:

        def part(number: int) -> Read:
            chunk = next(cloud.chunks(CHUNK_POINTS, number * CHUNK_POINTS))
            return chunk.positions, chunk.columns, None

        parts = -(-len(cloud) // CHUNK_POINTS)
        return Recording(name, parts, part, light, True, len(cloud), **more)
    there = of()
    which = there.sensors.index(_chosen(name, "sensors", there.sensors, sensor))
    numbers = np.flatnonzero(there.sensor == which).tolist()

    def sweep(number: int) -> Read:
        at = numbers[number]
        points = next(there.points(cloud, at, at + 1))
        return there.in_sensor(at, points.positions), points.columns, there.pose.matrix(at)

    times = there.begins_ns[numbers] + (there.start_ns or 0)
    more["energies"] = light in (None, "intensity")
    columns = {column.name for column in cloud.table}
    if told := columns & {"time", "ray"}:
        poses = there.pose.positions[numbers], there.pose.quaternions[numbers]
        known = max(told), "return_number" in columns  # time rather than ray, as `_rays`
        more["firings"] = fingerprint(known, there.scans[numbers], there.begins_ns[numbers], poses)
    return Recording(name, len(numbers), sweep, light, times=lambda: times, **more)


def _rays(columns: Columns) -> Ints:
    """Return numbers (n,) that differ for all rays of a sweep, and for the returns of each."""
    if "time" in columns:
        rays = columns["time"].astype(np.int64) << 16 | columns["channel"]
    else:
        rays = columns["scan"].astype(np.int64) << 32 | columns["ray"]
    _, first, ray = np.unique(rays, return_index=True, return_inverse=True)
    order: Ints = np.arange(len(rays)) - first[ray]  # returns of a ray are together
    return rays << 8 | columns.get("return_number", order)


def _of_ply(path: Path, name: str, sensor: str | None, light: str | None) -> Recording:
    """Open a .ply, with the sweeps beside it if it is of a result."""
    try:
        cloud = CloudFile(path)
    except LidarError:  # text, or of another program

        def read(_: int) -> Read:
            columns = read_ply_columns(read_input(path))
            return _places(columns), columns, None

        return Recording(name, 1, read, light, is_cloud=True)
    if not (beside := path.with_name(SWEEPS_FILE)).exists():
        return _of_cloud(name, cloud, None, sensor, light)
    try:
        report = json.loads(read_input(path.with_name("report.json")))
        every = int(report["parameters"]["keep_every"])
    except (OSError, ValueError, TypeError, LookupError, LidarError):
        every = 1
    note = (
        f"{name} keeps one of {every} hits, so its gaps are no lost returns: run it with "
        "keep_every 1 to compare these"
    )
    more = {"notes": (note,), "thinned": True} if every > 1 else {}
    return _of_cloud(name, cloud, partial(Sweeps.load, beside), sensor, light, **more)


def _of_data_set(path: Path, name: str, sensor: str | None, light: str | None) -> Recording:
    saved = sweeps(path, sensors=None if sensor is None else [sensor])

    def read(number: int) -> Read:
        sweep = saved[number]
        return sweep.points, sweep.columns, sweep.pose

    return Recording(name, len(saved), read, light)


def _of_pcd(files: list[Path], name: str, light: str | None) -> Recording:
    """Open files of a sweep each; VIEWPOINT says where its sensor was."""
    need("pypcd4", "pcd", f"{name} is read")

    def read(number: int) -> Read:
        from pypcd4.pypcd4 import PointCloud  # an extra

        path = files[number]
        with reading(path.name) if len(files) > 1 else nullcontext():
            checked_pcd(path)
            with open_input(path) as opened:
                file = PointCloud.from_fileobj(opened)
            rows, (*place, w, x, y, z) = file.pc_data, file.metadata.viewpoint
            if len(rows) != file.metadata.points:
                raise ValueError(f"{file.metadata.points:,} points announced, {len(rows):,} there")
        columns = {name: rows[name] for name in rows.dtype.names or ()}
        pose = Placed(np.array([place]), np.array([[x, y, z, w]])).matrix(0)
        return _places(columns), columns, pose

    return Recording(name, len(files), read, light)


def _of_las(path: Path, name: str, light: str | None, metres: Metres | None) -> Recording:
    """Open the points of a .las or .laz, in the units that it states unless others are given."""
    notes = []
    with reading(name):
        with open_las(path) as reader:
            count = reader.header.point_count
        if metres is None and (units := las_units(path)) is not None:
            metres = units.factors
            notes = [f"{name} {note}" for note in [units.note()] if note]

    def read(number: int) -> Read:
        wanted = min(CHUNK_POINTS, count - number * CHUNK_POINTS)
        with open_las(path) as reader:
            reader.seek(number * CHUNK_POINTS)
            points = reader.read_points(wanted)
        if len(points) != wanted:
            raise ValueError(f"{count:,} points announced, and there are fewer")
        columns = {name: np.asarray(points[name]) for name in points.point_format.dimension_names}
        return np.stack([points.x, points.y, points.z], axis=1), columns, None

    parts = -(-count // CHUNK_POINTS)
    metres = metres or _METRES
    return Recording(name, parts, read, light, True, count, notes=tuple(notes), metres=metres)


def _of_bag(path: Path, name: str, topic: str | None, light: str | None) -> Recording:
    """Open a topic of PointCloud2, a sweep each, in the axes of their frame."""
    bag = open_bag(path, name)
    there = {one.topic: one for one in bag.connections if one.msgtype == POINT_CLOUD}
    connection = there[_chosen(name, "topics of PointCloud2", there, topic)]
    messages = partial(bag.messages, [connection])

    def points(message: Any) -> Read:
        columns = point_columns(message[2])
        return _places(columns), columns, None

    def times() -> Iterator[float]:
        return (time for _, time, _ in messages())

    return _streamed(name, messages, points, light, connection.msgcount, times=times)


def _of_ouster(path: Path, name: str, sensor: str | None, light: str | None) -> Recording:
    """Open scans of ouster-sdk; a .pcap has its metadata in a .json beside it."""
    if find_spec("ouster") is None:  # it wants old versions of what it does not need to read
        raise LidarError(f"{name} is read by ouster-sdk: pip install --no-deps ouster-sdk.")
    sdk: Any = import_module("ouster.sdk")
    with reading(name):
        input_size(path)
        if (metadata := path.with_suffix(".json")).exists():
            input_size(metadata)
        infos = sdk.open_source(str(path)).sensor_info
        known = [f"{one.prod_line} {one.sn}".strip() for one in infos]
    which = known.index(_chosen(name, "sensors", known, sensor))
    place = import_module("ouster.sdk.core").XYZLut(infos[which], False)

    def scans() -> Iterator[Any]:
        return (one[which] for one in sdk.open_source(str(path)) if one[which] is not None)

    def points(scan: Any) -> Read:
        ring, column = np.nonzero(scan.field("RANGE"))
        columns = {"ring": ring}
        for one in {"REFLECTIVITY", "SIGNAL", "NEAR_IR"}.intersection(scan.fields):
            columns[one.lower()] = scan.field(one)[ring, column]
        return place(scan)[ring, column], columns, None

    def times() -> Iterator[float]:
        return (float(scan.timestamp[scan.timestamp > 0].min(initial=0)) for scan in scans())

    white = _WHITE if light in (None, "reflectivity") else None
    return _streamed(name, scans, points, light, white=white, times=times)


def _of_velodyne(path: Path, name: str, light: str | None) -> Recording:
    """Open packets of a Velodyne, which say the model."""
    need("velodyne_decoder", "fit", f"{name} is read")
    decoder: Any = import_module("velodyne_decoder")
    with reading(name), open_input(path) as file:
        file.seek(24)
        heads = iter(partial(file.read, 16), b"")
        frames = (file.read(int.from_bytes(head[8:12], "little")) for head in heads)
        sent = (frame for frame in frames if len(frame) == _VELODYNE[0])
        units = {(*one[26:30], int.from_bytes(one[36:38])) for one in sent}
    if len(units) > 1:
        a, b, c, d, port = min(units)
        one = f"tcpdump -r {name} -w one.pcap src {a}.{b}.{c}.{d} and dst port {port}"
        raise LidarError(f"{name} is of {len(units)} units: keep one, {one}.")

    def points(sweep: Any) -> Read:
        columns = {name: sweep.points[name] for name in sweep.points.dtype.names}
        return _places(columns), columns, None

    packets = partial(decoder.read_pcap, str(path), as_pcl_structs=True)

    def times() -> Iterator[float]:
        return (1e9 * sweep.stamp.host for sweep in packets())

    return _streamed(name, packets, points, light, white=None if light else _WHITE, times=times)


def _streamed(
    name: str, begin: Callable[[], Iterable[Any]], points: Callable[[Any], Read],
    light: str | None, count: int | None = None, **more: Any,
) -> Recording:  # fmt: skip
    """Open what can be read from its beginning only; also to count sweeps, if that is needed."""
    if count is None:
        with reading(name):
            count = sum(1 for _ in begin())
    coming: tuple[int, Iterator[Any]] = 0, iter(())  # number of the next sweep, and all from there

    def read(number: int) -> Read:
        nonlocal coming
        if not 0 < coming[0] <= number:
            coming = 0, iter(begin())
        sweep = next(islice(coming[1], number - coming[0], None))
        coming = number + 1, coming[1]
        return points(sweep)

    return Recording(name, count, read, light, **more)


def _places(columns: Columns) -> Floats:
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its points have no {', '.join(missing)}")
    return np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], axis=1)


def _chosen(name: str, what: str, there: Iterable[str], wanted: str | None) -> str:
    """Return the sensor or topic that is wanted, or the only one."""
    known = list(there)
    if wanted is None and len(known) == 1:
        return known[0]
    if wanted is not None and wanted in known:
        return wanted
    listed = f"{name} has the {what} {', '.join(known)}" if known else f"{name} has no {what}"
    if wanted is None:
        advice = "choose one (--sensor-a, --sensor-b; of fit --sensor)" if known else "record one"
        raise LidarError(f"{listed}: {advice}.")
    raise LidarError(f"{listed}, not {wanted!r}." + did_you_mean(wanted, known))
