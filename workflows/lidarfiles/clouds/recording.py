"""Recordings in any file format. A recording consists of sweeps, or of parts of a cloud.

When an item is read, its columns get standard names, its positions are converted to meters, the
chosen column becomes the intensity, and withheld points are omitted. Rings and point times that a
file does not specify are determined from a few sweeps on first use.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import numpy as np

from lidarsim.columns.cloud import CHUNK_POINTS, CloudLike
from lidarsim.columns.column_names import STRENGTHS, with_standard_names
from lidarsim.columns.sweep import Columns, Sweep
from lidarsim.environment.extras import reading
from lidarsim.errors import CutShortError, LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.files.noise_points import NOISE_CLASSES, OmittedPoints, usable_points
from lidarsim.scene.files.pcd import split_rgb
from lidarsim.scene.files.stated_system import Meters, StatedSystem, stated_meters
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import did_you_mean, join_names, plural

from ..identity.fingerprint import fingerprint
from ..processes.per_process import PerProcess
from .point_times import PointTimes
from .recorded_boxes import RecordedBoxes
from .rings import Rings

METERS: Meters = (1.0, 1.0, 1.0)
_MAX_POSE_ERROR_M = 10.0  # maximum error of a measured trajectory for which rays can be paired
_MAX_ROTATION_ERROR = 0.01  # maximum deviation of the dot products of the axes of a pose
_REFERENCE_SWEEPS = 5  # number of sweeps that determine rings and point times


def _check_poses(poses: Floats, numbers: Sequence[int]) -> None:
    """Raise ValueError unless the poses (n, 4, 4) of some sweeps are rotations and translations."""
    broken = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
    if len(broken):
        raise ValueError(
            f"the pose of sweep {numbers[broken[0]]} is not finite. Correct the pose, or remove "
            "the poses from the recording"
        )
    rotations = poses[:, :3, :3]
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((errors > _MAX_ROTATION_ERROR) | (np.linalg.det(rotations) < 0))
    if len(wrong):
        raise ValueError(
            f"the pose of sweep {numbers[wrong[0]]} is scaled, skewed or mirrored, but a pose "
            "consists of a rotation and a translation"
        )


class SeveralSensorsError(LidarError):
    """Error raised if a recording has several sensors or topics and none was chosen.

    `contents` is a sentence that lists them, and `option` is the option that chooses one of them.
    """

    def __init__(self, contents: str, names: Sequence[str], option: str = "--sensor") -> None:
        super().__init__(f"{contents} Choose one of them with `{option}`.")
        self.contents = contents
        self.names = names


class RayTimes(NamedTuple):
    """Start times and poses of sweeps, which identify their rays."""

    key: str  # identifies the times, and the columns that identify the rays in a sweep
    positions: Floats  # (n, 3), world coordinates, meters
    quaternions: Floats  # (n, 4)
    is_measured: bool  # whether the poses contain the errors of a measured trajectory

    def are_same(self, other: RayTimes) -> bool:
        """Return whether both sweeps have the same rays.

        The poses must be equal, except for the errors of a measured trajectory.
        """
        if self.key != other.key or self.positions.shape != other.positions.shape:
            return False
        if self.is_measured or other.is_measured:
            offsets = self.positions - other.positions
            return bool(np.abs(offsets).max(initial=0.0) < _MAX_POSE_ERROR_M)
        return np.array_equal(self.positions, other.positions) and np.array_equal(
            self.quaternions, other.quaternions
        )


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """A sequence of sweeps of one sensor. A cloud without sweeps is divided into parts instead.

    ``len(recording)`` is the number of items, and ``recording[number]`` reads an item as a `Sweep`.

    Parameters
    ----------
    name
        Name that is used in messages.
    count
        Number of sweeps or parts.
    read
        Function that returns the sweep with a given number. The sweep has the units and column
        names of the file.
    is_cloud
        Whether the items are parts of a cloud without sweeps.
    point_count
        Number of points in a cloud, or None if it is not known before the points are read.
    intensity_column
        Column that the user chose as intensity, or None for the default.
    read_stamps
        Function that returns the timestamps of all sweeps in nanoseconds, or None.
    read_poses
        Function that returns the poses of all sweeps in the world frame, with shape (count, 4, 4).
        It returns None if a pose is unknown. It is faster than reading every sweep.
    read_classes
        Function that returns the names of the semantic classes by number, or None if the format
        does not store them.
    read_boxes
        Function that returns the boxes of labeled objects in all sweeps. It returns None if the
        recording has no labels of objects.
    fired
        Function that returns the sweep with a given number as fired, including its `firing_poses`.
        None if the firing poses are unknown, as in most recordings from real sensors.
    sample
        Function that returns approximately the given number of points, which are evenly distributed
        in the file.
    compensated
        Whether the points are compensated for the motion of the sensor, according to the file or
        its format. None if this is unknown, or if the sensor does not move.
    meters
        Units of x, y and z in meters.
    system
        Coordinate system that the file declares.
    epsg
        EPSG code of the coordinates, or None if they are not in a known system with the unit meter.
    world_origin
        Local origin in world coordinates, in meters, that lidarpool has added to the points of a
        result. Shape (3,). None if nothing was added, or if it is unknown.
    is_metric
        Whether the format defines coordinates as true meters, regardless of the coordinate system.
    sensor
        Name of the sensor or topic, or an empty string.
    sequence
        Name of the drive if the file contains several drives, each with its own world frame.
        Otherwise an empty string.
    calibration
        Path of the file calib.txt in KITTI, which may not exist.
    stations
        Names of the sweeps if each sweep was recorded at a scan station. The name of an unnamed
        sweep is an empty string.
    files
        Names of the files of the sweeps if each sweep has its own file.
    thinned
        Whether some returns were discarded, so that gaps are not necessarily lost returns.
    white
        Intensity of a white surface, if it does not depend on the range.
    energy_unit
        Intensity of a white surface at 10 m if intensities are proportional to energies, otherwise
        None. In results, it is 1.
    ray_times
        Times and poses that identify the rays of the recording, or None if they are unknown.
    noise_classes
        Classes of noise points, which are omitted together with withheld points. None to keep all
        points.
    notes
        Sentences for the user. Notes about poses are added when the poses are read.
    """

    name: str
    count: int
    read: Callable[[int], Sweep]
    is_cloud: bool = False
    point_count: int | None = None
    intensity_column: str | None = None
    read_stamps: Callable[[], Iterable[float]] | None = None
    read_poses: Callable[[], Floats | None] | None = None
    read_classes: Callable[[], Mapping[int, str]] | None = None
    read_boxes: Callable[[], RecordedBoxes | None] | None = None
    fired: Callable[[int], Sweep] | None = None
    sample: Callable[[int], Sweep] | None = None
    compensated: bool | None = None
    meters: Meters = METERS
    system: StatedSystem | None = None
    epsg: int | None = None
    world_origin: Floats | None = None
    is_metric: bool = False
    sensor: str = ""
    sequence: str = ""
    calibration: Path | None = None
    stations: Sequence[str] = ()
    files: Sequence[str] = ()
    thinned: bool = False
    white: float | None = None
    energy_unit: float | None = None
    ray_times: RayTimes | None = None
    noise_classes: tuple[int, ...] | None = NOISE_CLASSES
    notes: Sequence[str] = ()
    # {number of an item: points omitted from it}
    _omitted: dict[int, OmittedPoints] = field(default_factory=dict, init=False)

    def __repr__(self) -> str:
        if self.is_cloud:
            return f"<Recording {self.name}: cloud in {plural(self.count, 'part')}>"
        motion = {True: ", motion-compensated", False: ", as fired", None: ""}[self.compensated]
        return f"<Recording {self.name}: {plural(self.count, 'sweep')}{motion}>"

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> Sweep:
        """Read a sweep or a part of a cloud.

        Raises LidarError if the recording cannot be read, and IndexError if the item does not
        exist.
        """
        number = operator.index(number)
        if not -self.count <= number < self.count:
            items = plural(self.count, "part" if self.is_cloud else "sweep")
            raise IndexError(f"{self.name} has {items}, so {number} is out of range")
        number %= self.count
        with reading(self.name):
            return self._resolved(number, self.read(number))

    def section(self, first: int, count: int) -> Recording:
        """Return a recording that consists of `count` consecutive sweeps, starting at `first`."""
        stop = first + count
        read_stamps, read_poses, fired = self.read_stamps, self.read_poses, self.fired

        boxes = self.read_boxes

        def section_boxes() -> RecordedBoxes | None:
            read = None if boxes is None else boxes()
            return None if read is None else read.section(first, count)

        def section_poses() -> Floats | None:
            poses = None if read_poses is None else read_poses()
            return None if poses is None else poses[first:stop]

        return replace(
            self,
            count=count,
            read=lambda number: self.read(first + number),
            read_stamps=None if read_stamps is None else lambda: [*read_stamps()][first:stop],
            read_poses=None if read_poses is None else section_poses,
            read_boxes=None if boxes is None else section_boxes,
            fired=None if fired is None else lambda number: fired(first + number),
            stations=self.stations[first:stop],
            files=self.files[first:stop],
        )

    def read_fired(self, number: int) -> Sweep:
        """Read the returns of a sweep without motion compensation, if possible.

        Each return is then in the sensor frame at the time of its firing. If the recording does not
        contain such points, the returns are as stored.
        """
        if self.fired is None:
            return self[number].returns()
        with reading(self.name):
            return self._resolved(number, self.fired(number)).returns()

    def read_sample(self, max_points: int) -> Sweep:
        """Read approximately `max_points` points from a cloud that has the function `sample`."""
        assert self.sample is not None
        with reading(self.name):
            return self._resolved(None, self.sample(max_points))

    def _resolved(self, number: int | None, sweep: Sweep) -> Sweep:
        """Convert a stored sweep to standard column names and meters, without withheld points.

        `number` is None for a sample, whose omitted points are not counted.
        """
        if self.noise_classes is not None:
            usable, omitted = usable_points(sweep.columns, self.noise_classes)
            if number is not None:
                self._omitted[number] = omitted
            if usable is not None:
                sweep = sweep.select(usable)
        standard = split_rgb(with_standard_names(sweep.columns))
        columns = self._chosen_intensity(sweep.columns, standard)
        points = sweep.points
        if self.meters != METERS:
            points = np.asarray(points, np.float64) * self.meters
        pose = sweep._pose
        if pose is not None and not callable(pose):
            _check_poses(np.asarray(pose)[None], [number or 0])
        if self.meters != METERS and sweep.pose is not None:
            pose = sweep.pose.copy()
            pose[:3, 3] *= self.meters
        changes: dict[str, Any] = {}
        if not self.is_cloud:
            changes = {"recording": self, "number": number or 0}
        if sweep.compensated is None:
            changes["compensated"] = self.compensated
        if not sweep.sensor:
            changes["sensor"] = self.sensor
        return sweep.replace(points=points, columns=columns, pose=pose, **changes)

    def _chosen_intensity(self, stored: Columns, standard: Columns) -> Columns:
        """Return the standard columns with the chosen column as intensity.

        Raises ValueError if the chosen column does not exist.
        """
        name = self.intensity_column
        if name is None:
            return standard
        for columns in (stored, standard):
            if name in columns:
                return {**standard, "intensity": np.asarray(columns[name])}
        available = f" Available columns: {', '.join(stored)}." if stored else ""
        raise ValueError(
            f"it has no column {name!r} that could be used as intensity."
            + (did_you_mean(name, stored) or available)
        )

    @property
    def energies(self) -> bool:
        """Whether intensities are energies, as in results."""
        return self.energy_unit == 1

    @property
    def intensity_name(self) -> str:
        """Name of the column that was chosen as intensity, which is "intensity" by default."""
        return self.intensity_column or STRENGTHS[0]

    @property
    def omission_notes(self) -> list[str]:
        """Notes about points that were omitted from the items read so far."""
        totals = np.sum([(0, 0), *self._omitted.values()], axis=0).tolist()
        note = OmittedPoints(*totals).omission_note()
        return [f"{self.name}: {note}"] if note else []

    def poses(self, numbers: Iterable[int]) -> Floats | None:
        """Return the poses of sweeps in the world frame, or None if a pose is unknown.

        Parameters
        ----------
        numbers
            Numbers of the sweeps.

        Returns
        -------
        Transformations from the sensor frame to the world frame, of shape (n, 4, 4). They may be
        known even if sweeps have no `pose`, as in bags.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        if self.read_poses is not None:
            chosen = list(numbers)
            with reading(self.name):
                all_poses = self.read_poses()
                if all_poses is not None:
                    matrices = np.array(all_poses[chosen], np.float64).reshape(-1, 4, 4)
                    _check_poses(matrices, chosen)
                    matrices[:, :3, 3] *= self.meters
                    return matrices
            numbers = chosen
        poses = []
        for number in numbers:
            pose = self[number].pose
            if pose is None:
                return None
            poses.append(pose)
        return np.array(poses, np.float64).reshape(-1, 4, 4)

    @cached_property
    def classes(self) -> Mapping[int, str]:
        """Names of the semantic classes by number, as far as the recording states them."""
        if self.read_classes is None:
            return {}
        with reading(self.name):
            return self.read_classes()

    @cached_property
    def boxes(self) -> RecordedBoxes | None:
        """Boxes of labeled objects in all sweeps, or None if the recording has no labels."""
        if self.read_boxes is None:
            return None
        with reading(self.name):
            return self.read_boxes()

    @cached_property
    def stamps_ns(self) -> Floats | None:
        """Timestamps of the sweeps in nanoseconds, or None if they are unknown.

        The shape is (count,), and the dtype is float64.
        """
        if self.read_stamps is None:
            return None
        with reading(self.name):
            return np.fromiter(self.read_stamps(), np.float64)

    @property
    def rings(self) -> Rings:
        """Rings of the sensor, which are empty if they are unknown."""
        return self._rings_and_times[0]

    @property
    def point_times(self) -> PointTimes | None:
        """Unit and clock of the point times, or None if the points have no times."""
        return self._rings_and_times[1]

    @cached_property
    def _rings_and_times(self) -> tuple[Rings, PointTimes | None]:
        numbers = even_indices(self.count, _REFERENCE_SWEEPS).tolist()
        # Points are read as fired, because motion compensation changes their elevation angles.
        sweeps = {number: self.read_fired(number) for number in numbers}
        sweeps = {number: sweep for number, sweep in sweeps.items() if len(sweep)}
        stamps_s = self.stamps_ns
        if stamps_s is not None and len(stamps_s) == self.count:
            stamps_s = 1e-9 * stamps_s[[*sweeps]]
        else:
            stamps_s = None
        columns = [sweep.columns for sweep in sweeps.values()]
        times = PointTimes.from_sweeps(columns, stamps_s) if columns else None
        return Rings.from_sweeps(self.name, [*sweeps.values()]), times

    def rings_of(self, sweep: Sweep) -> Ints | None:
        """Return the ring of each point in a sweep without a ring column.

        Rings are numbered from the lowest ring. Points without a ring or without a return have the
        value -1. Returns None if the rings are unknown, or if there is a ring column.
        """
        if not len(self.rings) or self.rings.numbers is not None:
            return None
        returned = sweep.has_return
        rows = self.rings.ring_indices(sweep.returns())
        rings = np.full(len(sweep), -1)
        rings[returned] = np.where(rows >= 0, len(self.rings) - 1 - rows, -1)
        return rings

    def times_of(self, sweep: Sweep) -> Floats | None:
        """Return each point's time in seconds relative to the timestamp of its sweep.

        Returns None if the times are unknown, otherwise an array with shape (n,).
        """
        if self.fired is not None:  # a result, whose times are exact
            if "time" not in sweep.columns or sweep.time_ns is None:
                return None
            return 1e-9 * (np.asarray(sweep.columns["time"]) - sweep.time_ns)
        if self.point_times is None:
            return None
        stamps_ns = self.stamps_ns
        stamp_s = None if stamps_ns is None else 1e-9 * float(stamps_ns[sweep.number])
        return self.point_times.relative_times(sweep.columns, stamp_s)


@dataclass(frozen=True)
class RecordingSource:
    """A file or folder to open, with the options that the user chose."""

    path: Path
    name: str  # name in messages
    sensor: str | None = None  # sensor or topic to read, if there are several
    intensity: str | None = None  # column to use as intensity, if it is not `intensity`
    unit: str | None = None  # unit of the positions, which overrides the file
    # Whether positions are returned in the units and the coordinate system of the file, without
    # checks, and each scan in the file is an item.
    as_stored: bool = False
    # Sensors and topics that the format has selected; empty if it does not distinguish any.
    selected: set[str] = field(default_factory=set, repr=False, compare=False)

    def recording(self, count: int, read: Callable[[int], Sweep], **fields: Any) -> Recording:
        """Create a recording with `count` sweeps or parts. `fields` are passed to `Recording`."""
        fields.setdefault("intensity_column", self.intensity)
        return Recording(self.name, count, read, **fields)

    def choose(self, kind: str, names: Iterable[str]) -> str:
        """Return the sensor or topic that the user chose (see the function `choose`)."""
        chosen = choose(self.name, kind, names, self.sensor)
        self.selected.add(chosen)
        return chosen

    def select_sensor(self, sensors: Mapping[str, Recording]) -> Recording:
        """Return the recording of the chosen sensor.

        A single sensor may have an empty name.
        """
        name = self.choose("sensors", sensors)
        return replace(sensors[name], sensor=name)

    def prefix_notes(self, clauses: Iterable[str]) -> tuple[str, ...]:
        """Turn clauses into notes by prepending the name of the recording."""
        return tuple(f"{self.name} {clause}" for clause in clauses)

    def chosen_meters(self) -> Meters:
        """Return the units of x, y and z in meters, for a format that does not define them."""
        return stated_meters(None, np.zeros((0, 3)), self.unit)[0]

    def stated_meters(
        self, system: StatedSystem | None, positions: Floats
    ) -> tuple[Meters, tuple[str, ...]]:
        """Return the units of x, y and z in meters, and notes for the user.

        `positions` contains points in the file, or a sample of them, in the units of the file.
        Raises LidarError in the same cases as `lidarsim.scene.files.stated_system.stated_meters`.
        """
        if self.as_stored:
            return METERS, ()
        meters, clauses = stated_meters(system, positions, self.unit)
        return meters, self.prefix_notes(clauses)

    def epsg_in_meters(self, system: StatedSystem | None, meters: Meters) -> int | None:
        """Return the EPSG code of a coordinate system, or None if its unit is not the meter."""
        if system is None or self.unit is not None or meters != METERS:
            return None
        return system.epsg

    def stream(
        self,
        sweeps: Callable[[], Iterable[Any]],
        convert: Callable[[Any], Sweep],
        count: int | None = None,
        **fields: Any,
    ) -> Recording:
        """Create a recording from a file that can only be read sequentially.

        Reading the sweeps in order takes a single pass. To go back, the file is read again from its
        start.

        Parameters
        ----------
        sweeps
            Function that returns an iterable of the stored sweeps.
        convert
            Function that converts a stored sweep to a `Sweep`.
        count
            Number of sweeps. If it is None, the sweeps are counted.
        fields
            Further fields of `Recording`.
        """
        if count is None:
            with reading(self.name):
                count = sum(1 for _ in sweeps())
        positions = PerProcess(_StreamPosition)

        def read(number: int) -> Sweep:
            position = positions()
            with position.lock:
                start = position.next_number
                position.next_number = 0  # so that the next call starts again after an error
                if not 0 < start <= number:
                    start = 0
                    position.remaining = iter(sweeps())
                stored = next(islice(position.remaining, number - start, None), None)
                if stored is None:
                    raise CutShortError(
                        f"{plural(count, 'sweep')} were expected, but there are fewer"
                    )
                position.next_number = number + 1
                return convert(stored)

        def locked(function: Callable[[], Any]) -> Callable[[], Any]:
            def call() -> Any:
                with positions().lock:
                    found = function()
                    return [*found] if isinstance(found, Iterator) else found

            return call

        for name in ("read_stamps", "read_poses", "read_boxes"):
            if fields.get(name) is not None:
                fields[name] = locked(fields[name])
        return self.recording(count, read, **fields)


@dataclass
class _StreamPosition:
    """Position at which a process reads a stream, protected by a lock."""

    next_number: int = 0  # number of the next sweep, or 0 to start again
    remaining: Iterator[Any] = field(default_factory=lambda: iter(()))  # from `next_number`
    lock: RLock = field(default_factory=RLock)


def sweep_from_columns(columns: dict[str, Any], **fields: Any) -> Sweep:
    """Create a sweep from columns, which must include the coordinates x, y and z.

    Raises ValueError if a coordinate is missing. `fields` are passed to `Sweep`.
    """
    columns = with_standard_names(columns, "xyz")
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its point coordinates are incomplete ({', '.join(missing)} missing)")
    points = np.empty((len(columns["x"]), 3))
    for index, axis in enumerate("xyz"):
        points[:, index] = columns.pop(axis)
    return Sweep(points, columns, **fields)


def open_cloud(
    name: str,
    cloud: CloudLike,
    load_sweeps: Callable[[], Sweeps] | None,
    sensor: str | None,
    intensity: str | None,
    *,
    has_measured_poses: bool = False,
    **fields: Any,
) -> Recording:
    """Open a lidarpool cloud as the sweeps of a sensor, or in parts if it has no sweeps.

    Parameters
    ----------
    name
        Name that is used in messages.
    cloud
        Cloud to open.
    load_sweeps
        Function that returns the sweeps of the cloud, or None for a cloud without sweeps.
    sensor, intensity
        Sensor and intensity column that the user chose, or None.
    has_measured_poses
        Whether the poses contain the errors of a measured trajectory.
    fields
        Further fields of `Recording`.

    Raises
    ------
    LidarError
        If there are several sensors and none was chosen, or if the chosen sensor does not exist.
    """
    if sensor and load_sweeps is None:
        raise LidarError(
            f"{name} has no sweeps that state their sensor, so no sensor can be selected. Remove "
            f"the sensor {sensor!r}."
        )
    fields |= {"intensity_column": intensity, "noise_classes": None}
    if load_sweeps is None:

        def read_part(number: int) -> Sweep:
            chunk = next(cloud.chunks(CHUNK_POINTS, number * CHUNK_POINTS))
            return Sweep(chunk.positions, chunk.columns)

        parts = -(-len(cloud) // CHUNK_POINTS)
        return Recording(name, parts, read_part, is_cloud=True, point_count=len(cloud), **fields)
    saved = load_sweeps()
    fields["epsg"] = saved.epsg
    sensor_index = saved.sensors.index(choose(name, "sensors", saved.sensors, sensor))
    indices = np.flatnonzero(saved.sensor == sensor_index).tolist()

    def read_sweep(number: int) -> Sweep:
        index = indices[number]
        points = next(saved.points(cloud, index, index + 1))
        return Sweep(
            saved.in_sensor(index, points.positions),
            points.columns,
            pose=saved.pose.matrix(index),
            time_ns=float(saved.begins_ns[index]),
            sensor=saved.sensors[sensor_index],
        )

    def read_fired(number: int) -> Sweep:
        index = indices[number]
        points = next(saved.points(cloud, index, index + 1))
        poses = saved.firing_poses(index, points)
        return Sweep(
            saved.as_fired(index, points, poses),
            points.columns,
            pose=saved.pose.matrix(index),
            time_ns=float(saved.begins_ns[index]),
            compensated=False,
            firing_poses=poses,
        )

    def read_poses() -> Floats:
        return np.array([saved.pose.matrix(index) for index in indices])

    stamps_ns = saved.begins_ns[indices] + (saved.start_ns or 0)
    # The column `intensity` of a result contains energies. Another column may be chosen.
    fields["energy_unit"] = 1.0 if intensity in (None, "intensity") else None
    fields["sensor"] = saved.sensors[sensor_index]
    columns = {column.name for column in cloud.table}
    if ray_columns := columns & {"time", "ray"}:
        # `compared_sweep` identifies rays by their time if possible, otherwise by their number.
        key = max(ray_columns), "return_number" in columns
        fields["ray_times"] = RayTimes(
            fingerprint(key, saved.scans[indices], saved.begins_ns[indices]),
            saved.pose.positions[indices],
            saved.pose.quaternions[indices],
            is_measured=has_measured_poses,
        )
    if saved.actors:
        fields["read_boxes"] = lambda: RecordedBoxes.from_sweeps(saved, indices)
    if len(saved.knots):
        fields["compensated"] = saved.coordinates == "world"
    fields |= {"read_stamps": lambda: stamps_ns, "read_poses": read_poses, "fired": read_fired}
    return Recording(name, len(indices), read_sweep, **fields)


def choose(name: str, kind: str, names: Iterable[str], chosen: str | None) -> str:
    """Return the chosen sensor or topic, or the only one if none was chosen.

    Parameters
    ----------
    name
        Name of the recording, for error messages.
    kind
        What is chosen, in the plural, for error messages. For example "sensors".
    names
        Names of the available sensors or topics.
    chosen
        Name that the user chose, or None.

    Raises
    ------
    LidarError
        If there are several and none was chosen, or if the chosen one does not exist.
    """
    available = list(names)
    if chosen is None and len(available) == 1:
        return available[0]
    if chosen is not None and chosen in available:
        return chosen
    contents = f"It contains the {kind} {join_names(available)}." if available else ""
    if available == [""]:
        contents = f"Its {kind} have no names and cannot be selected."
    if not available:
        raise LidarError(f"{name} contains no {kind}. Record at least one.")
    if chosen is None:
        raise SeveralSensorsError(f"{name} contains the {kind} {join_names(available)}.", available)
    hint = did_you_mean(chosen, available)
    raise LidarError(f"{name} does not contain {chosen!r}.{hint} {contents}")
