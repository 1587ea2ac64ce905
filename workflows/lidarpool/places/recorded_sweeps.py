"""Sweeps of a recording as a twin needs them: points in the sensor frame, rings, and intensities.

A KITTI `.bin` and many PCD files have no column of rings. Where points are stored ring by ring, a
ring begins where the azimuth falls back to 0°, and the points show their rings by their order. In
any order, points as fired by a sensor whose beams sweep cones show their rings by few elevations.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.base.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.even_samples import even_indices
from lidarsim.base.extras import reading
from lidarsim.base.words import plural

from ..clouds.recording import Columns, Recording, intensities_of, rings_of
from ..recordings.opening import open_recording
from .labels import labels_of

MIN_RINGS = 4  # a sensor with fewer rings is treated as a sensor without rings
_MAX_RINGS = 512
_GAP_RAD = np.radians(0.5)  # between the rays of a sensor without rings, in many sweeps
_REFERENCE_SWEEPS = 5  # sweeps that tell the elevations of the rings
_BACKWARD_DEG = 15.0  # a step back of the azimuth that begins a ring
_SHORT_RING = 0.02  # a run of points shorter than this share of the median is no ring
_TIME_COLUMNS = ("t", "time", "time_s", "timestamp", "offset_time", "time_offset", "time_stamp")
_TIME_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_MAX_OUTSIDE = 0.5  # sweeps by which a stamp may lie before the first point or after the last
_MIN_SWEEP_S = 0.01
_MAX_SWEEP_S = 2.0
_MAX_START_RAD = np.radians(12)  # between the first pulses of rings
_MIN_AGREEMENT = 0.9  # of azimuths with a steady rotation: length of their mean direction
_MIN_TIMES = 8  # different times of a sweep; fewer are times of packets, or lack precision
_MAX_CONE_SPREAD = 0.25  # of a ring, over all elevations: lines of a Livox are no cones
_MIN_IN_ORDER = 0.95  # share of runs whose elevations go on in one direction
_MAX_CLUSTERS = 128  # of elevations
_MIN_GAP_RATIO = 3.0  # of the smallest gap between clusters, over the largest gap within one
_MIN_CLUSTER = 1e-3  # share of the points in a cluster: fewer are stray points


@dataclass(frozen=True, eq=False)
class RecordedSweep:
    """Returns of a sweep, in the sensor frame."""

    points: Floats  # (n, 3): meters
    ring: Ints  # (n,): row in `RecordedSweeps.elevation_rad`; 0 for a sensor without rings
    intensities: Floats | None  # (n,): in the scale of the recording
    labels: Ints | None  # (n,): of class and object
    time_s: Floats | None  # (n,): relative to the stamp of the sweep, which may be the last point's
    start_rad: Floats  # (r,): azimuths at which the rings start

    def __len__(self) -> int:
        return len(self.points)

    @property
    def turn(self) -> Floats:
        """Share of a counter-clockwise revolution from the start of its ring to points (n,)."""
        azimuth = np.arctan2(self.points[:, 1], self.points[:, 0])
        return np.asarray(((azimuth - self.start_rad[self.ring]) / (2 * np.pi)) % 1)

    def part(self, rows: Bools | Ints) -> RecordedSweep:
        """Return selected points."""
        return RecordedSweep(
            self.points[rows],
            self.ring[rows],
            None if self.intensities is None else self.intensities[rows],
            None if self.labels is None else self.labels[rows],
            None if self.time_s is None else self.time_s[rows],
            self.start_rad,
        )

    def compact(self) -> RecordedSweep:
        """Return the sweep in half the memory."""
        return replace(
            self,
            points=_exact32(self.points),
            ring=self.ring.astype(np.int16),
            intensities=None if self.intensities is None else _exact32(self.intensities),
        )

    def wide(self) -> RecordedSweep:
        """Return the sweep in double precision."""
        return replace(
            self,
            points=self.points.astype(np.float64),
            ring=self.ring.astype(np.int64),
            intensities=None if self.intensities is None else self.intensities.astype(np.float64),
        )


def _exact32(values: Floats) -> Any:
    """Return values in single precision, if it has all of their digits."""
    single = values.astype(np.float32)
    return single if np.array_equal(single, values, equal_nan=True) else values


class RecordingChoice(NamedTuple):
    """A file or folder, and the sensor or topic, and the column of intensities, in it."""

    path: Path
    sensor: str | None = None
    intensity: str | None = None


@lru_cache(maxsize=1)
def _opened(choice: RecordingChoice) -> Recording:
    return open_recording(*choice, name="the recording")


class Rotation(NamedTuple):
    """Rotation of a sensor."""

    is_clockwise: bool
    start_deg: float  # azimuth at the start of a sweep, 0 to 360


class Clock(StrEnum):
    """What the times of points count from."""

    STAMP = "the stamp of the sweep"
    SHARED = "the zero of the stamps"
    OTHER = "another zero"


class PointTimes(NamedTuple):
    """Column of the times of points, the same for all sweeps.

    Sweeps last 0.01 to 2 s, so the span of the column tells its unit: s, ms, µs or ns. A sweep of
    few points, with a short span, has the unit of the others.

    Drivers stamp a sweep with the time of its first or of its last point. Times are relative to the
    stamp if most sweeps have zero among them, and absolute if most sweeps have their stamp among
    them. Otherwise they come from another clock, and the first point is taken as fired at the
    stamp.
    """

    unit_s: float
    sweep_s: float  # median span of the times of a sweep
    clock: Clock = Clock.OTHER
    first_s: float = 0.0  # median time of the first point of a sweep, relative to the stamp

    @classmethod
    def of_sweeps(
        cls, sweeps: Sequence[Columns], stamps_s: Sequence[float] | Floats | None = None
    ) -> PointTimes | None:
        """Find the unit and the clock of the times in columns of sweeps.

        `stamps_s` are the stamps of these sweeps; None if they are unknown. Returns None if the
        sweeps have no times.
        """
        parts = [_times(columns) for columns in sweeps]
        spans = [
            float(part.since.max()) for part in parts if len(np.unique(part.since)) >= _MIN_TIMES
        ]
        if len(spans) <= len(sweeps) / 2:
            return None
        span = float(np.median(spans))
        unit_s = next((u for u in _TIME_UNITS_S if _MIN_SWEEP_S <= span * u <= _MAX_SWEEP_S), None)
        if unit_s is None:
            return None
        sweep_s = span * unit_s
        known = [row for row, part in enumerate(parts) if len(part.since)]
        firsts_s = np.array([parts[row].first for row in known]) * unit_s
        lasts_s = firsts_s + [parts[row].since.max() * unit_s for row in known]
        zeros_s = {Clock.STAMP: np.zeros(len(known))}
        if stamps_s is not None:
            zeros_s[Clock.SHARED] = np.asarray(stamps_s)[known]
        for clock, zero_s in zeros_s.items():
            outside_s = np.maximum(firsts_s - zero_s, zero_s - lasts_s)
            if np.median(outside_s) <= _MAX_OUTSIDE * sweep_s:
                return cls(unit_s, sweep_s, clock, float(np.median(firsts_s - zero_s)))
        return cls(unit_s, sweep_s)

    def of_points(self, columns: Columns, stamp_s: float | None = None) -> Floats | None:
        """Return the times (n,) of the points of a sweep relative to its stamp, seconds.

        None if a time is missing, if the times span no sweep, or if they are far from the stamp.
        """
        times = _times(columns)
        since_s = times.since * self.unit_s
        if len(since_s) != len(next(iter(columns.values()), ())):
            return None
        if not len(since_s):
            return since_s
        first_s = 0.0
        if self.clock is not Clock.OTHER:
            zero_s = stamp_s if self.clock is Clock.SHARED and stamp_s is not None else 0.0
            first_s = times.first * self.unit_s - zero_s
        if since_s.max() > _MAX_SWEEP_S or abs(first_s) > _MAX_SWEEP_S:
            return None
        return since_s + first_s


class _Times(NamedTuple):
    """Times of the points of a sweep in the unit of their column; empty without times."""

    since: Floats  # (n,): since the first, to the last digit
    first: float = 0.0


def _times(columns: Columns) -> _Times:
    """Return the times of points."""
    values = next((columns[name] for name in _TIME_COLUMNS if name in columns), ())
    times = np.asarray(values)
    if not len(times) or times.dtype.kind not in "iuf" or not np.isfinite(times).all():
        return _Times(np.empty(0))
    if times.dtype.kind == "i":  # differences of short integers overflow
        times = times.astype(np.int64)
    first = times.min()
    return _Times(np.asarray((times - first).astype(np.float64)), float(first))


@dataclass(frozen=True, eq=False)
class RecordedSweeps:
    """The sweeps of a recording, which are read one by one.

    Attributes
    ----------
    source
        What other processes open again; or a recording in memory, which stays in this process.
    elevation_rad
        float64 (r,): median elevations of the rings, the highest first; empty for a sensor without
        rings.
    ring_numbers
        int64 (r,): numbers of the rings in the recording; None without a column of rings.
    notes
        Sentences on what the recording lacks.
    times
        The times of points; None if the recording has none.
    stamps_s
        float64 (s,): stamps of the sweeps, seconds; None if the recording has none.
    are_cones
        Whether elevations show the rings, not the order of points.
    """

    source: RecordingChoice | Recording
    elevation_rad: Floats
    ring_numbers: Ints | None
    notes: tuple[str, ...]
    times: PointTimes | None = None
    stamps_s: Floats | None = None
    are_cones: bool = False
    _kept: dict[int, RecordedSweep] = field(default_factory=dict)

    @property
    def recording(self) -> Recording:
        """The recording, which each process opens once."""
        return self.source if isinstance(self.source, Recording) else _opened(self.source)

    @classmethod
    def of_choice(cls, choice: RecordingChoice) -> RecordedSweeps:
        """Open a recording, or raise LidarError if it cannot be read."""
        return replace(cls.of_recording(_opened(choice)), source=choice)

    @classmethod
    def of_recording(cls, recording: Recording) -> RecordedSweeps:
        """Find the rings of a recording, or raise LidarError if no sweep can be read."""
        if recording.is_cloud or not recording.count:
            raise LidarError(
                f"{recording.name} contains no sweeps. Use a recording that consists of sweeps."
            )
        numbers = even_indices(recording.count, _REFERENCE_SWEEPS).tolist()
        # Compensation for motion changes elevations.
        returns = {number: _returns(recording, number, as_fired=True) for number in numbers}
        references = {number: found for number, found in returns.items() if len(found[0])}
        if not references:
            raise LidarError(
                f"{recording.name} contains no points, so there is nothing to reconstruct."
            )
        stamps_s = _stamps_s(recording)
        times = PointTimes.of_sweeps(
            [columns for _, columns in references.values()],
            None if stamps_s is None else stamps_s[[*references]],
        )
        sweeps = cls._of_references(recording, [*references.values()])
        if stamps_s is not None and not sweeps.is_compensated:
            notes = (*sweeps.notes, *_clock_notes(recording.name, times))
            sweeps = replace(sweeps, notes=notes)
        return replace(sweeps, times=times, stamps_s=stamps_s)

    @classmethod
    def _of_references(
        cls, recording: Recording, references: Sequence[tuple[Floats, Columns]]
    ) -> RecordedSweeps:
        """Find the rings in the points and columns of some sweeps."""
        if all(rings_of(columns) is not None for _, columns in references):
            rings = np.concatenate([np.asarray(rings_of(columns)) for _, columns in references])
            elevation = np.concatenate([elevations(points) for points, _ in references])
            numbers, medians, spread_rad = _cones(rings.astype(np.int64), elevation)
            if len(numbers) < MIN_RINGS:
                return cls(recording, np.empty(0), None, ())
            if spread_rad > _MAX_CONE_SPREAD * np.ptp(medians):
                note = (
                    f"The rings of {recording.name} do not form cones, so its ray directions are "
                    "not calibrated."
                )
                return cls(recording, np.empty(0), None, (note,))
            return cls(recording, medians, numbers, ())
        found = [_runs_in_order(points) for points, _ in references]
        runs = [run for run in found if run is not None]
        if not runs:
            clusters = _clusters(np.concatenate([points for points, _ in references]))
            if clusters is not None:
                note = (
                    f"{recording.name} has no ring column. Its {len(clusters)} rings were "
                    "determined from the elevation angles of the points."
                )
                return cls(recording, clusters, None, (note,), are_cones=True)
            note = (
                f"{recording.name} has no ring column, and its rings cannot be determined from "
                "the order or the elevation angles of its points. Either its points are "
                "motion-compensated, or its ray directions are not calibrated."
            )
            return cls(recording, np.empty(0), None, (note,))
        medians = max(runs, key=len)
        note = (
            f"{recording.name} has no ring column. Its {len(medians)} rings were determined "
            "from the order of the points."
        )
        return cls(recording, np.sort(medians)[::-1], None, (note,))

    @property
    def count(self) -> int:
        """Number of sweeps."""
        return self.recording.count

    @property
    def ring_count(self) -> int:
        """Number of rings, 1 for a sensor without rings."""
        return max(len(self.elevation_rad), 1)

    @property
    def gap_rad(self) -> float:
        """Typical angle between the rays of neighboring rings, radians."""
        if len(self.elevation_rad) < MIN_RINGS:
            return _GAP_RAD
        return float(np.median(-np.diff(self.elevation_rad)))

    @property
    def is_compensated(self) -> bool:
        """Whether points are known to be compensated for the motion, as in results."""
        return self.recording.fired is not None

    def keeping(self, numbers: Iterable[int]) -> RecordedSweeps:
        """Read some sweeps, ascending, and keep these: bags are read from their start only."""
        return replace(self, _kept={number: self.read(number).compact() for number in numbers})

    def read(self, number: int) -> RecordedSweep:
        """Read a sweep, or raise LidarError if the recording cannot be read."""
        if number in self._kept:
            return self._kept[number].wide()
        points, columns = _returns(self.recording, number)
        ring, known = self._rings(points, columns)
        intensities = intensities_of(self.recording, columns)
        sweep = RecordedSweep(
            points,
            ring,
            None if intensities is None else np.asarray(intensities, np.float64),
            labels_of(columns),
            self._point_times_s(number, columns),
            _start_rad(points, ring, self.ring_count),
        )
        return sweep if known.all() else sweep.part(known)

    def _point_times_s(self, number: int, columns: Columns) -> Floats | None:
        """Return the times (n,) of the points of a sweep relative to its stamp, or None."""
        if self.is_compensated or self.times is None:
            return None
        stamp_s = None if self.stamps_s is None else float(self.stamps_s[number])
        return self.times.of_points(columns, stamp_s)

    def rotation(self, period_s: float, first_s: float) -> Rotation | None:
        """Find the rotation by the times and azimuths of points, or None if these do not show it.

        A revolution takes `period_s`, and starts at `first_s` relative to the stamp. The azimuth of
        the start is a mean over rings and sweeps. The motion of the sensor hardly changes it, since
        compensation shifts azimuths to the left and right alike.
        """
        if self.times is None:
            return None
        sums = np.zeros(2, complex)
        count = 0
        for number in even_indices(self.count, _REFERENCE_SWEEPS).tolist():
            points, columns = _returns(self.recording, number)
            stamp_s = None if self.stamps_s is None else float(self.stamps_s[number])
            times_s = self.times.of_points(columns, stamp_s)
            if times_s is None or not len(points):
                continue
            azimuth = np.arctan2(points[:, 1], points[:, 0])
            turned = 2 * np.pi * (times_s - first_s) / period_s
            sums += [np.exp(1j * (azimuth - sign * turned)).sum() for sign in (1, -1)]
            count += len(points)
        best = int(np.abs(sums).argmax())
        if np.abs(sums[best]) <= _MIN_AGREEMENT * count:
            return None
        return Rotation(best == 1, float(np.degrees(np.angle(sums[best])) % 360))

    def starts(self, *, is_clockwise: bool) -> Rotation:
        """Return the rotation of a known direction, by where the rings of sweeps start."""
        numbers = even_indices(self.count, _REFERENCE_SWEEPS).tolist()
        start_rad = np.stack([self.read(number).start_rad for number in numbers])
        mean = float(np.angle(np.exp(1j * start_rad).sum()))
        return Rotation(is_clockwise, float(np.degrees(mean) % 360))

    def cone_spread_rad(self, number: int) -> float:
        """Return how far the rings of a sweep are from cones (`_cones`), radians; inf if empty."""
        sweep = self.read(number)
        if not len(sweep):
            return float("inf")
        return _cones(sweep.ring, elevations(sweep.points))[2]

    def _rings(self, points: Floats, columns: Columns) -> tuple[Ints, Bools]:
        """Return the rows of the rings of points (n,), and which rings are known."""
        count = len(points)
        if not len(self.elevation_rad) or not count:
            return np.zeros(count, np.int64), np.ones(count, bool)
        if self.ring_numbers is not None:
            rings = rings_of(columns)
            if rings is None:
                raise LidarError(
                    f"Some sweeps of {self.recording.name} have a ring column, and others do "
                    "not. Use the sweeps of a single sensor."
                )
            numbers = rings.astype(np.int64)
            order = np.argsort(self.ring_numbers)
            place = np.searchsorted(self.ring_numbers, numbers, sorter=order)
            ring = order[np.minimum(place, len(order) - 1)]
            return ring, self.ring_numbers[ring] == numbers
        if self.are_cones:
            middles = (self.elevation_rad[1:] + self.elevation_rad[:-1]) / 2
            return np.searchsorted(-middles, -elevations(points)), np.ones(count, bool)
        starts, is_ring = _runs(points)
        lengths = np.diff(np.append(starts, count))
        ring = self._rings_of_runs(_medians(elevations(points), starts), is_ring)
        return ring.clip(min=0).repeat(lengths), (ring >= 0).repeat(lengths)

    def _rings_of_runs(self, medians: Floats, is_ring: Bools) -> Ints:
        """Return the rows (k,) of runs with median elevations (k,), -1 for a run without a ring.

        Each ring is given to one run: the median elevation of a ring changes with what it meets, by
        more than neighboring rings differ.
        """
        from scipy.optimize import linear_sum_assignment

        ring = np.full(len(medians), -1)
        runs = np.flatnonzero(is_ring)
        chosen, rows = linear_sum_assignment(np.abs(medians[runs, None] - self.elevation_rad))
        ring[runs[chosen]] = rows
        return ring


def _stamps_s(recording: Recording) -> Floats | None:
    """Return the stamps (s,) of the sweeps of a recording, seconds, or None without stamps."""
    if recording.times is None:
        return None
    with reading(recording.name):
        stamps_s = 1e-9 * np.fromiter(recording.times(), np.float64)
    if len(stamps_s) != recording.count:
        raise LidarError(
            f"{recording.name} has {plural(recording.count, 'sweep')}, but only "
            f"{len(stamps_s):,} can be read. Repair the file, or record it again."
        )
    backward = np.flatnonzero(np.diff(stamps_s) <= 0)
    if len(backward):
        number = int(backward[0])
        raise LidarError(
            f"The timestamps of {recording.name} do not increase: sweep {number:,} is at "
            f"{stamps_s[number]:.6f} s, and sweep {number + 1:,} is at "
            f"{stamps_s[number + 1]:.6f} s. Remove repeated sweeps, and sort the others by "
            "timestamp."
        )
    return stamps_s


def _clock_notes(name: str, times: PointTimes | None) -> tuple[str, ...]:
    """Return a note on times of points that cannot be related to the stamps."""
    if times is None or times.clock is not Clock.OTHER:
        return ()
    return (
        f"The point times in {name} use a different clock than the sweep timestamps. The first "
        "point of each sweep is assumed to be fired at the timestamp of the sweep.",
    )


def elevations(points: Floats) -> Floats:
    """Return the elevations (n,) of points (n, 3) in the sensor frame, radians."""
    return np.asarray(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


def _start_rad(points: Floats, ring: Ints, ring_count: int) -> Floats:
    """Return the azimuths (r,) at which the rings of a sweep start: of their first points.

    The lasers of some sensors point to azimuths that differ by several degrees. A ring whose first
    pulses are lost, as in the sky, starts where most rings do.
    """
    if not len(points):
        return np.zeros(ring_count)
    numbers, firsts = np.unique(ring, return_index=True)
    azimuth = np.arctan2(points[firsts, 1], points[firsts, 0])
    apart = np.abs((azimuth[:, None] - azimuth + np.pi) % (2 * np.pi) - np.pi)
    together = apart < _MAX_START_RAD
    common = int(together.sum(axis=1).argmax())
    starts = np.full(ring_count, azimuth[common])
    starts[numbers[together[common]]] = azimuth[together[common]]
    return starts


def _cones(rings: Ints, elevation: Floats) -> tuple[Ints, Floats, float]:
    """Return the numbers and median elevations (r,) of rings, and how far a ring is from a cone.

    The highest ring is first. The last value is the median, over rings, of the range that half of
    the elevations of a ring are in, radians.
    """
    numbers, index = np.unique(rings, return_inverse=True)
    parts = [elevation[index == row] for row in range(len(numbers))]
    low, medians, high = np.array([np.quantile(part, (0.25, 0.5, 0.75)) for part in parts]).T
    order = np.argsort(-medians, kind="stable")
    return numbers[order], medians[order], float(np.median(high - low))


def _clusters(points: Floats) -> Floats | None:
    """Return the elevations (r,) of cones that points (n, 3) lie on, the highest first, or None.

    The gaps between clusters of elevations are all larger than any cluster is wide.
    """
    elevation = np.sort(elevations(points))
    gaps = np.diff(elevation)
    largest = np.sort(gaps)[::-1][:_MAX_CLUSTERS]
    if len(largest) < _MAX_CLUSTERS:
        return None
    ratios = largest[:-1] / np.maximum(largest[1:], 1e-9)
    ratios[: MIN_RINGS - 2] = 0
    last = int(ratios.argmax())  # of the gaps between clusters
    starts = np.append(0, np.flatnonzero(gaps >= largest[last]) + 1)
    stops = np.append(starts[1:], len(elevation)) - 1
    widest = float((elevation[stops] - elevation[starts]).max())
    smallest = (stops - starts + 1).min()
    if largest[last] < max(widest, _MIN_GAP_RATIO * largest[last + 1]):
        return None
    if smallest < _MIN_CLUSTER * len(elevation):
        return None
    return _medians(elevation, starts)[::-1]


def _returns(
    recording: Recording, number: int, *, as_fired: bool = False
) -> tuple[Floats, dict[str, AnyArray]]:
    """Return the points (n, 3) of a sweep in the sensor frame, meters, and their columns.

    With `as_fired`, points that were compensated are not, if the recording has both.
    """
    with reading(recording.name):
        points, columns, _ = recording.read(number)
        recording.check_intensity(columns)
        if as_fired and recording.fired is not None:
            points, columns, _ = recording.fired(number)
            points = np.asarray(points, np.float64) / recording.meters
    positions = np.asarray(points, np.float64)
    # Drivers write NaN or zeros for pulses without a return.
    returned = np.isfinite(positions).all(axis=1) & positions.any(axis=1)
    kept = {name: np.asarray(values)[returned] for name, values in columns.items()}
    return positions[returned] * recording.meters, kept


def _runs(points: Floats) -> tuple[Ints, Bools]:
    """Return where runs of rising or of falling azimuths start (k,), and which runs are rings."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    steps = np.diff(azimuth)
    direction = np.sign(np.sum(np.sign(steps)))
    starts = np.append(0, np.flatnonzero(direction * steps < -_BACKWARD_DEG) + 1)
    lengths = np.diff(np.append(starts, len(points)))
    return starts, lengths > _SHORT_RING * np.median(lengths)


def _medians(values: Floats, starts: Ints) -> Floats:
    """Return the medians (k,) of runs of values (n,)."""
    return np.array([np.median(run) for run in np.split(values, starts[1:])])


def _runs_in_order(points: Floats) -> Floats | None:
    """Return the median elevations (k,) of runs, radians, or None if the runs are not rings."""
    if len(points) < _MAX_RINGS:
        return None
    starts, is_ring = _runs(points)
    if not MIN_RINGS <= is_ring.sum() <= _MAX_RINGS:
        return None
    medians = _medians(elevations(points), starts)[is_ring]
    steps = np.sign(np.diff(medians))
    return medians if abs(steps.mean()) > 2 * _MIN_IN_ORDER - 1 else None
