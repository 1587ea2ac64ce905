"""Recordings in any file format: sequences of sweeps, and clouds that are read in parts.

When an item is read, its columns get standard names, its positions are converted to meters, the
chosen column becomes the intensity, and withheld points are omitted. Rings and point times that a
file does not specify are determined from a few sweeps on first use.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self, SupportsIndex

import numpy as np

from lidarsim.columns.column_names import STRENGTHS, with_standard_names
from lidarsim.columns.sweep import Columns, Sweep
from lidarsim.environment.extras import reading
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.files.noise_points import NOISE_CLASSES, OmittedPoints, usable_points
from lidarsim.scene.files.pcd import split_rgb
from lidarsim.scene.files.stated_system import Meters, StatedSystem
from lidarsim.schema.value_texts import one_line
from lidarsim.words import did_you_mean, plural

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


@dataclass(frozen=True, repr=False)
class RecordingInfo:
    """What is known about a recording or cloud before its points are read.

    Attributes
    ----------
    name
        Name that is used in messages.
    sensor
        Name of the sensor or topic, or an empty string.
    sequence
        Name of the drive if the file contains several drives, each with its own world frame.
        Otherwise an empty string.
    intensity_column
        Column that the user chose as intensity, or None for the default.
    point_count
        Number of points, or None if it is not known before the points are read.
    compensated
        Whether the points are compensated for the motion of the sensor, according to the file or
        its format. None if this is unknown, or if the sensor does not move.
    has_firing_poses
        Whether the sensor poses at all firing times are known, as in results, so that sweeps can be
        read as fired.
    meters
        Units of x, y and z in meters.
    system
        Coordinate system that the file declares.
    epsg
        EPSG code of the coordinates, or None if they are not in a known system with the unit meter.
    world_origin
        Local origin in world coordinates, in meters, that lidarpool has added to the points of a
        result. None if nothing was added, or if it is unknown.
    is_metric
        Whether the format defines coordinates as true meters, regardless of the coordinate system.
    calibration
        Absolute path of the file calib.txt in KITTI, which may not exist.
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
    noise_classes
        Classes of noise points, which are omitted together with withheld points. None to keep all
        points.
    notes
        Sentences for the user.
    """

    name: str
    sensor: str = ""
    sequence: str = ""
    intensity_column: str | None = None
    point_count: int | None = None
    compensated: bool | None = None
    has_firing_poses: bool = False
    meters: Meters = METERS
    system: StatedSystem | None = None
    epsg: int | None = None
    world_origin: tuple[float, float, float] | None = None
    is_metric: bool = False
    calibration: Path | None = None
    stations: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    thinned: bool = False
    white: float | None = None
    energy_unit: float | None = None
    noise_classes: tuple[int, ...] | None = NOISE_CLASSES
    notes: tuple[str, ...] = ()

    __repr__ = one_line

    @property
    def energies(self) -> bool:
        """Whether intensities are energies, as in results."""
        return self.energy_unit == 1

    @property
    def intensity_name(self) -> str:
        """Name of the column that was chosen as intensity, which is "intensity" by default."""
        return self.intensity_column or STRENGTHS[0]


class PointSource(ABC):
    """Points of a file that are read item by item, each as a `Sweep`.

    ``len(source)`` is the number of items, and ``source[number]`` reads an item. The subclasses
    `Recording` and `PointCloud` define what an item is. A source that was opened from a file is
    pickled as a reference to the file, which each process opens once.

    Parameters
    ----------
    info
        What is known before the points are read.
    """

    _item: ClassVar[str]  # noun for an item in messages
    # Function that opens the source again in another process. It can be pickled. None if the source
    # was not opened from a file.
    _reopen: Callable[[], PointSource] | None = None

    def __init__(self, info: RecordingInfo) -> None:
        self.info = info
        self._omitted: dict[int, OmittedPoints] = {}  # {number of an item: omitted points}

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of items."""

    @abstractmethod
    def load(self, number: int) -> Sweep:
        """Read the item with a given number, with the units and column names of the file.

        Formats implement this method. Other code uses ``source[number]``.
        """

    def __getitem__(self, number: int) -> Sweep:
        """Read an item.

        Raises LidarError if the file cannot be read, and IndexError if the item does not exist.
        """
        number = operator.index(number)
        count = len(self)
        if not -count <= number < count:
            items = plural(count, self._item)
            raise IndexError(f"{self.info.name} has {items}, so {number} is out of range")
        number %= count
        with reading(self.info.name):
            return self.standardize(number, self.load(number))

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user, including those about poses that have been read."""
        return self.info.notes

    @property
    def ray_times(self) -> RayTimes | None:
        """Times and poses that identify the rays of sweeps, or None if they are unknown."""
        return None

    @property
    def omission_notes(self) -> list[str]:
        """Notes about points that were omitted from the items read so far."""
        totals = np.sum([(0, 0), *self._omitted.values()], axis=0).tolist()
        note = OmittedPoints(*totals).omission_note()
        return [f"{self.info.name}: {note}"] if note else []

    def with_info(self, **changes: Any) -> Self:
        """Return a copy in which some fields of `info` have new values."""
        return self._with(replace(self.info, **changes))

    def reopened_by(self, reopen: Callable[[], PointSource]) -> Self:
        """Return a copy that other processes open with a function, which must be picklable."""
        other = self._with(self.info)
        other._reopen = reopen
        return other

    def _with(self, info: RecordingInfo) -> Self:
        other = object.__new__(type(self))
        other.__dict__ |= {k: v for k, v in self.__dict__.items() if k not in _DERIVED}
        PointSource.__init__(other, info)
        return other

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[Any, ...]:
        if self._reopen is not None:
            return _opened_again, (self._reopen, self.info)
        return super().__reduce_ex__(protocol)

    def standardize(self, number: int | None, sweep: Sweep) -> Sweep:
        """Convert a stored item to standard column names and meters, without withheld points.

        Parameters
        ----------
        number
            Number of the item, or None for a sample, whose omitted points are not counted.
        sweep
            Item with the units and column names of the file.

        Raises
        ------
        ValueError
            If the chosen intensity column does not exist, or if the pose is invalid.
        """
        info = self.info
        if info.noise_classes is not None:
            usable, omitted = usable_points(sweep.columns, info.noise_classes)
            if number is not None:
                self._omitted[number] = omitted
            if usable is not None:
                sweep = sweep.select(usable)
        standard = split_rgb(with_standard_names(sweep.columns))
        columns = _with_intensity(info.intensity_column, sweep.columns, standard)
        points = sweep.points
        if info.meters != METERS:
            points = np.asarray(points, np.float64) * info.meters
        pose = sweep._pose
        if pose is not None and not callable(pose):
            _check_poses(np.asarray(pose)[None], [number or 0])
        if info.meters != METERS and sweep.pose is not None:
            pose = sweep.pose.copy()
            pose[:3, 3] *= info.meters
        changes: dict[str, Any] = {}
        if sweep.compensated is None:
            changes["compensated"] = info.compensated
        if not sweep.sensor:
            changes["sensor"] = info.sensor
        return sweep.replace(points=points, columns=columns, pose=pose, **changes)


def _opened_again(reopen: Callable[[], PointSource], info: RecordingInfo) -> PointSource:
    source = reopen()
    return source if source.info == info else source._with(info)


def _with_intensity(name: str | None, stored: Columns, standard: Columns) -> Columns:
    """Return the standard columns with the chosen column as intensity.

    Raises ValueError if the chosen column does not exist.
    """
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


class PointCloud(PointSource):
    """A cloud without sweeps, which is read in parts of limited size.

    ``len(cloud)`` is the number of parts, and ``cloud[number]`` reads a part as a `Sweep` in the
    frame of the cloud. Formats implement `load` and ``__len__``.
    """

    _item = "part"

    def __repr__(self) -> str:
        return f"<PointCloud {self.info.name}: {plural(len(self), 'part')}>"

    def sample(self, max_points: int) -> Sweep | None:
        """Read approximately `max_points` points that are evenly distributed in the file.

        Returns None if the format cannot read a sample without reading all points.
        """
        with reading(self.info.name):
            sample = self.load_sample(max_points)
            return None if sample is None else self.standardize(None, sample)

    def load_sample(self, max_points: int) -> Sweep | None:
        """Read a sample with the units and column names of the file, or None if this is slow."""
        return None


class Recording(PointSource):
    """A sequence of sweeps of one sensor.

    ``len(recording)`` is the number of sweeps, and ``recording[number]`` reads a `Sweep`. Formats
    implement `load` and ``__len__``, and the methods ``load_...`` for what they store apart from
    the points.
    """

    _item = "sweep"

    def load_fired(self, number: int) -> Sweep:
        """Read a sweep as fired, including its `firing_poses`.

        It is only called if `RecordingInfo.has_firing_poses` is true.
        """
        raise NotImplementedError

    def load_stamps(self) -> Sequence[int] | Ints | None:
        """Return the timestamps of all sweeps in nanoseconds, or None if they are unknown."""
        return None

    def load_poses(self) -> Floats | None:
        """Return the poses of all sweeps, of shape (n, 4, 4), if they are stored in one place.

        None if a pose is unknown, or if each sweep contains its pose.
        """
        return None

    def load_boxes(self) -> RecordedBoxes | None:
        """Return the boxes of labeled objects in all sweeps, or None if there are no labels."""
        return None

    def load_classes(self) -> Mapping[int, str]:
        """Return the names of the semantic classes by number, as far as they are stored."""
        return {}

    def __repr__(self) -> str:
        motion = {True: ", motion-compensated", False: ", as fired", None: ""}
        count = plural(len(self), "sweep")
        return f"<Recording {self.info.name}: {count}{motion[self.info.compensated]}>"

    def fired(self, number: int) -> Sweep:
        """Read the returns of a sweep without motion compensation, if possible.

        Each return is then in the sensor frame at the time of its firing. If the recording does not
        contain such points, the returns are as stored.

        Raises LidarError if the recording cannot be read.
        """
        if not self.info.has_firing_poses:
            return self[number].returns()
        with reading(self.info.name):
            return self.standardize(number, self.load_fired(number)).returns()

    def standardize(self, number: int | None, sweep: Sweep) -> Sweep:
        """Convert a stored sweep like `PointSource.standardize`.

        The recording determines its rings and times if the file does not contain them.
        """
        return super().standardize(number, sweep).replace(facts=self, number=number or 0)

    @cached_property
    def _stored_poses(self) -> Floats | None:
        with reading(self.info.name):
            return self.load_poses()

    @property
    def has_stored_poses(self) -> bool:
        """Whether all poses are known without reading the sweeps."""
        return self._stored_poses is not None

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
        chosen = list(numbers)
        if self._stored_poses is not None:
            with reading(self.info.name):
                matrices = np.array(self._stored_poses[chosen], np.float64).reshape(-1, 4, 4)
                _check_poses(matrices, chosen)
                matrices[:, :3, 3] *= self.info.meters
                return matrices
        poses = []
        for number in chosen:
            pose = self[number].pose
            if pose is None:
                return None
            poses.append(pose)
        return np.array(poses, np.float64).reshape(-1, 4, 4)

    @cached_property
    def classes(self) -> Mapping[int, str]:
        """Names of the semantic classes by number, as far as the recording states them."""
        with reading(self.info.name):
            return self.load_classes()

    @cached_property
    def boxes(self) -> RecordedBoxes | None:
        """Boxes of labeled objects in all sweeps, or None if the recording has no labels."""
        with reading(self.info.name):
            return self.load_boxes()

    @cached_property
    def stamps_ns(self) -> Ints | None:
        """Timestamps of the sweeps in whole nanoseconds, or None if they are unknown.

        The shape is (n,), and the dtype is int64, because float64 cannot represent nanoseconds
        since 1970.
        """
        with reading(self.info.name):
            stamps = self.load_stamps()
            if stamps is None:
                return None
            values = np.asarray(stamps)
            return np.asarray(np.rint(values) if values.dtype.kind == "f" else values, np.int64)

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
        numbers = even_indices(len(self), _REFERENCE_SWEEPS).tolist()
        # Points are read as fired, because motion compensation changes their elevation angles.
        sweeps = {number: self.fired(number) for number in numbers}
        sweeps = {number: sweep for number, sweep in sweeps.items() if len(sweep)}
        stamps_ns = self.stamps_ns
        stamps_s = None
        if stamps_ns is not None and len(stamps_ns) == len(self):
            stamps_s = np.asarray(1e-9 * stamps_ns[[*sweeps]], np.float64)
        columns = [sweep.columns for sweep in sweeps.values()]
        times = PointTimes.from_sweeps(columns, stamps_s) if columns else None
        return Rings.from_sweeps(self.info.name, [*sweeps.values()]), times

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
        if self.info.has_firing_poses:  # a result, whose times are exact
            if "time" not in sweep.columns or sweep.time_ns is None:
                return None
            return 1e-9 * (np.asarray(sweep.columns["time"]) - sweep.time_ns)
        if self.point_times is None:
            return None
        stamps_ns = self.stamps_ns
        stamp_s = None if stamps_ns is None else 1e-9 * float(stamps_ns[sweep.number])
        return self.point_times.relative_times(sweep.columns, stamp_s)


# Attributes that are derived from other attributes and from `PointSource.info`.
_DERIVED = ("_stored_poses", "classes", "boxes", "stamps_ns", "_rings_and_times")


class SweepsInMemory(Recording):
    """Sweeps in memory as a recording.

    Parameters
    ----------
    info
        What is known about the sweeps, or only their name in messages.
    sweeps
        Sweeps with the units and column names that `info` states.
    stamps_ns
        Timestamps of the sweeps in nanoseconds, of shape (n,), or None if they are unknown.
    poses
        Poses of the sweeps, of shape (n, 4, 4). None to use those of the sweeps.

    Examples
    --------
    >>> SweepsInMemory("drive", [Sweep(np.ones((5, 3)))])
    <Recording drive: 1 sweep>
    """

    def __init__(
        self,
        info: RecordingInfo | str,
        sweeps: Sequence[Sweep],
        *,
        stamps_ns: Ints | None = None,
        poses: Floats | None = None,
    ) -> None:
        super().__init__(RecordingInfo(info) if isinstance(info, str) else info)
        self._sweeps = sweeps
        self._stamps_ns = stamps_ns
        self._poses = poses

    def __len__(self) -> int:
        return len(self._sweeps)

    def load(self, number: int) -> Sweep:
        """Return a sweep."""
        return self._sweeps[number]

    def load_stamps(self) -> Ints | None:
        """Return the timestamps of all sweeps in nanoseconds."""
        return self._stamps_ns

    def load_poses(self) -> Floats | None:
        """Return the poses of all sweeps."""
        return self._poses


class FileRecording(Recording):
    """A recording with a file for each sweep. Formats implement `load`.

    Parameters
    ----------
    info
        What is known before the points are read.
    paths
        Paths of the files in the order of the sweeps.
    """

    def __init__(self, info: RecordingInfo, paths: Sequence[Path]) -> None:
        super().__init__(info)
        self.paths = paths

    def __len__(self) -> int:
        return len(self.paths)


class DerivedRecording(Recording):
    """A recording that is read from another one.

    Subclasses override what they change.

    Parameters
    ----------
    source
        Recording from which sweeps are read.
    info
        Description of this recording. By default, that of the source.
    """

    def __init__(self, source: Recording, info: RecordingInfo | None = None) -> None:
        super().__init__(source.info if info is None else info)
        self.source = source

    def __len__(self) -> int:
        return len(self.source)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user, including those about poses that have been read."""
        return (*self.info.notes, *self.source.notes[len(self.source.info.notes) :])

    def load(self, number: int) -> Sweep:
        """Read a sweep of the source."""
        return self.source.load(number)

    def load_fired(self, number: int) -> Sweep:
        """Read a sweep of the source as fired."""
        return self.source.load_fired(number)

    def load_stamps(self) -> Ints | None:
        """Return the timestamps of the source."""
        return self.source.stamps_ns

    def load_poses(self) -> Floats | None:
        """Return the poses of the source."""
        return self.source._stored_poses

    def load_boxes(self) -> RecordedBoxes | None:
        """Return the boxes of the source."""
        return self.source.boxes

    def load_classes(self) -> Mapping[int, str]:
        """Return the class names of the source."""
        return self.source.classes


class RecordingSection(DerivedRecording):
    """Consecutive sweeps of a recording.

    Parameters
    ----------
    source
        The recording.
    first
        Number of the first sweep.
    count
        Number of sweeps.
    """

    def __init__(self, source: Recording, first: int, count: int) -> None:
        rows = slice(first, first + count)
        info = source.info
        super().__init__(
            source, replace(info, stations=info.stations[rows], files=info.files[rows])
        )
        self._rows = rows

    def __len__(self) -> int:
        return self._rows.stop - self._rows.start

    def load(self, number: int) -> Sweep:
        """Read a sweep of the section."""
        return self.source.load(self._rows.start + number)

    def load_fired(self, number: int) -> Sweep:
        """Read a sweep of the section as fired."""
        return self.source.load_fired(self._rows.start + number)

    def load_stamps(self) -> Ints | None:
        """Return the timestamps of the section."""
        stamps_ns = self.source.stamps_ns
        return None if stamps_ns is None else stamps_ns[self._rows]

    def load_poses(self) -> Floats | None:
        """Return the poses of the section."""
        poses = super().load_poses()
        return None if poses is None else poses[self._rows]

    def load_boxes(self) -> RecordedBoxes | None:
        """Return the boxes of the section."""
        boxes = self.source.boxes
        return None if boxes is None else boxes.section(self._rows.start, len(self))


class LastRead(DerivedRecording):
    """A recording whose last sweep stays in memory, so that it is not read again."""

    def __init__(self, source: Recording) -> None:
        super().__init__(source)
        self._last: tuple[int, Sweep] | None = None

    def load(self, number: int) -> Sweep:
        """Read a sweep, unless it is in memory."""
        if self._last is None or self._last[0] != number:
            self._last = None  # frees its memory before the next sweep is read
            self._last = number, self.source.load(number)
        return self._last[1]

    def release(self) -> None:
        """Release the sweep in memory."""
        self._last = None


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
