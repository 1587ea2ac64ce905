"""Detect pulses without a return in the gaps between a ring's returns.

A ring fires at even azimuth steps, so a gap of several steps between two returns contains lost
pulses. There are two exceptions. Dropped packets leave gaps in all rings at once. In
motion-compensated sweeps, parallax separates near and far surfaces. If the sensor moves by d
meters, the direction to a surface at range r changes by up to d/r.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

from ..scan_patterns.lasers import RingLasers
from ..scan_patterns.phases import MIN_STEP_RAD
from .blocked_directions import BlockedDirections, PulseCounts, azimuth_cells
from .recorded_sweeps import RecordedSweeps, ring_starts

_MIN_STEPS = 1.6  # minimum gap in steps, since motion within a sweep stretches steps
_MAX_STEPS = 3.0  # maximum step of a ring relative to the typical step
_MIN_RETURNS = 8  # minimum number of returns of a sweep, and to determine the step of a ring
_MAX_GAP_M = 5.0  # maximum width of a gap on a surface without returns, such as the side of a car
# Maximum range difference across such a gap, as a constant and per meter of range.
_MAX_STEP_M = 0.5
_MAX_STEP_PER_M = 0.2
_COLUMNS = 720  # azimuth cells per ring, which may be hidden from the sensor
_COVERAGE_SWEEPS = 100  # sweeps that determine the coverage
_LOW_RAD = np.radians(-3)  # Rings below this elevation observe the ground.
_MIN_RETURN_SHARE = 0.1  # minimum share of sweeps with a return in a cell of such a ring
_SECTORS = 360  # azimuth sectors, in which all rings may be empty
_MIN_RINGS = 0.05  # minimum share of rings with returns in a sector that received packets


def lost_pulses(
    sweep: Sweep, lasers: RingLasers, coverage: SensorCoverage, moved_m: float
) -> tuple[Sweep, Floats]:
    """Find the pulses of a sweep that were lost.

    Parameters
    ----------
    sweep
        The returns.
    lasers
        Lasers of the rings. Empty for a sensor without rings, whose lost pulses are unknown.
    coverage
        Directions in which the sensor can have returns.
    moved_m
        Distance in meters that the sensor moved during the sweep if the points are
        motion-compensated, otherwise 0.

    Returns
    -------
    tuple
        The k lost pulses as points one meter from their lasers, without intensities, and the ranges
        of the surfaces at their gaps. The ranges have shape (k,) and are in meters. They are NaN if
        the gap is wide or lies between different surfaces.
    """
    if not len(lasers) or len(sweep) < _MIN_RETURNS:
        return sweep.select(slice(0)), np.empty(0)
    gaps = _Gaps.from_sweep(sweep, lasers)
    lost = gaps.between(moved_m)
    if lasers.have_constant_elevations:
        lost = lost._replace(elevation=lasers.elevation_rad[lost.ring])
    silent = np.setdiff1d(np.arange(len(lasers)), gaps.ring)
    circle = np.arange(-np.pi, np.pi, np.median(gaps.step_rad))
    azimuth = np.append(lost.azimuth, np.tile(circle, len(silent)))
    elevation = np.append(lost.elevation, lasers.elevation_rad[silent].repeat(len(circle)))
    ring = np.append(lost.ring, silent.repeat(len(circle)))
    range_m = np.append(lost.range_m, np.full(len(silent) * len(circle), np.nan))
    columns: dict[str, AnyArray] = {"row": ring}
    if "time_s" in sweep.columns:
        columns["time_s"] = _times_s(sweep, azimuth)
    if "start_rad" in sweep.columns:
        columns["start_rad"] = ring_starts(sweep, len(lasers))[ring]
        columns["azimuth_rad"] = azimuth
    pulses = Sweep(lasers.ends(azimuth, elevation, ring, np.ones(len(ring))), columns)
    received = _received(gaps, len(lasers))[_sectors(azimuth)]
    chosen = received & coverage.cells[azimuth_cells(azimuth, ring, _COLUMNS)]
    return pulses.select(chosen), range_m[chosen]


def _times_s(sweep: Sweep, azimuth: Floats) -> Floats:
    """Return the time of each pulse, taken from the return with the closest azimuth."""
    azimuths = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
    order = np.argsort(azimuths)
    turned = (azimuth + np.pi) % (2 * np.pi) - np.pi
    index = np.searchsorted(azimuths[order], turned).clip(max=len(order) - 1)
    return np.asarray(sweep.columns["time_s"][order[index]])


def firings_per_turn(sweep: Sweep, lasers: RingLasers) -> int:
    """Return the number of firings per revolution, derived from the typical azimuth step."""
    return round(2 * np.pi / float(np.median(_Gaps.from_sweep(sweep, lasers).step_rad)))


class _Lost(NamedTuple):
    """Lost pulses, as arrays of k pulses.

    Angles are in radians. `range_m` has the ranges of surfaces at the gaps in meters.
    """

    azimuth: Floats
    elevation: Floats
    ring: Ints
    range_m: Floats


class _Gaps(NamedTuple):
    """Returns of a sweep sorted by ring and azimuth, and the gaps between these returns.

    Angles and ranges are as seen from the lasers.
    """

    azimuth: Floats  # (n,), radians, not reduced to a revolution
    elevation: Floats  # (n,), radians
    range_m: Floats  # (n,), meters
    ring: Ints  # (n,)
    following: Ints  # (n,), index of the next return in the ring, where the first follows the last
    gap_rad: Floats  # (n,), azimuth difference to the next return
    step_rad: Floats  # (n,), azimuth step between consecutive pulses of the ring

    @classmethod
    def from_sweep(cls, sweep: Sweep, lasers: RingLasers) -> _Gaps:
        azimuth, elevation = lasers.angles(sweep.points, sweep.columns["row"])
        order = np.lexsort((azimuth, sweep.columns["row"]))
        azimuth = azimuth[order]
        ring = sweep.columns["row"][order]
        starts = np.flatnonzero(np.diff(ring, prepend=-1))
        counts = np.diff(np.append(starts, len(ring)))
        lasts = starts + counts - 1
        following = np.arange(len(ring)) + 1
        following[lasts] = starts
        gap_rad = azimuth[following] - azimuth
        gap_rad[lasts] += 2 * np.pi
        # In some sensors, certain rings fire at half the rate of the others. A ring with few
        # returns is uninformative.
        steps_rad = np.array([_step_rad(part) for part in np.split(gap_rad, starts[1:])])
        typical_rad = float(np.median(steps_rad[counts >= counts.max() / 2]))
        is_known = (counts >= _MIN_RETURNS) & (steps_rad < _MAX_STEPS * typical_rad)
        step_rad = np.where(is_known, steps_rad, typical_rad).repeat(counts)
        range_m = lasers.ranges(sweep.points[order], ring)
        return cls(azimuth, elevation[order], range_m, ring, following, gap_rad, step_rad)

    def between(self, moved_m: float) -> _Lost:
        """Return the pulses that were lost within gaps."""
        parallax_rad = moved_m * np.abs(1 / self.range_m - 1 / self.range_m[self.following])
        steps = np.rint(self.gap_rad / self.step_rad).astype(np.int64)
        is_gap = self.gap_rad > _MIN_STEPS * self.step_rad + parallax_rad
        lost = np.where(is_gap, steps - 1, 0)
        before = np.arange(len(self.ring)).repeat(lost)
        number = np.arange(len(before)) - (np.cumsum(lost) - lost).repeat(lost)
        fraction = (number + 1) / (lost[before] + 1)
        azimuth = self.azimuth[before] + fraction * self.gap_rad[before]
        elevation = self.elevation[before]
        elevation = elevation + fraction * (self.elevation[self.following[before]] - elevation)
        return _Lost(azimuth, elevation, self.ring[before], self._ranges(before, fraction))

    def _ranges(self, before: Ints, share: Floats) -> Floats:
        """Interpolate ranges within gaps. `before` is the return before each gap.

        The ranges are NaN if the gap is wide or its ends lie on different surfaces.
        """
        from_m = self.range_m[before]
        to_m = self.range_m[self.following[before]]
        nearer_m = np.minimum(from_m, to_m)
        is_narrow = self.gap_rad[before] * nearer_m < _MAX_GAP_M
        is_one = np.abs(from_m - to_m) < _MAX_STEP_M + _MAX_STEP_PER_M * nearer_m
        range_m = 1 / ((1 - share) / from_m + share / to_m)  # of a plane
        return np.where(is_narrow & is_one, range_m, np.nan)


def _step_rad(gap_rad: Floats) -> float:
    """Return the median azimuth step of a ring, ignoring steps between returns of one pulse.

    The azimuths of motion-compensated points depend on their ranges, so the smallest gaps, between
    returns at different ranges, are much smaller than a step.
    """
    return float(np.median(gap_rad[gap_rad > MIN_STEP_RAD]))


def _received(gaps: _Gaps, ring_count: int) -> Bools:
    """Mark azimuth sectors in which enough rings have returns to show that packets arrived."""
    cells = np.unique(_sectors(gaps.azimuth) * ring_count + gaps.ring)
    rings = np.bincount(cells // ring_count, minlength=_SECTORS)
    return np.asarray(rings >= max(_MIN_RINGS * ring_count, 1))


def _sectors(azimuth: Floats) -> Ints:
    return np.asarray(np.floor(azimuth / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS)


class SensorCoverage(NamedTuple):
    """Directions from which a sensor can receive returns."""

    cells: Bools  # (r, c), rings and azimuth cells that the vehicle does not block
    max_range_m: float  # maximum range of a return, meters
    blocked: BlockedDirections = BlockedDirections.none()  # in which pulses never return

    @classmethod
    def from_sweeps(cls, sweeps: RecordedSweeps) -> SensorCoverage:
        """Determine the directions from which sweeps contain returns.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        returned = np.zeros((sweeps.ring_count, _COLUMNS), np.int64)
        max_range_m = 0.0
        numbers = even_indices(sweeps.count, _COVERAGE_SWEEPS).tolist()
        for number in numbers:
            sweep = sweeps.read_surfaces(number)
            cells = np.zeros_like(returned, bool)
            ring = sweep.columns["row"]
            azimuth, _ = sweeps.lasers.angles(sweep.points, ring)
            cells[azimuth_cells(azimuth, ring, _COLUMNS)] = True
            returned += cells
            if len(sweep):
                max_range_m = max(max_range_m, float(np.linalg.norm(sweep.points, axis=1).max()))
        # Rings below the horizon observe the ground in most sweeps, unless the vehicle blocks them.
        is_low = np.zeros(sweeps.ring_count, bool)
        is_low[: len(sweeps.elevation_rad)] = sweeps.elevation_rad < _LOW_RAD
        least = np.where(is_low, _MIN_RETURN_SHARE * len(numbers), 0)
        return cls(returned > least[:, None], max_range_m)

    def with_blocked(self, sweeps: RecordedSweeps, numbers: Ints) -> SensorCoverage:
        """Return a copy with the blocked directions that some sweeps show.

        The points must not be motion-compensated. Without sweeps, nothing is blocked.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        lasers = sweeps.lasers
        if not len(lasers) or not len(numbers):
            return self
        everything = self._replace(cells=np.ones_like(self.cells))
        columns = firings_per_turn(sweeps.read(int(numbers[len(numbers) // 2])), lasers)
        counts = PulseCounts.zeros(sweeps.ring_count, columns)
        for number in numbers.tolist():
            sweep = sweeps.read(number)
            lost, range_m = lost_pulses(sweep, lasers, everything, 0.0)
            ring = sweep.columns["row"]
            azimuth, _ = lasers.angles(sweep.points, ring)
            counts.add_returned(azimuth, ring, lasers.ranges(sweep.points, ring))
            ring = lost.columns["row"]
            azimuth, _ = lasers.angles(lost.points, ring)
            counts.add_lost(azimuth, ring, range_m)
        return self._replace(blocked=counts.blocked(lasers.elevation_rad))
