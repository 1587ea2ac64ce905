"""Recordings: sweeps of a sensor, or parts of a cloud, which formats open and read one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Indices, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.extras import reading
from lidarsim.base.words import did_you_mean, joined
from lidarsim.columns.cloud import CHUNK_POINTS, CloudLike
from lidarsim.scene.files.noise_points import NOISE_CLASSES, LeftOut, usable_points
from lidarsim.scene.files.stated_system import Meters, StatedSystem, stated_meters
from lidarsim.sweeps.sweep_motion import FiringPoses
from lidarsim.sweeps.sweeps import Sweeps

from ..base.fingerprint import fingerprint

Columns = Mapping[str, AnyArray]
# Positions (n, 3), columns (n,), and the sensor's pose in the world (4, 4); None if unknown.
Read = tuple[AnyArray, Columns, Floats | None]

# Names of the columns of rings and of intensities in other programs; the first column present is
# read.
_RING_COLUMNS = ("ring", "channel", "laser_id", "laser_number", "line", "beam")
_INTENSITY_COLUMNS = ("intensity", "reflectivity", "i")
METERS: Meters = (1.0, 1.0, 1.0)


class SweepFiles(NamedTuple):
    """Sweeps of a sensor, or parts of a cloud."""

    sweeps: int  # or parts
    read: Callable[[int], Read]
    times_ns: Floats | None = None  # (sweeps,): stamp of each sweep; None if unknown
    point_count: int | None = None  # number of points of a cloud in parts; None for sweeps
    sequence: str = ""  # name of a drive that has a separate frame; "" for the only drive
    notes: tuple[str, ...] = ()  # clauses that follow the name of the recording
    calibration: Path | None = None  # KITTI's calib.txt, which may not exist
    epsg: int | None = None  # EPSG code of the file's system, if that is in meters
    stations: Sequence[str] = ()  # name of each sweep if each is from a station; "" for unnamed


class SeveralSensorsError(LidarError):
    """The recording has several sensors or topics, and none is chosen.

    `contents` is a sentence that names them, and `option` the option that chooses one.
    """

    def __init__(self, contents: str, names: Sequence[str], option: str = "--sensor") -> None:
        super().__init__(f"{contents} Choose one of them with `{option}`.")
        self.contents = contents
        self.names = names


@dataclass(frozen=True, eq=False)
class RecordedPoints:
    """Points of a sweep, or of a part of a cloud."""

    points: Floats  # (n, 3): meters
    rings: Ints | None = None  # (n,)
    intensities: Floats | None = None  # (n,): of any scale
    rays: Ints | None = None  # (n,): keys of ray and return; None for parts of a cloud

    def __len__(self) -> int:
        return len(self.points)

    def part(self, row_indices: Indices) -> RecordedPoints:
        """Select points by rows (k,), without the keys of their rays."""
        return RecordedPoints(
            self.points[row_indices],
            None if self.rings is None else self.rings[row_indices],
            None if self.intensities is None else self.intensities[row_indices],
        )

    @classmethod
    def joined(cls, recorded: list[RecordedPoints]) -> RecordedPoints:
        """Concatenate parts of the same recording, without the keys of their rays.

        Intensities that only some parts have are NaN in the others. Rings that only some parts have
        are left out.
        """
        parts = [part for part in recorded if len(part)]
        if not parts:
            return cls(np.empty((0, 3)))
        rings = [part.rings for part in parts if part.rings is not None]
        intensities = None
        if any(part.intensities is not None for part in parts):
            unknown = [np.full(len(part), np.nan) for part in parts]
            intensities = np.concatenate(
                [
                    nothing if part.intensities is None else part.intensities
                    for part, nothing in zip(parts, unknown, strict=True)
                ]
            )
        return cls(
            np.concatenate([part.points for part in parts]),
            np.concatenate(rings) if len(rings) == len(parts) else None,
            intensities,
        )


@dataclass(eq=False)
class NoiseFilter:
    """Leaves out points that a file withholds or classifies as noise, and counts them."""

    noise_classes: tuple[int, ...] = NOISE_CLASSES
    counts: dict[int, LeftOut] = field(default_factory=dict)  # {number of a sweep or part: counts}

    def usable(self, number: int, read: Read) -> Read:
        """Return a sweep or part without withheld points and points of noise, and count these."""
        points, columns, pose = read
        usable, self.counts[number] = usable_points(columns, self.noise_classes)
        if usable is None:
            return read
        usable_columns = {name: np.asarray(values)[usable] for name, values in columns.items()}
        return points[usable], usable_columns, pose

    def note(self) -> str:
        """Return a sentence on the points that were left out, or an empty string for none."""
        totals = np.sum([(0, 0), *self.counts.values()], axis=0).tolist()
        return LeftOut(*totals).note()


class FiredPoints(NamedTuple):
    """Points of a sweep as they were fired."""

    points: Floats  # (n, 3): in the sensor frame at the firing of each, meters
    columns: Columns  # (n,) each
    poses: FiringPoses  # poses of the sensor in the world


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording of sweeps, or a cloud without sweeps (`is_cloud`) that is read in parts."""

    name: str
    count: int  # number of sweeps or parts
    read: Callable[[int], Read]
    intensity_column: str | None = None  # a name that is not in `_INTENSITY_COLUMNS`
    is_cloud: bool = False
    point_count: int | None = None  # None if unknown before the points are read
    times: Callable[[], Iterable[float]] | None = None  # stamp of each sweep, ns
    notes: tuple[str, ...] = ()
    thinned: bool = False  # whether hits were left out: gaps are not lost returns
    white: float | None = None  # intensity of a white surface, if it is the same at all ranges
    energies: bool = False  # whether intensities are energies, as in results
    firing_key: str = ""  # recordings with the same key have the same rays; "" for unknown
    meters: Meters = METERS  # lengths of the units of x, y and z
    epsg: int | None = None  # EPSG code of the file's system, if that is in meters
    sample: Callable[[int], Read] | None = None  # reads about so many points, evenly in the file
    # Returns the poses (count, 4, 4) in the world of sweeps that are read in the sensor frame, or
    # None if they are unknown; None if the recording has no frames.
    frame_poses: Callable[[], Floats | None] | None = None
    sequence: str = ""  # name of a drive that has a separate frame; "" for the only drive
    calibration: Path | None = None  # KITTI's calib.txt, which may not exist
    stations: Sequence[str] = ()  # name of each sweep if each is from a station; "" for unnamed
    noise_filter: NoiseFilter | None = None  # applied by `read`; None if nothing is left out
    # Reads a sweep as fired, with the poses of its firings; None if these are unknown.
    fired: Callable[[int], FiredPoints] | None = None
    # Whether sweeps are stated to be compensated for the motion of the sensor; None if unknown, or
    # if the sensor does not move.
    compensated: bool | None = None

    @property
    def intensity_name(self) -> str:
        """Name of the column that was chosen as intensity, by default «intensity»."""
        return self.intensity_column or _INTENSITY_COLUMNS[0]

    @property
    def left_out_notes(self) -> list[str]:
        """Notes on points that were left out of what has been read."""
        note = "" if self.noise_filter is None else self.noise_filter.note()
        return [f"{self.name}: {note}"] if note else []

    def poses(self, numbers: Iterable[int]) -> Floats | None:
        """Return the poses (n, 4, 4) of sweeps in the world, or None if a pose is unknown.

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
        matrices[:, :3, 3] *= self.meters
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
            self.check_intensity(columns)
        positions = np.asarray(points, np.float64)
        # Drivers write NaN or zeros for pulses without a return.
        valid = np.isfinite(positions).all(axis=1) & positions.any(axis=1)
        positions = positions[valid] * self.meters
        if in_world and not self.is_cloud:
            if pose is None:
                raise LidarError(
                    f"{self.name} is in sensor coordinates and does not contain the pose of "
                    "the sensor. Compare it with a recording that consists of sweeps."
                )
            positions = positions @ pose[:3, :3].T + pose[:3, 3] * self.meters
        rings = rings_of(columns)
        intensities = intensities_of(self, columns)
        return RecordedPoints(
            positions,
            None if rings is None else rings[valid].astype(np.int64),
            None if intensities is None else intensities[valid].astype(np.float64),
            _ray_keys(columns)[valid] if self.firing_key and not in_world else None,
        )

    def check_intensity(self, columns: Columns) -> None:
        """Raise LidarError if the recording lacks the column that was chosen as intensity."""
        name = self.intensity_column
        if name is not None and name not in columns:
            raise LidarError(
                f"it has no column {name!r} that could be used as intensity."
                + (did_you_mean(name, columns) or f" Available columns: {', '.join(columns)}.")
            )


@dataclass(frozen=True)
class RecordingSource:
    """A file or folder to open, and what the user chose of it."""

    path: Path
    name: str  # name in messages
    sensor: str | None = None  # or topic
    intensity: str | None = None  # column, if not one of the usual names
    unit: str | None = None  # replaces the unit that the file states

    def recording(self, count: int, read: Callable[[int], Read], **fields: Any) -> Recording:
        """Return a recording of `count` sweeps or parts, with further fields of `Recording`."""
        return Recording(self.name, count, read, self.intensity, **fields)

    def choose(self, kind: str, names: Iterable[str]) -> str:
        """Return the chosen sensor or topic, or the only one.

        `kind` is the plural, such as "sensors".
        LidarError without a choice among several, or for a name that is not there.
        """
        return choose(self.name, kind, names, self.sensor)

    def of_sensors(self, sensors: Mapping[str, SweepFiles]) -> Recording:
        """Return the sweeps of the chosen sensor of {name: sweeps}.

        The only sensor of a recording may have the name "".
        """
        files = sensors[self.choose("sensors", sensors)]
        return self.recording(
            files.sweeps,
            files.read,
            is_cloud=files.point_count is not None,
            point_count=files.point_count,
            times=None if files.times_ns is None else files.times_ns.tolist,
            notes=self.named(files.notes),
            sequence=files.sequence,
            calibration=files.calibration,
            epsg=files.epsg,
            stations=files.stations,
        )

    def named(self, clauses: Iterable[str]) -> tuple[str, ...]:
        """Return notes: the name of the recording before each clause."""
        return tuple(f"{self.name} {clause}" for clause in clauses)

    def chosen_meters(self) -> Meters:
        """Return the meters of the chosen unit, of a format that states none."""
        return stated_meters(None, np.zeros((0, 3)), self.unit)[0]

    def epsg_in_meters(self, system: StatedSystem | None, meters: Meters) -> int | None:
        """Return the code of a stated system.

        Returns None if a unit was chosen instead, or in feet.
        """
        if system is None or self.unit is not None or meters != METERS:
            return None
        return system.epsg

    def stream(
        self,
        sweeps: Callable[[], Iterable[Any]],
        points: Callable[[Any], Read],
        count: int | None = None,
        **fields: Any,
    ) -> Recording:
        """Return a recording whose `sweeps()` can be iterated from the first sweep only.

        `points` converts a sweep; `count` is the number of sweeps, which are counted if it is None;
        `fields` are fields of `Recording`.
        """
        if count is None:
            with reading(self.name):
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

        return self.recording(count, read, **fields)


def rings_of(columns: Columns) -> AnyArray | None:
    """Return the rings (n,) of points, or None without a column of rings."""
    return _first_column(columns, _RING_COLUMNS)


def intensities_of(recording: Recording, columns: Columns) -> AnyArray | None:
    """Return the intensities (n,) of points, or None without a column of intensities."""
    chosen = recording.intensity_column
    return _first_column(columns, _INTENSITY_COLUMNS if chosen is None else (chosen,))


def _first_column(columns: Columns, names: Iterable[str]) -> AnyArray | None:
    """Return the first column (n,) that is present, or None."""
    return next((np.asarray(columns[name]) for name in names if name in columns), None)


def open_cloud(
    name: str,
    cloud: CloudLike,
    load_sweeps: Callable[[], Sweeps] | None,
    sensor: str | None,
    intensity: str | None,
    **fields: Any,
) -> Recording:
    """Open a cloud of lidarpool, in parts of `CHUNK_POINTS` points or as the sweeps of a sensor.

    `name` is the name in messages, `sensor` the chosen sensor, and `intensity` the column of
    intensities if chosen. `load_sweeps` is None for a cloud without sweeps; `fields` are further
    fields of `Recording`.

    LidarError without a choice among several sensors, or for a sensor that the cloud does not have.
    """
    if load_sweeps is None:

        def read_part(number: int) -> Read:
            chunk = next(cloud.chunks(CHUNK_POINTS, number * CHUNK_POINTS))
            return chunk.positions, chunk.columns, None

        parts = -(-len(cloud) // CHUNK_POINTS)
        return Recording(
            name, parts, read_part, intensity, is_cloud=True, point_count=len(cloud), **fields
        )
    saved = load_sweeps()
    sensor_index = saved.sensors.index(choose(name, "sensors", saved.sensors, sensor))
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
    # Results have energies in their column `intensity`, and may have other columns of intensities.
    fields["energies"] = intensity in (None, "intensity")
    columns = {column.name for column in cloud.table}
    if ray_columns := columns & {"time", "ray"}:
        poses = saved.pose.positions[indices], saved.pose.quaternions[indices]
        key = max(ray_columns), "return_number" in columns  # time rather than ray: `_ray_keys`
        fields["firing_key"] = fingerprint(
            key, saved.scans[indices], saved.begins_ns[indices], poses
        )
    if len(saved.knots):
        fields["compensated"] = saved.coordinates == "world"
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


def positions_of(columns: Columns) -> Floats:
    """Return the positions (n, 3) in columns x, y and z.

    Raises ValueError without these.
    """
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its point coordinates are incomplete ({', '.join(missing)} missing)")
    return np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], axis=1)


def choose(name: str, kind: str, names: Iterable[str], chosen: str | None) -> str:
    """Return the chosen sensor or topic, or the only sensor or topic.

    LidarError without a choice among several, or for a name that the recording does not have.
    `kind` is the plural, such as "sensors"; `name` is the recording's name.
    """
    available = list(names)
    if chosen is None and len(available) == 1:
        return available[0]
    if chosen is not None and chosen in available:
        return chosen
    contents = f"It contains the {kind} {joined(available)}." if available else ""
    if available == [""]:
        contents = f"Its {kind} have no names and cannot be selected."
    if not available:
        raise LidarError(f"{name} contains no {kind}. Record at least one.")
    if chosen is None:
        raise SeveralSensorsError(f"{name} contains the {kind} {joined(available)}.", available)
    hint = did_you_mean(chosen, available)
    raise LidarError(f"{name} does not contain {chosen!r}.{hint} {contents}")


def take_positions(columns: dict[str, AnyArray]) -> Floats:
    """Take columns x, y and z out, and return positions (n, 3).

    Raises ValueError without these.
    """
    positions = positions_of(columns)
    for axis in "xyz":
        del columns[axis]
    return positions
