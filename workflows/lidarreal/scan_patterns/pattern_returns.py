"""Returns of all sweeps in a stationary recording, with their rings and times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.recording import PointCloud, Recording, RecordingInfo, SweepsInMemory
from lidarfiles.clouds.rings import elevations
from lidarsim.columns.column_names import TIMES
from lidarsim.columns.sweep import Columns, Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.words import plural

_MAX_RETURNS = 6_000_000  # maximum number of returns in memory
_MIN_RETURNS = 1_000  # minimum number of returns from which a pattern is determined
_MIN_RANGE_M = 0.3  # Closer returns come from the cover, and rounding spoils their directions.
_MAX_LINE_RAD = np.radians(0.1)  # maximum spread of the elevations of a 2D scanner
_SWEEP_S = 0.1  # assumed interval of sweeps without timestamps
_TIME_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_TYPICAL_HZ = 3e5  # typical number of returns per second


class SweepTimes(NamedTuple):
    """Times of the sweeps in a recording."""

    starts_s: Floats  # (s,): times at which the sweeps start, since the first one
    are_stated: bool  # whether the recording states them
    period_s: float  # median interval between sweeps


@dataclass(frozen=True, eq=False)
class PatternReturns:
    """Returns of consecutive sweeps, in the order of the recording.

    Attributes
    ----------
    name
        Name of the recording.
    points
        Positions in the sensor frame in meters, of shape (n, 3), not compensated for motion.
    sweep
        Sweep number of each return. Shape (n,).
    ring
        Ring of each return, from the highest to the lowest, or -1 if it is unknown. Shape (n,).
    channel
        Number of the ring, line or channel in the recording, or zeros. Shape (n,).
    time_s
        Times of the returns since the start of the first sweep, of shape (n,), or None.
    elevation_rad
        Median elevations of the rings as seen from the sensor origin, of shape (r,). Empty if the
        rings are unknown.
    sweep_times
        Times of the sweeps.
    notes
        Notes for the user.
    """

    name: str
    points: Floats
    sweep: Ints
    ring: Ints
    channel: Ints
    time_s: Floats | None
    elevation_rad: Floats
    sweep_times: SweepTimes
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    @property
    def sweep_count(self) -> int:
        """Number of sweeps."""
        return len(self.sweep_times.starts_s)

    @property
    def max_range_m(self) -> float:
        """Range limit of the sensor, which is a tenth more than the longest recorded range."""
        return float(np.ceil(1.1 * np.linalg.norm(self.points, axis=1).max()))

    def select(self, rows: Ints) -> PatternReturns:
        """Return a copy with only some of the returns."""
        return replace(
            self,
            points=self.points[rows],
            sweep=self.sweep[rows],
            ring=self.ring[rows],
            channel=self.channel[rows],
            time_s=None if self.time_s is None else self.time_s[rows],
        )

    @classmethod
    def read(cls, recording: Recording) -> PatternReturns:
        """Read the first sweeps of a recording.

        Raises
        ------
        LidarError
            If the recording cannot be read, or if it has too few returns.
        """
        if recording.info.thinned:
            raise LidarError(f"{recording.notes[0]}.")
        sweeps = _read_sweeps(recording)
        counts = [len(sweep) for sweep in sweeps]
        if sum(counts) < _MIN_RETURNS:
            raise LidarError(
                f"{recording.info.name} has {plural(sum(counts), 'return')}, which is not enough "
                f"to determine a scan pattern. Record at least {_MIN_RETURNS:,} returns."
            )
        notes = list(recording.notes)
        if len(sweeps) < len(recording):
            notes.append(f"the first {len(sweeps):,} of {len(recording):,} sweeps are used")
        points = np.concatenate([sweep.points for sweep in sweeps])
        ring, elevation_rad = _rings(recording, sweeps, points)
        sweep_times = _sweep_times(recording, sweeps)
        return cls(
            recording.info.name,
            points,
            np.arange(len(sweeps)).repeat(counts),
            ring,
            _channels(sweeps),
            _cloud_seconds(sweeps[0])
            if isinstance(recording, CloudSweep)
            else _times_s(sweeps, sweep_times),
            elevation_rad,
            sweep_times,
            tuple(notes),
        )


def _read_sweeps(recording: Recording) -> list[Sweep]:
    sweeps: list[Sweep] = []
    count = 0
    for number in range(len(recording)):
        sweep = recording.fired(number).replace(number=number)
        points = sweep.points
        sweeps.append(sweep.select(np.linalg.norm(points, axis=1) > _MIN_RANGE_M))
        count += len(points)
        if count > _MAX_RETURNS:
            break
    return sweeps


class CloudSweep(SweepsInMemory):
    """A cloud without sweeps, such as a `.ply` file, as a recording with a single sweep."""

    def __init__(self, cloud: PointCloud) -> None:
        info = cloud.info
        if info.point_count is not None and info.point_count > _MAX_RETURNS:
            raise LidarError(
                f"{info.name} has {info.point_count:,} points without sweeps. Use a "
                f"recording of a few seconds, with at most {_MAX_RETURNS:,} points."
            )
        parts = [cloud[number] for number in range(len(cloud))]
        names = set.intersection(*[set(part.columns) for part in parts]) if parts else set()
        columns: dict[str, np.ndarray] = {
            name: np.concatenate([np.asarray(part.columns[name]) for part in parts])
            for name in names
        }
        points = np.concatenate(
            [np.empty((0, 3)), *(np.asarray(part.points, np.float64) for part in parts)]
        )
        sweep = Sweep(points, _with_seconds(columns))
        super().__init__(RecordingInfo(info.name, notes=cloud.notes), [sweep])


def _with_seconds(columns: dict[str, np.ndarray]) -> Columns:
    """Convert the times of a cloud, which may last longer than a sweep, to seconds.

    The unit is the one for which the number of returns per second is most plausible.
    """
    name = next((name for name in TIMES if name in columns), None)
    if name is None:
        return columns
    times = columns[name].astype(np.float64)
    span = float(np.ptp(times)) if len(times) else 0.0
    if not (np.isfinite(span) and span > 0):
        return {key: values for key, values in columns.items() if key != name}
    rates_hz = len(times) / (span * np.array(_TIME_UNITS_S))
    unit_s = _TIME_UNITS_S[int(np.abs(np.log(rates_hz / _TYPICAL_HZ)).argmin())]
    return {**columns, name: (columns[name] - columns[name].min()).astype(np.float64) * unit_s}


def _rings(recording: Recording, sweeps: Sequence[Sweep], points: Floats) -> tuple[Ints, Floats]:
    """Return the ring of each return and the median elevations of the rings."""
    rings = recording.rings
    if len(rings):
        ring = np.concatenate([rings.ring_indices(sweep) for sweep in sweeps])
        return ring, rings.elevation_rad
    elevation = elevations(points)
    if np.ptp(np.quantile(elevation, (0.02, 0.98))) < _MAX_LINE_RAD:  # a 2D scanner
        return np.zeros(len(points), np.int64), np.array([np.median(elevation)])
    return np.full(len(points), -1), np.empty(0)


def _channels(sweeps: Sequence[Sweep]) -> Ints:
    """Return the recorded number of the channel of each return, or zeros."""
    if not all("channel" in sweep.columns for sweep in sweeps):
        return np.zeros(sum(map(len, sweeps)), np.int64)
    return np.concatenate([np.asarray(sweep.columns["channel"]) for sweep in sweeps]).astype(
        np.int64
    )


def _sweep_times(recording: Recording, sweeps: Sequence[Sweep]) -> SweepTimes:
    count = len(sweeps)
    stamps_ns = recording.stamps_ns
    times = recording.point_times
    if stamps_ns is not None and count > 1 and (np.diff(stamps_ns[:count]) > 0).all():
        starts_s = np.asarray(1e-9 * (stamps_ns[:count] - stamps_ns[0]), np.float64)
        return SweepTimes(starts_s, True, float(np.median(np.diff(starts_s))))
    period_s = _SWEEP_S if times is None else times.sweep_s + _firing_interval_s(sweeps[0])
    return SweepTimes(np.asarray(period_s * np.arange(count)), False, period_s)


def _firing_interval_s(sweep: Sweep) -> float:
    """Return the time from the last firing of a sweep to the first of the next one, in seconds."""
    intervals_s = np.diff(np.unique(np.asarray([] if sweep.times_s is None else sweep.times_s)))
    return float(np.median(intervals_s)) if len(intervals_s) else 0.0


def _times_s(sweeps: Sequence[Sweep], sweep_times: SweepTimes) -> Floats | None:
    """Return the times of all returns since the start of the first sweep, or None."""
    parts = []
    for start_s, sweep in zip(sweep_times.starts_s.tolist(), sweeps, strict=True):
        times_s = sweep.times_s
        if times_s is None:
            return None
        parts.append(start_s + times_s)
    return np.concatenate(parts)


def _cloud_seconds(cloud: Sweep) -> Floats | None:
    """Return the times of the points of a cloud, which `_with_seconds` has converted, or None."""
    name = next((name for name in TIMES if name in cloud.columns), None)
    return None if name is None else np.asarray(cloud.columns[name], np.float64)
