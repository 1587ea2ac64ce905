"""Opens clouds and recordings, of lidarpool and of other programs, to be read sweep by sweep."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Indices, Ints
from lidarsim.base.errors import CutShortError, LidarError
from lidarsim.base.extras import need, reading
from lidarsim.base.input_files import input_size, open_input, read_input
from lidarsim.base.words import did_you_mean, natural
from lidarsim.columns.bags import (
    LIVOX_CLOUDS,
    POINT_CLOUD,
    livox_columns,
    open_bag,
    point_columns,
)
from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.scene.files.cloud_scan import with_usual_names
from lidarsim.scene.files.las import las_system, noise_classes, open_las
from lidarsim.scene.files.noise_points import NOISE_CLASSES, LeftOut, usable_points
from lidarsim.scene.files.pcd import read_pcd
from lidarsim.scene.files.polygon_files import ply_comments, read_ply_columns
from lidarsim.scene.files.ptx import read_ptx
from lidarsim.scene.files.stated_system import Metres, StatedSystem, stated_metres
from lidarsim.sweeps.sweep_motion import FiringPoses
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

from ..base.fingerprint import fingerprint
from ..columns.parts import StoredCloud
from ..datasets.dataset import INDEX_FILE
from ..datasets.loader import sweeps
from .bag_poses import sweep_poses
from .sweep_files import (
    Columns,
    Read,
    SweepFiles,
    nuscenes_tables,
    open_e57,
    open_images,
    open_kitti,
    open_kitti_file,
    open_nuscenes,
    open_parquet,
    open_webdataset,
)

if TYPE_CHECKING:
    from laspy import LasReader

KINDS = (
    "the folder of a result or data set, a .ply, .pcd, .las, .laz, .e57, .parquet, .xyz, .txt, "
    ".asc, .csv, .pts, .ptx, .npy, .bin of KITTI or nuScenes, .pcap of Velodyne or Ouster, .osf, a "
    "bag of ROS 2, or a folder of KITTI, nuScenes, WebDataset or range images"
)
# Names of the columns of rings and of intensities in other programs; the first column present is
# read.
_RING_COLUMNS = ("ring", "channel", "laser_id", "laser_number", "line", "beam")
_INTENSITY_COLUMNS = ("intensity", "reflectivity", "i")
# Intensity that Velodyne and Ouster report of a white surface at any range.
_WHITE_INTENSITY = 100.0
_VELODYNE_BYTES = (1248, 554)  # first frame of a Velodyne's .pcap: points, or a position
_HESAI_STARTS = (b"\xee\xff", b"\xff\xee")  # first bytes of a Hesai's datagrams

_CONVERSIONS = {  # {suffix of recordings that are not read: advice}
    ".bag": "it is a bag of ROS 1, convert it (rosbags-convert --src IN.bag --dst OUT)",
    ".db3": "it is a part of a bag of ROS 2, give the folder that it is in",
    ".rrd": "it is a recording of Rerun, open it with the command rerun",
    ".osi": "it is a trace of OSI, name it as the traffic of a scenario",
    **dict.fromkeys((".glb", ".gltf", ".obj", ".stl"), "it is a mesh, run a survey of it first"),
}
# Endings of clouds that may have another unit.
_UNIT_SUFFIXES = (".las", ".laz", ".ply", *(ending for ending in SCAN_READERS if ending != ".bin"))

# A sample of a .las consists of this many runs of points, which begin where chunks of a .laz begin:
# 50,000 points each, unless a program chooses otherwise.
_SAMPLE_RUNS = 40
_LAZ_CHUNK = 50_000
_SYSTEM_POINTS = 5  # of a .las whose places say where it is

_METRES: Metres = (1.0, 1.0, 1.0)


class UnknownFormatError(LidarError):
    """The format of a file or folder is not read; `advice` is a clause, or empty."""

    def __init__(self, name: str, advice: str) -> None:
        super().__init__(f"{name} is not read: {advice}give {KINDS}.")
        self.advice = advice


class SeveralSensorsError(LidarError):
    """The recording has several sensors or topics, and none is chosen."""

    def __init__(self, message: str, names: Sequence[str]) -> None:
        super().__init__(message)
        self.names = names


@dataclass(frozen=True, eq=False)
class RecordedPoints:
    """Points of a sweep, or of a part of a cloud."""

    points: Floats  # (n, 3): metres
    rings: Ints | None = None  # (n,)
    intensities: Floats | None = None  # (n,): of any scale
    rays: Ints | None = None  # (n,): keys of ray and return; None for parts of a cloud

    def __len__(self) -> int:
        return len(self.points)

    def part(self, rows: Indices) -> RecordedPoints:
        """Select points, without the keys of their rays."""
        return RecordedPoints(
            self.points[rows],
            None if self.rings is None else self.rings[rows],
            None if self.intensities is None else self.intensities[rows],
        )

    @classmethod
    def joined(cls, parts: list[RecordedPoints]) -> RecordedPoints:
        """Concatenate parts of the same recording, which have the same columns."""
        if not parts:
            return cls(np.empty((0, 3)))
        rings = [part.rings for part in parts if part.rings is not None]
        intensities = [part.intensities for part in parts if part.intensities is not None]
        return cls(
            np.concatenate([part.points for part in parts]),
            np.concatenate(rings) if rings else None,
            np.concatenate(intensities) if intensities else None,
        )


@dataclass(eq=False)
class NoiseFilter:
    """Leaves out points that a file withholds or classifies as noise, and counts them."""

    noise_classes: tuple[int, ...] = NOISE_CLASSES
    counts: dict[int, LeftOut] = field(default_factory=dict)  # {number of a sweep or part: counts}

    def usable(self, number: int, read: Read) -> Read:
        """Return a sweep or part without these points."""
        points, columns, pose = read
        usable, self.counts[number] = usable_points(columns, self.noise_classes)
        if usable is None:
            return read
        kept = {name: np.asarray(values)[usable] for name, values in columns.items()}
        return points[usable], kept, pose

    def note(self) -> str:
        """Return a sentence on the points that were left out of what was read; empty for none."""
        totals = np.sum([(0, 0), *self.counts.values()], axis=0).tolist()
        return LeftOut(*totals).note()


class FiredPoints(NamedTuple):
    """Points of a sweep as they were fired."""

    points: Floats  # (n, 3): in the sensor frame at the firing of each, metres
    columns: Columns  # (n,) each
    poses: FiringPoses  # of the sensor in the world


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording of sweeps; or a cloud without sweeps (`is_cloud`), in parts instead."""

    name: str
    count: int  # of sweeps, or of parts
    read: Callable[[int], Read]
    intensity_column: str | None = None  # if not one of `_INTENSITY_COLUMNS`
    is_cloud: bool = False
    point_count: int | None = None  # if known before the points are read
    times: Callable[[], Iterable[float]] | None = None  # start of each sweep, ns
    notes: tuple[str, ...] = ()
    thinned: bool = False  # whether hits were left out: gaps are no lost returns
    white: float | None = None  # intensity of a white surface, if it is the same at all ranges
    energies: bool = False  # whether intensities are energies, as in results
    firing_key: str = ""  # recordings with the same key have the same rays; "" for unknown
    metres: Metres = _METRES  # of the units of x, y and z
    epsg: int | None = None  # of the system that the file states, if that is in metres
    sample: Callable[[int], Read] | None = None  # reads about so many points, evenly in the file
    # Returns the poses (count, 4, 4) in the world of sweeps that are read in the sensor frame, or
    # None if they are unknown; None if the recording has no frames.
    frame_poses: Callable[[], Floats | None] | None = None
    sequence: str = ""  # name of a drive with coordinates of its own; "" for the only one
    noise_filter: NoiseFilter | None = None  # that `read` applies; None if it leaves out nothing
    # Reads a sweep as fired, with the poses of its firings; None if these are unknown.
    fired: Callable[[int], FiredPoints] | None = None

    @property
    def left_out_notes(self) -> list[str]:
        """Notes on points that were left out of what has been read."""
        note = "" if self.noise_filter is None else self.noise_filter.note()
        return [f"{self.name}: {note}"] if note else []

    def poses(self, numbers: Iterable[int]) -> Floats | None:
        """Return the poses (n, 4, 4) of sweeps in the world; None if one of these is unknown.

        LidarError if the recording cannot be read.
        """
        with reading(self.name):
            if self.frame_poses is not None and (frame_poses := self.frame_poses()) is not None:
                return np.asarray(frame_poses[list(numbers)])
            poses = []
            for number in numbers:
                _, _, pose = self.read(number)
                if pose is None:
                    return None
                poses.append(pose)
        matrices = np.array(poses, np.float64).reshape(-1, 4, 4)
        matrices[:, :3, 3] *= self.metres
        return matrices

    def without_noise(self, noise_filter: NoiseFilter) -> Recording:
        """Return the recording without points that it withholds or classifies as noise."""
        read = self.read
        sample = self.sample

        def usable_sample(max_points: int) -> Read:
            assert sample is not None
            return NoiseFilter(noise_filter.noise_classes).usable(0, sample(max_points))

        return replace(
            self,
            read=lambda number: noise_filter.usable(number, read(number)),
            sample=None if sample is None else usable_sample,
            noise_filter=noise_filter,
        )

    def read_points(self, number: int, *, in_world: bool = False) -> RecordedPoints:
        """Read a sweep, or part of a cloud, in the sensor frame or in the world frame.

        LidarError if the recording cannot be read.
        """
        with reading(self.name):
            points, columns, pose = self.read(number)
            self._check_intensity(columns)
        positions = np.asarray(points, np.float64)
        # Drivers write NaN or zeros for pulses without a return.
        valid = np.isfinite(positions).all(axis=1) & positions.any(axis=1)
        positions = positions[valid] * self.metres
        if in_world and not self.is_cloud:
            if pose is None:
                raise LidarError(
                    f"{self.name} is in the axes of its sensor, and does not say where that was: "
                    "compare it with a recording of sweeps."
                )
            positions = positions @ pose[:3, :3].T + pose[:3, 3] * self.metres
        names = _INTENSITY_COLUMNS if self.intensity_column is None else (self.intensity_column,)
        rings = rings_of(columns)
        intensities = _first_column(columns, names)
        return RecordedPoints(
            positions,
            None if rings is None else rings[valid].astype(np.int64),
            None if intensities is None else intensities[valid].astype(np.float64),
            _ray_keys(columns)[valid] if self.firing_key and not in_world else None,
        )

    def _check_intensity(self, columns: Columns) -> None:
        """Raise LidarError if the recording lacks the column that was chosen as intensity."""
        name = self.intensity_column
        if name is not None and name not in columns:
            raise LidarError(
                f"it has no column {name!r} to compare as intensity."
                + (did_you_mean(name, columns) or f" It has {', '.join(columns)}.")
            )


def open_sensors(source: str | Path, *, keep_noise: bool = False) -> dict[str, Recording]:
    """Open all sensors, or topics, of a recording, {name: recording}; "" for a single one.

    Of several sequences with coordinates of their own, the first.

    LidarError as of `open_recording`.
    """
    opened = partial(open_recording, source, keep_noise=keep_noise)
    try:
        return {"": opened()}
    except SeveralSensorsError as error:
        recordings = {name: opened(sensor=name) for name in error.names}
    sequences = list(dict.fromkeys(recording.sequence for recording in recordings.values()))
    if len(sequences) == 1:
        return recordings
    note = f"The first of {len(sequences):,} sequences is shown, {sequences[0]}."
    return {
        name: replace(recording, notes=(note,))
        for name, recording in recordings.items()
        if recording.sequence == sequences[0]
    }


def rings_of(columns: Columns) -> AnyArray | None:
    """Return the rings (n,) of points, or None without a column of rings."""
    return _first_column(columns, _RING_COLUMNS)


def _first_column(columns: Columns, names: Iterable[str]) -> AnyArray | None:
    """Return the first column (n,) that is present, or None."""
    return next((np.asarray(columns[name]) for name in names if name in columns), None)


def open_recording(
    source: str | Path | Cloud | StoredCloud,
    sensor: str | None = None,
    intensity: str | None = None,
    name: str = "the cloud",
    unit: str | None = None,
    keep_noise: bool = False,
) -> Recording:
    """Open a cloud or recording: `KINDS`; or a cloud in memory, which has sweeps if of a result.

    `sensor` chooses one of several sensors, or the topic of a bag; `intensity` is the column of the
    intensity, if not one of the usual names; `name` is that of a cloud in memory; `unit` is that of
    a file of `_UNIT_SUFFIXES`, in place of metres or of the units that a .las states; without
    `keep_noise`, points that a file withholds or classifies as noise are left out. LidarError if
    the source is none of these, cannot be opened, or has lengths that are not true.
    """
    if isinstance(source, Cloud | StoredCloud):
        if unit is not None:
            raise LidarError(f"{name} is in metres: leave out its unit, {unit!r}.")
        return _open_cloud(name, source, source.sweeps, sensor, intensity)
    path = Path(source)
    name = str(source)
    if unit is not None and path.suffix.lower() not in _UNIT_SUFFIXES:
        raise LidarError(
            f"{name} is in metres: leave out its unit, {unit!r}, which is for a file "
            f"{' '.join(_UNIT_SUFFIXES)}."
        )
    recording = _open_path(path, name, sensor, intensity, unit)
    noise_filter = recording.noise_filter
    if keep_noise or noise_filter is None:
        return replace(recording, noise_filter=None)
    return recording.without_noise(noise_filter)


def _open_path(
    path: Path, name: str, sensor: str | None, intensity: str | None, unit: str | None
) -> Recording:
    """Open a file or folder; `unit` replaces the units that a file states."""
    if not path.exists():
        raise LidarError(f"{name} does not exist: give {KINDS}.")
    if path.is_file() and not path.stat().st_size:
        raise LidarError(f"{name} is empty (0 bytes): give {KINDS}.")
    if path.is_dir():
        recording = _open_folder(path, name, sensor, intensity)
    else:
        recording = _open_file(path, name, sensor, intensity, unit)
    if recording is not None:
        return recording
    suffix = path.suffix.lower()
    advice = f"{_CONVERSIONS[suffix]}, or " if suffix in _CONVERSIONS else ""
    raise UnknownFormatError(name, advice)


def _open_folder(
    path: Path, name: str, sensor: str | None, intensity: str | None
) -> Recording | None:
    """Open the folder of a result, a data set, a bag or .pcd files; return None for the rest."""
    if (path / "cloud.ply").exists():
        return _open_ply(path / "cloud.ply", name, sensor, intensity)
    if (path / INDEX_FILE).exists():
        return _open_data_set(path, name, sensor, intensity)
    if (path / "metadata.yaml").exists():
        return _open_bag(path, name, sensor, intensity)
    files = [file for file in path.iterdir() if file.suffix.lower() == ".pcd"]
    if files:
        return _open_pcd(sorted(files, key=lambda file: natural(file.name)), name, intensity)
    if next(path.rglob("*.parquet"), None) is not None:
        return _open_sweep_files(name, {"": partial(open_parquet, path, name)}, sensor, intensity)
    with reading(name):
        sensors = _sensors_of_folder(path)
    openers = {key: partial(_itself, files) for key, files in sensors.items()}
    return _open_sweep_files(name, openers, sensor, intensity) if sensors else None


def _sensors_of_folder(path: Path) -> dict[str, SweepFiles]:
    """Return the sweeps of each sensor of a folder with many files; empty for other folders."""
    if tables := nuscenes_tables(path):
        return open_nuscenes(path, tables)
    if sensors := open_kitti(path):
        return sensors
    if tars := sorted(path.rglob("*.tar")):
        return open_webdataset(tars)
    return open_images(path)


def _itself(files: SweepFiles) -> SweepFiles:
    return files


def _open_sweep_files(
    name: str,
    openers: Mapping[str, Callable[[], SweepFiles]],
    sensor: str | None,
    intensity: str | None,
) -> Recording:
    """Open the files of one of several sensors."""
    opener = openers[_choose(name, "sensors", openers, sensor)]
    with reading(name):
        files = opener()
    times_ns = files.times_ns
    times = None if times_ns is None else times_ns.tolist
    is_cloud = files.point_count is not None
    return Recording(
        name,
        files.sweeps,
        files.read,
        intensity,
        is_cloud,
        files.point_count,
        times=times,
        notes=tuple(f"{name} {note}" for note in files.notes),
        sequence=files.sequence,
        epsg=files.epsg,
    )


def _open_file(
    path: Path, name: str, sensor: str | None, intensity: str | None, unit: str | None
) -> Recording | None:
    """Open a file by its suffix; None if its format is not read."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return _open_ply(path, name, sensor, intensity, unit)
    if suffix == ".pcd":
        metres, _ = stated_metres(None, np.zeros((0, 3)), unit)
        return replace(_open_pcd([path], name, intensity), metres=metres)
    if suffix in (".las", ".laz"):
        return _open_las(path, name, intensity, unit)
    if suffix == ".ptx":
        return _open_ptx(path, name, intensity, unit)
    if suffix in SCAN_READERS and suffix != ".bin":
        return _open_scans(path, name, intensity, unit)
    if suffix == ".mcap":
        return _open_bag(path, name, sensor, intensity)
    if suffix in (".osf", ".pcap"):
        return _open_packets(path, name, sensor, intensity)
    if suffix == ".tar":
        with reading(name):
            sensors = open_webdataset([path])
        openers = {key: partial(_itself, files) for key, files in sensors.items()}
        return _open_sweep_files(name, openers, sensor, intensity)
    opener = {
        ".e57": partial(open_e57, path, name),
        ".parquet": partial(open_parquet, path, name),
        ".bin": partial(open_kitti_file, path),
    }.get(suffix)
    return None if opener is None else _open_sweep_files(name, {"": opener}, sensor, intensity)


def _open_packets(path: Path, name: str, sensor: str | None, intensity: str | None) -> Recording:
    """Open packets of a Velodyne or an Ouster; LidarError for those of a Hesai."""
    with reading(name), open_input(path) as file:
        head = file.read(84)
    if int.from_bytes(head[32:36], "little") in _VELODYNE_BYTES:
        return _open_velodyne(path, name, intensity)
    if head[82:] in _HESAI_STARTS:
        raise LidarError(
            f"{name} has packets of a Hesai, which are not read: write points of them as .pcd with "
            "Hesai's SDK."
        )
    return _open_ouster(path, name, sensor, intensity)


def _open_cloud(
    name: str,
    cloud: CloudLike,
    load_sweeps: Callable[[], Sweeps] | None,
    sensor: str | None,
    intensity: str | None,
    **fields: Any,
) -> Recording:
    """Open a cloud of lidarpool, in parts or as the sweeps of a sensor.

    `load_sweeps` is None for a cloud without sweeps; `fields` are those of `Recording`.
    """
    if load_sweeps is None:

        def read_part(number: int) -> Read:
            chunk = next(cloud.chunks(CHUNK_POINTS, number * CHUNK_POINTS))
            return chunk.positions, chunk.columns, None

        parts = -(-len(cloud) // CHUNK_POINTS)
        return Recording(name, parts, read_part, intensity, True, len(cloud), **fields)
    saved = load_sweeps()
    sensor_index = saved.sensors.index(_choose(name, "sensors", saved.sensors, sensor))
    indices = np.flatnonzero(saved.sensor == sensor_index).tolist()

    def read_sweep(number: int) -> Read:
        index = indices[number]
        points = next(saved.points(cloud, index, index + 1))
        return saved.in_sensor(index, points.positions), points.columns, saved.pose.matrix(index)

    def read_fired(number: int) -> FiredPoints:
        index = indices[number]
        points = next(saved.points(cloud, index, index + 1))
        positions = saved.as_fired(index, points)
        return FiredPoints(positions, points.columns, saved.firing_poses(index, points))

    def frame_poses() -> Floats:
        return np.array([saved.pose.matrix(index) for index in indices])

    times = saved.begins_ns[indices] + (saved.start_ns or 0)
    fields["energies"] = intensity in (None, "intensity")
    columns = {column.name for column in cloud.table}
    if ray_columns := columns & {"time", "ray"}:
        poses = saved.pose.positions[indices], saved.pose.quaternions[indices]
        key = max(ray_columns), "return_number" in columns  # time rather than ray: `_ray_keys`
        fields["firing_key"] = fingerprint(
            key, saved.scans[indices], saved.begins_ns[indices], poses
        )
    fields |= {"times": lambda: times, "frame_poses": frame_poses, "fired": read_fired}
    return Recording(name, len(indices), read_sweep, intensity, **fields)


def _ray_keys(columns: Columns) -> Ints:
    """Return keys (n,) that differ for all rays of a sweep, and for all returns of a ray."""
    if "time" in columns:
        rays = columns["time"].astype(np.int64) << 16 | columns["channel"]
    else:
        rays = columns["scan"].astype(np.int64) << 32 | columns["ray"]
    _, first, ray = np.unique(rays, return_index=True, return_inverse=True)
    order: Ints = np.arange(len(rays)) - first[ray]  # returns of a ray are together
    return rays << 8 | columns.get("return_number", order)


def _open_ply(
    path: Path, name: str, sensor: str | None, intensity: str | None, unit: str | None = None
) -> Recording:
    """Open a .ply, with the file of sweeps beside the .ply of a result."""
    try:
        cloud = CloudFile(path)
    except LidarError:  # text, or of another program
        return _open_foreign_ply(path, name, intensity, unit)
    metres, _ = stated_metres(None, np.zeros((0, 3)), unit)
    return replace(_open_ply_cloud(path, name, cloud, sensor, intensity), metres=metres)


def _open_foreign_ply(path: Path, name: str, intensity: str | None, unit: str | None) -> Recording:
    """Open a .ply of another program, or of text, in the units of the system that it states."""

    def read(_: int) -> Read:
        columns = with_usual_names(read_ply_columns(read_input(path)))
        return _positions(columns), columns, None

    system = None
    with reading(name):
        data = read_input(path)
        system = StatedSystem.of_comments(ply_comments(data))
        positions = (
            np.zeros((0, 3))
            if system is None
            else _positions(with_usual_names(read_ply_columns(data)))
        )
        metres, notes = stated_metres(system, positions, unit)
    return Recording(
        name,
        1,
        read,
        intensity,
        is_cloud=True,
        notes=tuple(f"{name} {note}" for note in notes),
        metres=metres,
        epsg=_epsg_in_metres(system, metres, unit),
        noise_filter=NoiseFilter(),
    )


def _epsg_in_metres(system: StatedSystem | None, metres: Metres, unit: str | None) -> int | None:
    """Return the EPSG code of a stated system; None if `unit` replaces its units, or in feet."""
    return None if system is None or unit is not None or metres != _METRES else system.epsg


def _open_ply_cloud(
    path: Path, name: str, cloud: CloudFile, sensor: str | None, intensity: str | None
) -> Recording:
    """Open a .ply of lidarpool, with the file of sweeps beside the .ply of a result."""
    if not (sweeps_path := path.with_name(SWEEPS_FILE)).exists():
        return _open_cloud(name, cloud, None, sensor, intensity)
    try:
        report = json.loads(read_input(path.with_name("report.json")))
        keep_every = int(report["parameters"]["keep_every"])
    except (OSError, ValueError, TypeError, LookupError, LidarError):
        keep_every = 1
    note = (
        f"{name} keeps one of {keep_every} hits, so its gaps are no lost returns: run it with "
        "keep_every 1 to compare these"
    )
    fields = {"notes": (note,), "thinned": True} if keep_every > 1 else {}
    return _open_cloud(name, cloud, partial(Sweeps.load, sweeps_path), sensor, intensity, **fields)


def _open_data_set(path: Path, name: str, sensor: str | None, intensity: str | None) -> Recording:
    """Open the sweeps of a data set."""
    saved = sweeps(path, sensors=None if sensor is None else [sensor])

    def read(number: int) -> Read:
        sweep = saved[number]
        return sweep.points, sweep.columns, sweep.pose

    return Recording(name, len(saved), read, intensity)


def _open_pcd(files: list[Path], name: str, intensity: str | None) -> Recording:
    """Open files of a sweep each; VIEWPOINT has the pose of the sensor."""

    def read(number: int) -> Read:
        path = files[number]
        with reading(path.name) if len(files) > 1 else nullcontext():
            (scan,) = read_pcd(path)
        return scan.positions, scan.columns, scan.pose

    return Recording(name, len(files), read, intensity, noise_filter=NoiseFilter())


def _open_ptx(path: Path, name: str, intensity: str | None, unit: str | None) -> Recording:
    """Open the scans of a .ptx, each in the frame of its scanner."""
    with reading(name):
        scans = read_ptx(path)

    def read(number: int) -> Read:
        scan = scans[number]
        return scan.positions, scan.columns, scan.pose

    metres, _ = stated_metres(None, np.zeros((0, 3)), unit)
    return Recording(name, len(scans), read, intensity, metres=metres)


def _open_scans(path: Path, name: str, intensity: str | None, unit: str | None) -> Recording:
    """Open a cloud whose file is read at once; `unit` replaces the units that its header names.

    Of several clouds in a file, the columns that all have are read.
    """
    metres, _ = stated_metres(None, np.zeros((0, 3)), unit)

    def read(_: int) -> Read:
        scans = SCAN_READERS[path.suffix.lower()](path)
        units_m = _METRES if unit is not None else scans[0].units_m or _METRES
        shared = set.intersection(*(set(scan.columns) for scan in scans))
        columns = {
            column: np.concatenate([scan.columns[column] for scan in scans])
            for column in scans[0].columns
            if column in shared
        }
        return np.concatenate([scan.positions for scan in scans]) * units_m, columns, None

    return Recording(
        name, 1, read, intensity, is_cloud=True, metres=metres, noise_filter=NoiseFilter()
    )


def _open_las(path: Path, name: str, intensity: str | None, unit: str | None) -> Recording:
    """Open the points of a .las or .laz; `unit` replaces the units that the file states."""
    with reading(name):
        system = las_system(path)
        with open_las(path) as reader:
            count = reader.header.point_count
            classes = noise_classes(reader.header)
            places = np.zeros((0, 3)) if system is None else _some_positions(reader, count)
        metres, notes = stated_metres(system, places, unit)

    def read_run(reader: LasReader, start: int, length: int) -> Read:
        reader.seek(start)
        points = reader.read_points(length)
        if len(points) != length:
            raise CutShortError(f"{count:,} points announced, and there are fewer")
        columns = {name: np.asarray(points[name]) for name in points.point_format.dimension_names}
        return np.stack([points.x, points.y, points.z], axis=1), columns, None

    def read(number: int) -> Read:
        start = number * CHUNK_POINTS
        with open_las(path) as reader:
            return read_run(reader, start, min(CHUNK_POINTS, count - start))

    def sample(max_points: int) -> Read:
        length = min(max_points // _SAMPLE_RUNS, count // _SAMPLE_RUNS)
        starts = np.linspace(0, count - length, _SAMPLE_RUNS) // _LAZ_CHUNK * _LAZ_CHUNK
        with open_las(path) as reader:
            runs = [read_run(reader, int(start), length) for start in starts]
        columns = {name: np.concatenate([run[1][name] for run in runs]) for name in runs[0][1]}
        return np.concatenate([run[0] for run in runs]), columns, None

    parts = -(-count // CHUNK_POINTS)
    return Recording(
        name,
        parts,
        read,
        intensity,
        True,
        count,
        notes=tuple(f"{name} {note}" for note in notes),
        metres=metres,
        epsg=_epsg_in_metres(system, metres, unit),
        sample=sample,
        noise_filter=NoiseFilter(classes),
    )


def _some_positions(reader: LasReader, count: int) -> Floats:
    """Return the positions (k, 3) of a few points, evenly in a file."""
    positions = []
    for number in np.unique(np.linspace(0, count - 1, _SYSTEM_POINTS).astype(int)).tolist():
        if 0 <= number < count:
            reader.seek(number)
            point = reader.read_points(1)
            positions.append([point.x[0], point.y[0], point.z[0]])
    return np.reshape(np.array(positions, np.float64), (-1, 3))


def _open_bag(path: Path, name: str, topic: str | None, intensity: str | None) -> Recording:
    """Open a topic of PointCloud2: each message is a sweep in the frame of the message.

    CustomMsg of Livox is read where a bag has no PointCloud2, or its topic is chosen.
    """
    bag = open_bag(path, name)
    clouds = {
        connection.topic: connection
        for connection in bag.connections
        if connection.msgtype == POINT_CLOUD
    }
    livox_clouds = {
        connection.topic: connection
        for connection in bag.connections
        if connection.msgtype in LIVOX_CLOUDS
    }
    topics = livox_clouds if topic in livox_clouds else clouds or livox_clouds
    connection = topics[_choose(name, "topics of PointCloud2", topics, topic)]
    messages = partial(bag.messages, [connection])
    columns_of = livox_columns if topics is livox_clouds else point_columns

    def points(message: Any) -> Read:
        columns = columns_of(message[2])
        return _positions(columns), columns, None

    def times() -> Iterator[float]:
        return (time for _, time, _ in messages())

    def frame_poses() -> Floats | None:
        return sweep_poses(path, (data for _, _, data in messages()))

    return _open_stream(
        name,
        messages,
        points,
        intensity,
        connection.msgcount,
        times=times,
        frame_poses=frame_poses,
    )


def _open_ouster(path: Path, name: str, sensor: str | None, intensity: str | None) -> Recording:
    """Open scans of ouster-sdk; a .json beside a .pcap has the metadata."""
    if (
        find_spec("ouster") is None
    ):  # ouster-sdk requires old versions of packages it can do without
        raise LidarError(f"{name} is read by ouster-sdk: pip install --no-deps ouster-sdk.")
    sdk: Any = import_module("ouster.sdk")
    with reading(name):
        input_size(path)
        if (metadata := path.with_suffix(".json")).exists():
            input_size(metadata)
        infos = sdk.open_source(str(path)).sensor_info
        sensors = [f"{info.prod_line} {info.sn}".strip() for info in infos]
    index = sensors.index(_choose(name, "sensors", sensors, sensor))
    compute_positions = import_module("ouster.sdk.core").XYZLut(infos[index], False)

    def scans() -> Iterator[Any]:
        source = sdk.open_source(str(path))
        return (scans[index] for scans in source if scans[index] is not None)

    def points(scan: Any) -> Read:
        ring, column = np.nonzero(scan.field("RANGE"))
        columns = {"ring": ring}
        for field_name in {"REFLECTIVITY", "SIGNAL", "NEAR_IR"}.intersection(scan.fields):
            columns[field_name.lower()] = scan.field(field_name)[ring, column]
        return compute_positions(scan)[ring, column], columns, None

    def times() -> Iterator[float]:
        for scan in scans():
            stamps = scan.timestamp[scan.timestamp > 0]
            yield float(stamps.min()) if len(stamps) else 0.0

    white = _WHITE_INTENSITY if intensity in (None, "reflectivity") else None
    return _open_stream(name, scans, points, intensity, white=white, times=times)


def _open_velodyne(path: Path, name: str, intensity: str | None) -> Recording:
    """Open the packets of a Velodyne, which contain the model of the sensor."""
    need("velodyne_decoder", "fit", f"{name} is read")
    decoder: Any = import_module("velodyne_decoder")
    with reading(name), open_input(path) as file:
        file.seek(24)
        headers = iter(partial(file.read, 16), b"")
        frames = (file.read(int.from_bytes(header[8:12], "little")) for header in headers)
        packets = (frame for frame in frames if len(frame) == _VELODYNE_BYTES[0])
        units = {(*packet[26:30], int.from_bytes(packet[36:38])) for packet in packets}
    if len(units) > 1:
        a, b, c, d, port = min(units)
        command = f"tcpdump -r {name} -w one.pcap src {a}.{b}.{c}.{d} and dst port {port}"
        raise LidarError(f"{name} is of {len(units)} units: keep one, {command}.")

    def points(sweep: Any) -> Read:
        columns = {name: sweep.points[name] for name in sweep.points.dtype.names}
        return _positions(columns), columns, None

    sweeps = partial(decoder.read_pcap, str(path), as_pcl_structs=True)

    def times() -> Iterator[float]:
        return (1e9 * sweep.stamp.host for sweep in sweeps())

    white = None if intensity else _WHITE_INTENSITY
    return _open_stream(name, sweeps, points, intensity, white=white, times=times)


def _open_stream(
    name: str,
    sweeps: Callable[[], Iterable[Any]],
    points: Callable[[Any], Read],
    intensity: str | None,
    count: int | None = None,
    **fields: Any,
) -> Recording:
    """Open a recording whose `sweeps()` can be iterated from the first sweep only.

    `points` converts a sweep; `count` is the number of sweeps, which are counted if it is None;
    `fields` are those of `Recording`.
    """
    if count is None:
        with reading(name):
            count = sum(1 for _ in sweeps())
    next_number = 0
    remaining: Iterator[Any] = iter(())  # sweeps from `next_number`

    def read(number: int) -> Read:
        nonlocal next_number, remaining
        if not 0 < next_number <= number:
            next_number = 0
            remaining = iter(sweeps())
        sweep = next(islice(remaining, number - next_number, None))
        next_number = number + 1
        return points(sweep)

    return Recording(name, count, read, intensity, **fields)


def _positions(columns: Columns) -> Floats:
    """Return the positions (n, 3) in columns x, y and z; ValueError without these."""
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its points have no {', '.join(missing)}")
    return np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], axis=1)


def _choose(name: str, kind: str, names: Iterable[str], chosen: str | None) -> str:
    """Return the chosen sensor or topic, or the only sensor or topic; else raise LidarError.

    `kind` is the plural, such as "sensors"; `name` is that of the recording.
    """
    available = list(names)
    if chosen is None and len(available) == 1:
        return available[0]
    if chosen is not None and chosen in available:
        return chosen
    listed = f"has the {kind} {', '.join(available)}" if available else f"has no {kind}"
    if available == [""]:
        listed = f"has no names of {kind}: give none"
    if chosen is None and available:
        advice = "choose one (--sensor-a, --sensor-b; of fit --sensor)"
        raise SeveralSensorsError(f"{name} {listed}: {advice}.", available)
    if chosen is None:
        raise LidarError(f"{name} {listed}: record one.")
    hint = did_you_mean(chosen, available)
    raise LidarError(f"{name} does not have {chosen!r}.{hint} It {listed}.")
