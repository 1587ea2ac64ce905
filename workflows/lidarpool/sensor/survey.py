"""A survey: one sensor, its trajectory, and the scans that follow from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ..base.errors import LidarpoolError
from ..columns.table import Column, chosen, stored
from .sensor import Sensor
from .trajectory import Pose, Stations, Trajectory


@dataclass(frozen=True)
class ScanSpec:
    """The firings of one time step of the sensor: the unit of ordering and of exactly-once.

    Parameters
    ----------
    scan
        Its number in the survey.
    station
        Where the sensor is, see `Trajectory`.
    firings
        Half-open range of numbers of firings, counted from the beginning of the station.
    start_ns
        When the station begins, nanoseconds since the survey's start.
    """

    scan: int
    station: int
    firings: tuple[int, int]
    start_ns: int = 0

    def ray_count(self, sensor: Sensor) -> int:
        """Rays in this scan."""
        return (self.firings[1] - self.firings[0]) * sensor.channels


@dataclass(frozen=True)
class Survey:
    """All scans of one sensor: every time step from every station, one after the other.

    Parameters
    ----------
    sensor
        The lidar.
    poses
        Where it scans from, one after the other: `Pose`, or x, y, z.
    steps
        Time steps from each pose.
    keep_every
        Of the hits of each scan, the cloud keeps every n-th.
    precision_m
        Points are rounded to multiples of this, in metres.
    columns
        What points have beside x, y, z, scan, channel and object: names of the table of columns
        (`lidarpool.columns.table`), or `Column` of one's own.
    trajectory
        In place of `poses`, where the sensor moves.

    Raises
    ------
    LidarpoolError
        If a number is out of range, there is no pose, or no such column.

    Examples
    --------
    >>> survey = Survey(Sensor.grid(), poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    >>> survey.scan_count, survey.ray_count
    (108, 120000)
    """

    sensor: Sensor = field(default_factory=Sensor.grid)
    poses: Sequence[Pose] = ()
    steps: int = 36
    keep_every: int = 5
    precision_m: float = 0.01
    columns: Sequence[str | Column] = ()
    trajectory: Trajectory | None = None

    def __post_init__(self) -> None:
        poses = tuple(p if isinstance(p, Pose) else _pose(p) for p in self.poses)
        object.__setattr__(self, "poses", poses)
        if self.trajectory is None:
            if not poses:
                raise LidarpoolError("A survey needs at least one pose to scan from.")
            object.__setattr__(self, "trajectory", Stations(poses))
        elif poses and self.trajectory != Stations(poses):
            raise LidarpoolError("A survey has either poses or a trajectory, not both.")
        object.__setattr__(self, "columns", chosen(self.columns))
        for name, least in (("steps", 1), ("keep_every", 1), ("precision_m", 1e-6)):
            value = getattr(self, name)
            if not least <= value < float("inf"):
                raise LidarpoolError(f"{name} is {value}; it must be at least {least}.")

    @cached_property
    def path(self) -> Trajectory:
        """Where the sensor is: the trajectory, or the poses as one."""
        assert self.trajectory is not None  # made of the poses where it was not given
        return self.trajectory

    @cached_property
    def stored_columns(self) -> tuple[Column, ...]:
        """All columns of a part."""
        return stored(chosen(self.columns))

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return self.path.stations * self.steps

    @property
    def ray_count(self) -> int:
        """Number of rays in all scans."""
        return self.path.stations * self._firings_per_station * self.sensor.channels

    @cached_property
    def _firings_per_station(self) -> int:
        return self.sensor.firings(self.steps - 1)[1]

    @cached_property
    def _station_ns(self) -> int:
        """How long a station takes."""
        last = np.array([self._firings_per_station], np.int64)
        return int(self.sensor.times_ns(last).min())

    def scan(self, index: int) -> ScanSpec:
        """Describe scan `index`: station `index // steps`, time step `index % steps`."""
        station, step = divmod(index, self.steps)
        return ScanSpec(index, station, self.sensor.firings(step), station * self._station_ns)

    def scans(self) -> Iterator[ScanSpec]:
        """All scans in order."""
        return (self.scan(index) for index in range(self.scan_count))

    def pose(self, index: int) -> Pose:
        """Pose of the sensor when scan `index` begins."""
        spec = self.scan(index)
        first = np.array([spec.firings[0]], np.int64)
        return self.path.pose(spec.station, float(self.sensor.times_ns(first).min()))


def _pose(given: object) -> Pose:
    try:
        return Pose(tuple(given))  # type: ignore[arg-type]
    except TypeError:
        raise LidarpoolError(
            f"A pose is a Pose or three coordinates x, y, z in metres, not {given!r}: give poses "
            "as a list of them, such as [(0, 0, 1)]."
        ) from None
