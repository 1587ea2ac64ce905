"""Views of recordings and clouds of other programs, held in memory."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats
from lidarsim.base.errors import LidarError
from lidarsim.base.extras import reading
from lidarsim.base.words import plural
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import TABLE, Column, Kind, Scale
from lidarsim.motion.rotations import quaternions_of
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps
from lidarview.viewer.point_selection import STATION, HeldPoints, OrderedPoints, Points
from lidarview.viewer.view import Downloads, GrowingView, View

from ...clouds.recording import Recording

MAX_POINTS = 20_000_000  # points of a recording, in memory
LARGE_POINTS = 2_000_000  # a larger cloud is shown by a sample while it is read
_SAMPLE_POINTS = 200_000
_GROWING_POINTS = 1_000_000  # points that are shown before all are read, beside the sample
# Receives positions (n, 3) and columns of a part of a cloud, and the share that has been read.
OnPart = Callable[[Floats, Mapping[str, AnyArray], float], None]
_SWEEP_NS = 1e8  # assumed from sweep to sweep if the recording has no times
_RINGS = ("ring", "laser_id", "laser_number", "line", "beam")  # names of the column `channel`
_NAMES = {"classification": "class", "label": "class", "NormalX": "normal_x", "NormalY": "normal_y"}
_NAMES |= {"NormalZ": "normal_z", "energy": "intensity"}
# Classes of ASPRS LAS 1.4 by their numbers.
ASPRS_CLASSES = (
    "never classified", "unassigned", "ground", "low vegetation", "medium vegetation",
    "high vegetation", "building", "low point", "", "water", "rail", "road surface", "",
    "wire guard", "wire conductor", "transmission tower", "wire connector", "bridge deck",
    "high noise",
)  # fmt: skip


@dataclass(eq=False)
class Pieces:
    """Points of sweeps, or of parts of a cloud, in memory."""

    positions: list[Floats] = field(default_factory=list)
    columns: list[Mapping[str, AnyArray]] = field(default_factory=list)
    count: int = 0
    _used: set[str] = field(default_factory=set)  # columns with other values than zeros

    def add(self, positions: Floats, columns: Mapping[str, AnyArray]) -> None:
        """Add points at finite positions (n, 3), with the columns of a number for each point."""
        arrays = {name: np.asarray(values) for name, values in columns.items()}
        arrays = {
            name: values
            for name, values in arrays.items()
            if values.shape == (len(positions),) and values.dtype.kind in "biuf"
        }
        valid = np.asarray(np.isfinite(positions).all(axis=1))
        if not valid.all():
            positions = positions[valid]
            arrays = {name: values[valid] for name, values in arrays.items()}
        self.positions.append(positions)
        self.columns.append(arrays)
        self.count += len(positions)
        self._used |= {
            name for name in arrays.keys() - self._used if arrays[name].any()
        }  # zeros take long to be looked at, and are not joined

    def cloud(self, **columns: AnyArray) -> Cloud:
        """Join the points with the columns that all pieces have, and further columns.

        Pieces without points may lack columns.
        """
        if not self.positions:
            return Cloud(np.zeros((0, 3)), columns)
        pairs = zip(self.positions, self.columns, strict=True)
        filled = [piece for positions, piece in pairs if len(positions)] or self.columns
        shared = set.intersection(*({*piece} for piece in filled))
        joined = {
            name: np.concatenate([piece[name] for piece in filled])
            for name in filled[0]
            if name in shared & self._used
        }
        joined = _with_known_names(joined, shared) | columns
        custom = tuple(_described(name, array) for name, array in joined.items())
        return Cloud(np.concatenate(self.positions), joined, custom)


def _with_known_names(
    columns: Mapping[str, AnyArray], all_names: Collection[str]
) -> dict[str, AnyArray]:
    """Return columns by the names of lidarpool, without coordinates.

    `all_names` are the names in the recording, with columns that are left out.
    """
    named: dict[str, AnyArray] = {}
    for name, values in columns.items():
        if name == "rgb":  # a column of PCL: bytes in the bits of a float
            bits = values.astype(np.float32).view(np.uint32) if values.dtype.kind == "f" else values
            for color, shift in (("red", 16), ("green", 8), ("blue", 0)):
                named[color] = ((bits >> shift) & 255).astype(np.uint8)
            continue
        known_name = "channel" if name in _RINGS else _NAMES.get(name, name)
        known_name = re.sub(r"\W", "_", known_name)
        known_name = known_name if known_name.isidentifier() else f"_{known_name}"
        is_new = known_name not in all_names or known_name == name
        if known_name.lower() not in "xyz" and is_new:
            # Bytes in the order of this machine; True and False as numbers.
            kind = np.dtype(np.uint8) if values.dtype == np.bool_ else values.dtype
            named[known_name] = values.astype(kind.newbyteorder("="))
    if "return_number" in named and "number_of_returns" in named:
        named["returns"] = named.pop("number_of_returns")
    return named


def _described(name: str, values: AnyArray) -> Column:
    """Return the description of a column, of the table if it has values of that type."""
    known = TABLE.get(name)
    if known is not None and np.dtype(known.dtype) == values.dtype:
        return known
    is_label = known is not None and known.kind == "label" and values.dtype.kind in "iu"
    scale: Scale = "linear" if known is None else known.scale
    kind: Kind = "label" if is_label else "number"
    return Column(name, values.dtype.name, "", "", kind=kind, scale=scale)


def recorded_view(
    sensors: Mapping[str, Recording],
    title: str,
    downloads: Downloads | None,
    on_part: OnPart = lambda *_: None,
) -> View:
    """Return the view of the sensors of a recording, {name: recording}, with a player of sweeps.

    `on_part` is called with each part of a cloud that was read.

    LidarError if a recording is damaged, or has no points.
    """
    first = next(iter(sensors.values()))
    notes = [*dict.fromkeys(note for recording in sensors.values() for note in recording.notes)]
    if first.is_cloud:
        cloud = _cloud_of(first, on_part)
        sweeps = None
        notes += first.left_out_notes
    else:
        cloud, sweeps, further_notes = _sweeps_of(sensors)
        notes += further_notes
    if not len(cloud):
        left_out = "".join(f" {note}." for note in first.left_out_notes)
        raise LidarError(f"{first.name} contains no points.{left_out}")
    names: dict[str, Sequence[str]] = {}
    if first.name.lower().endswith((".las", ".laz")):
        names["class"] = ASPRS_CLASSES
    if sweeps is not None and sweeps.station_numbers.any():
        names[STATION.name] = _station_names(first, sweeps)
    return View(
        OrderedPoints(cloud),
        None,
        sweeps,
        " ".join(notes),
        title,
        downloads=downloads,
        names=names,
        stated_epsg=first.epsg,
    )


def _station_names(recording: Recording, sweeps: Sweeps) -> list[str]:
    """Return the names of the stations 0 (none), 1, 2, …, with "" for unnamed stations."""
    numbers = sweeps.station_numbers.tolist()
    names = [""] * (max(numbers) + 1)
    for number, name in zip(numbers, recording.stations, strict=False):  # some may not be read
        names[number] = names[number] or name
    return names


def sampled_view(recording: Recording, title: str) -> tuple[View, Pieces]:
    """Return the view of a sample of a cloud that has `Recording.sample`, and its points.

    The sample consists of runs of points, which are read within a second.
    """
    pieces = Pieces()
    assert recording.sample is not None
    with reading(recording.name):
        positions, columns, _ = recording.sample(_SAMPLE_POINTS)
        pieces.add(positions * recording.meters, columns)
    names = {"class": ASPRS_CLASSES}
    view = View(
        HeldPoints(pieces.cloud()),
        note=" ".join(recording.notes),
        title=title,
        names=names,
        stated_epsg=recording.epsg,
    )
    return view, pieces


def growing_view(recording: Recording, title: str, read: Callable[[OnPart], View]) -> GrowingView:
    """Return a view that shows a sample of a cloud, and more points while `read` reads all."""
    total = recording.point_count or 0
    sampled, pieces = sampled_view(recording, title)
    step = -(-total // _GROWING_POINTS)

    def grow(show: Callable[[Points, float], None]) -> View:
        def on_part(positions: Floats, columns: Mapping[str, AnyArray], share: float) -> None:
            pieces.add(positions[::step], {name: v[::step] for name, v in columns.items()})
            show(HeldPoints(pieces.cloud()), share)

        return read(on_part)

    return GrowingView(sampled, total, grow)


def _cloud_of(recording: Recording, on_part: OnPart) -> Cloud:
    """Read a cloud.

    Of a large cloud, take one point in a few.
    """
    total = recording.point_count or 0
    step = max(1, -(-total // MAX_POINTS))
    pieces = Pieces()
    for number in range(recording.count):
        with reading(recording.name):
            positions, columns, _ = recording.read(number)
            positions = np.asarray(positions, np.float64)[::step]
            if recording.meters != (1.0, 1.0, 1.0):
                positions = positions * recording.meters
            columns = {name: np.asarray(values)[::step] for name, values in columns.items()}
            pieces.add(positions, columns)
        on_part(positions, columns, (number + 1) / recording.count)
    return pieces.cloud()


@dataclass(frozen=True, eq=False)
class _TimedSweep:
    """A sweep of a recording, before it is read."""

    begins_ns: float
    sensor: int
    number: int


def _order(sensors: Sequence[Recording]) -> tuple[list[_TimedSweep], bool]:
    """Return the sweeps of all sensors in the order of times, and whether the times are known."""
    sweeps: list[_TimedSweep] = []
    is_timed = True
    for sensor, recording in enumerate(sensors):
        times: Sequence[float] = [] if recording.times is None else [*recording.times()]
        if len(times) < recording.count:
            is_timed = False
            times = [_SWEEP_NS * number for number in range(recording.count)]
        sweeps += [
            _TimedSweep(float(times[number]), sensor, number) for number in range(recording.count)
        ]
    start_ns = min((sweep.begins_ns for sweep in sweeps), default=0.0)
    ordered = sorted(sweeps, key=lambda sweep: (sweep.begins_ns, sweep.sensor))
    return [
        _TimedSweep(sweep.begins_ns - start_ns, sweep.sensor, sweep.number) for sweep in ordered
    ], is_timed


def _sweeps_of(sensors: Mapping[str, Recording]) -> tuple[Cloud, Sweeps, list[str]]:
    """Read sweeps until memory is full, and return their points, the sweeps, and notes."""
    recordings = [*sensors.values()]
    ordered, is_timed = _order(recordings)
    pieces = Pieces()
    frame_poses = [_frame_poses(recording) for recording in recordings]
    if any(sensor_poses is None for sensor_poses in frame_poses):
        frame_poses = [None] * len(recordings)  # sensors without a pose fit no others
    poses: list[Floats | None] = []
    for sweep in ordered:
        sensor_poses = frame_poses[sweep.sensor]
        pose = None if sensor_poses is None else sensor_poses[sweep.number]
        poses.append(_add_sweep(pieces, recordings[sweep.sensor], sweep.number, pose))
        if pieces.count > MAX_POINTS:
            break
    notes = []
    if len(poses) < len(ordered):
        notes.append(f"Only the first {len(poses):,} of {plural(len(ordered), 'sweep')} are shown.")
    are_stations = all(recording.stations for recording in recordings)
    if not is_timed and len(ordered) > 1 and not are_stations:
        notes.append("The recording contains no times. A rate of 10 sweeps per second is assumed.")
    counts = [len(positions) for positions in pieces.positions]
    cloud = pieces.cloud(scan=np.repeat(np.arange(len(counts), dtype=np.int32), counts))
    sweeps = recorded_sweeps(ordered[: len(poses)], poses, [*sensors])
    return cloud, replace(sweeps, stations=len(sweeps) if are_stations else 1), notes


def _frame_poses(recording: Recording) -> Floats | None:
    """Return the poses (n, 4, 4) of sweeps by the frames of a bag, or None."""
    if recording.frame_poses is None:
        return None
    with reading(recording.name):
        return recording.frame_poses()


def _add_sweep(
    pieces: Pieces, recording: Recording, number: int, frame_pose: Floats | None
) -> Floats | None:
    """Read a sweep into the world frame, if its pose is known, and return the pose.

    `frame_pose` is the pose of a sweep without a pose.
    """
    with reading(recording.name):
        positions, columns, pose = recording.read(number)
        pose = frame_pose if pose is None else pose
        local = np.asarray(positions, np.float64) * recording.meters
    is_return = local.any(axis=1)  # drivers write zeros for pulses without a return
    local = local[is_return]
    if pose is not None:
        local = local @ pose[:3, :3].T + pose[:3, 3]
    pieces.add(local, {name: np.asarray(values)[is_return] for name, values in columns.items()})
    return pose


def recorded_sweeps(
    ordered: Sequence[_TimedSweep], poses: Sequence[Floats | None], names: Sequence[str]
) -> Sweeps:
    """Return sweeps of one scan each, without actors.

    `names` are the names of the sensors.
    """
    known = [np.eye(4) if pose is None else pose for pose in poses]
    matrices = np.array(known, np.float64).reshape(-1, 4, 4)
    count = len(ordered)
    begins_ns = np.array([sweep.begins_ns for sweep in ordered])
    still = SweepPoses(np.zeros((len(names), 3)), np.tile([0.0, 0, 0, 1], (len(names), 1)))
    return Sweeps(
        scans=np.arange(count + 1),
        begins_ns=begins_ns,
        ends_ns=begins_ns,
        sensor=np.array([sweep.sensor for sweep in ordered], np.uint8),
        pose=SweepPoses(matrices[:, :3, 3], quaternions_of(matrices[:, :3, :3])),
        mounts=still,
        sensors=tuple(names),
        objects=(),
        actors=(),
        actor_poses=SweepPoses(np.zeros((0, count, 3)), np.zeros((0, count, 4))),
        actor_velocities=np.zeros((0, count, 3)),
        actor_bounds=np.zeros((0, 2, 3)),
        actor_there=np.zeros((0, count), np.bool_),
        actor_comes=np.zeros((0, count), np.bool_),
        actor_leaves=np.zeros((0, count), np.bool_),
        coordinates="sensor" if any(pose is None for pose in poses) else "world",
        precision_m=0.001,
    )
