"""Points of one sweep of a lidar, as they were recorded or simulated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from ..numerics.arrays import AnyArray, Bools, Floats, Indices, Ints32
from .column_names import STRENGTHS

Columns = Mapping[str, AnyArray]


class Sweep:
    """Points of one sweep of a sensor, or of one part of a large cloud.

    Parameters
    ----------
    points
        Positions in meters, of shape (n, 3), in the sensor frame. x is forward, y is left and z is
        up, unless the mount is rotated. Parts of a cloud are in the frame of the cloud. Pulses
        without a return are NaN or zero in organized sweeps; `returns` removes them.
    columns
        Further values of each point as {name: array of shape (n,)}. Columns with a known meaning
        have the standard names of lidarpool, and the others have the names of the file.
    pose
        Transformation from the sensor frame to the world frame, of shape (4, 4), or None if it is
        unknown. If it is a function, it is called when the pose is requested.
    time_ns
        Timestamp of the sweep in nanoseconds, or None if it is unknown. For results, this is the
        time since the start of the survey.
    compensated
        Whether the points are compensated for the motion during the sweep, or None if unknown.
    firing_poses
        Poses of the sensor when the points were fired
        (`lidarsim.sweeps.sweep_motion.FiringPoses`), or None if they are unknown. They only apply
        to points that are not compensated.
    scanner
        Position of the scanner in the frame of the file in meters, of shape (3,), or None.
    units_m
        Units of x, y and z in meters, if the file states them for this sweep.
    boxes
        Bounding boxes of the actors in the sensor frame, or a function that returns them, or None.
    sensor, number
        Name of the sensor, and index of the sweep among the sweeps of the sensor.
    job, job_number, split, values
        Name, number and split of the job in a data set to which the sweep belongs, and the varied
        values of this job as {path: value}.
    object_names
        Names of the objects. The column `object` contains indices into this tuple.
    faults
        Faults of the sensor during the sweep.
    notes
        Notes on the points, as clauses that follow the name of the file.
    skipped
        Names of columns in the file that could not be read.
    recording
        Recording to which the sweep belongs. It determines `rings` and `times_s` where the file
        does not state them.
    """

    def __init__(
        self,
        points: AnyArray,
        columns: Columns | None = None,
        *,
        pose: Floats | Callable[[], Floats | None] | None = None,
        time_ns: int | float | None = None,
        compensated: bool | None = None,
        firing_poses: Any = None,
        scanner: Floats | None = None,
        units_m: tuple[float, float, float] | None = None,
        boxes: Any = None,
        sensor: str = "",
        number: int = 0,
        job: str = "",
        job_number: int | None = None,
        split: str | None = None,
        values: Mapping[str, Any] | None = None,
        object_names: tuple[str, ...] = (),
        faults: tuple[Any, ...] = (),
        notes: Sequence[str] = (),
        skipped: Sequence[str] = (),
        recording: Any = None,
    ) -> None:
        self.points = points
        self.columns: Columns = {} if columns is None else columns
        self.time_ns = time_ns
        self.compensated = compensated
        self.firing_poses = firing_poses
        self.scanner = scanner
        self.units_m = units_m
        self.sensor = sensor
        self.number = number
        self.job = job
        self.job_number = job_number
        self.split = split
        self.values: Mapping[str, Any] = {} if values is None else values
        self.object_names = object_names
        self.faults = faults
        self.notes = notes
        self.skipped = skipped
        self._pose = pose
        self._boxes = boxes
        self._recording = recording
        # The sweep from which these points were selected or moved, and their rows in it. The
        # recording determines rings and times from that sweep.
        self._origin: tuple[Self, Bools | Indices | slice] | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Values that the recording determines are computed before the sweep leaves the process.
        known = None if self._recording is None else _RingsAndTimes(self.rings, self.times_s)
        return self.__dict__ | {
            "_pose": self.pose,
            "_boxes": self.boxes,
            "_recording": known,
            "_origin": None,
        }

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        sensor = f" of {self.sensor}" if self.sensor else ""
        job = f" in job {self.job}" if self.job else ""
        return f"<Sweep {self.number}{sensor}{job}: {len(self):,} points>"

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values for some parameters of the constructor.

        New points must be in the order of the old ones. They keep their rings and times, even if
        these follow from the old positions.
        """
        other = object.__new__(type(self))
        cached = ("pose", "boxes", "rings", "times_s")
        other.__dict__ |= {k: v for k, v in self.__dict__.items() if k not in cached}
        if "recording" in changes:
            other._origin = None
        elif "points" in changes and self._recording is not None:
            other._origin = self, slice(None)
        for name, value in changes.items():
            attribute = name if name in other.__dict__ else f"_{name}"
            if attribute not in other.__dict__:
                raise TypeError(f"Sweep has no parameter {name!r}")
            other.__dict__[attribute] = value
        return other

    @cached_property
    def pose(self) -> Floats | None:
        """Transformation from the sensor frame to the world frame, (4, 4), or None if unknown."""
        pose: Floats | None = self._pose() if callable(self._pose) else self._pose
        return pose

    @cached_property
    def boxes(self) -> Any:
        """Bounding boxes of the actors in the sensor frame, or None if they are unknown."""
        return self._boxes() if callable(self._boxes) else self._boxes

    @cached_property
    def rings(self) -> AnyArray | None:
        """Ring of each point, integers of shape (n,), or None if the rings are unknown.

        If there is no column `channel`, the recording determines the rings from the order or the
        elevation angles of the points. They are then counted from the lowest ring, and points that
        belong to no ring have the value -1.
        """
        if "channel" in self.columns:
            return np.asarray(self.columns["channel"])
        if self._origin is not None:
            sweep, rows = self._origin
            return None if sweep.rings is None else sweep.rings[rows]
        return None if self._recording is None else self._recording.rings_of(self)

    @cached_property
    def times_s(self) -> Floats | None:
        """Time of each point relative to the timestamp of the sweep, or None if it is unknown.

        The times are in seconds and have the shape (n,).
        """
        if self._origin is not None:
            sweep, rows = self._origin
            return None if sweep.times_s is None else sweep.times_s[rows]
        return None if self._recording is None else self._recording.times_of(self)

    @property
    def intensity(self) -> AnyArray | None:
        """Intensity of each point, of shape (n,), or None if it is unknown.

        This is the column `intensity`, which contains the received energies in results of
        lidarpool, or else the column `reflectivity`.
        """
        return next((self.columns[name] for name in STRENGTHS if name in self.columns), None)

    @property
    def classes(self) -> AnyArray | None:
        """Semantic class of each point, integers of shape (n,), or None if it is unknown.

        In files of lidarpool, points without a class have the value 0.
        """
        return self.columns.get("class")

    @property
    def objects(self) -> Ints32 | None:
        """Index of each point's object in `object_names`, of shape (n,), or None."""
        return self.columns.get("object")

    @property
    def has_return(self) -> Bools:
        """Mask of the points that have a return, bool of shape (n,).

        Drivers store NaN or zeros for pulses without a return.
        """
        return np.asarray(np.isfinite(self.points).all(axis=1) & self.points.any(axis=1))

    def returns(self) -> Self:
        """Return the points that have a return, in double precision."""
        mask = self.has_return
        sweep = self if mask.all() else self.select(mask)
        points = np.asarray(sweep.points, np.float64)
        return sweep if points is sweep.points else sweep.replace(points=points)

    def select(self, rows: Bools | Indices | slice) -> Self:
        """Return some of the points, given a mask, indices or a slice."""
        columns = {name: np.asarray(values)[rows] for name, values in self.columns.items()}
        poses = self.firing_poses
        selected = self.replace(
            points=self.points[rows],
            columns=columns,
            firing_poses=None if poses is None else poses.select(rows),
        )
        if self._recording is not None:
            selected._origin = self, rows
        return selected

    def with_columns(self, **columns: AnyArray | None) -> Self:
        """Return the points with only the given columns, except those that are None.

        The copy no longer has rings and times that its recording determines.
        """
        return self.replace(
            columns={name: values for name, values in columns.items() if values is not None},
            recording=None,
        )

    def in_world(self) -> Floats:
        """Transform the points to the world frame. The pose must be known."""
        assert self.pose is not None
        return np.asarray(self.points @ self.pose[:3, :3].T + self.pose[:3, 3])

    @classmethod
    def joined(cls, sweeps: Sequence[Self], *, only_shared: bool = False) -> Self:
        """Concatenate the points of sweeps.

        The result has all columns, with NaN for sweeps that lack a column. If `only_shared` is
        true, it has only the columns that all sweeps have.
        """
        filled = [sweep for sweep in sweeps if len(sweep)] or sweeps[:1]
        if not filled:
            return cls(np.empty((0, 3)))
        names = dict.fromkeys(name for sweep in filled for name in sweep.columns)
        if only_shared:
            shared = set.intersection(*(set(sweep.columns) for sweep in filled))
            names = {name: None for name in names if name in shared}
        columns = {
            name: np.concatenate(
                [
                    np.asarray(sweep.columns.get(name, np.full(len(sweep), np.nan)))
                    for sweep in filled
                ]
            )
            for name in names
        }
        return cls(np.concatenate([sweep.points for sweep in filled]), columns)


class _RingsAndTimes(NamedTuple):
    """Rings and times of a sweep, which replace its recording in other processes."""

    rings: AnyArray | None
    times_s: Floats | None

    def rings_of(self, _: Sweep) -> AnyArray | None:
        return self.rings

    def times_of(self, _: Sweep) -> Floats | None:
        return self.times_s
