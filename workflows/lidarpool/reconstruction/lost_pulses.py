"""Pulses of a sweep that returned nothing: the steps of a ring at which no return is.

A ring fires at even steps of azimuth, so a gap of several steps between two returns holds lost
pulses. Two gaps are none. Dropped packets leave gaps in all rings at once. And where points are
compensated for the motion within their sweep, near and far surfaces are moved apart: a sensor that
moves by d meters sees them turn by up to d/r.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

from ..clouds.rings import elevations
from .recorded_sweeps import RecordedSweeps, ring_starts

_MIN_STEPS = 1.6  # of a gap that holds a lost pulse: motion within a sweep submaps steps
_MAX_STEPS = 3.0  # of a ring's own step, over the typical step
_MIN_STEP_RAD = np.radians(0.02)  # closer returns are of one pulse
_MIN_RETURNS = 8  # of a ring whose steps are known
_MAX_GAP_M = 5.0  # wide, of lost pulses on a surface that returns nothing: a side of a car
# Step of range between the ends of such a gap: at most, and for each meter of range.
_MAX_STEP_M = 0.5
_MAX_STEP_PER_M = 0.2
_COLUMNS = 720  # of the cells of a ring, in which a sensor may never see anything
_COVERAGE_SWEEPS = 100  # that show these cells
_LOW_RAD = np.radians(-3)  # elevation of rings that see the ground
_MIN_RETURN_SHARE = 0.1  # share of the sweeps in which a cell of such a ring has a return
_SECTORS = 360  # of azimuth, in which all rings may be empty
_MIN_RINGS = 0.05  # share of the rings that return in a sector; with less, no packet came


def lost_pulses(
    sweep: Sweep, elevation_rad: Floats, coverage: SensorCoverage, moved_m: float
) -> tuple[Sweep, Floats]:
    """Return the lost pulses of a sweep, as points a meter away, and the ranges around their gaps.

    Parameters
    ----------
    sweep
        The returns.
    elevation_rad
        (r,): of the rings, radians; empty for a sensor without rings, whose lost pulses are
        unknown.
    coverage
        Where the sensor has returns at all.
    moved_m
        How far the sensor moved during the sweep, if points are compensated; else 0.

    Returns
    -------
    tuple
        The k pulses, without intensities, and the ranges (k,) that surfaces have there which end
        where the gap does, meters; NaN of a wide gap, or between different surfaces.
    """
    if not len(elevation_rad) or len(sweep) < _MIN_RETURNS:
        return sweep.select(slice(0)), np.empty(0)
    gaps = _Gaps.from_sweep(sweep)
    lost = gaps.between(moved_m)
    silent = np.setdiff1d(np.arange(len(elevation_rad)), gaps.ring)
    circle = np.arange(-np.pi, np.pi, np.median(gaps.step_rad))
    azimuth = np.append(lost.azimuth, np.tile(circle, len(silent)))
    elevation = np.append(lost.elevation, elevation_rad[silent].repeat(len(circle)))
    ring = np.append(lost.ring, silent.repeat(len(circle)))
    range_m = np.append(lost.range_m, np.full(len(silent) * len(circle), np.nan))
    level = np.cos(elevation)
    directions = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    columns: dict[str, AnyArray] = {"row": ring}
    if "time_s" in sweep.columns:
        columns["time_s"] = _times_s(sweep, azimuth)
    if "start_rad" in sweep.columns:
        columns["start_rad"] = ring_starts(sweep, len(elevation_rad))[ring]
    pulses = Sweep(directions, columns)
    received = _received(gaps, len(elevation_rad))[_sectors(azimuth)]
    chosen = received & coverage.cells[_cells(pulses)]
    return pulses.select(chosen), range_m[chosen]


def _times_s(sweep: Sweep, azimuth: Floats) -> Floats:
    """Return the times (k,) of pulses of azimuths (k,): of the returns nearest in azimuth."""
    azimuths = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
    order = np.argsort(azimuths)
    turned = (azimuth + np.pi) % (2 * np.pi) - np.pi
    index = np.searchsorted(azimuths[order], turned).clip(max=len(order) - 1)
    return np.asarray(sweep.columns["time_s"][order[index]])


def firings_per_turn(sweep: Sweep) -> int:
    """Return the number of steps of a revolution, by the typical step between returns of a ring."""
    return round(2 * np.pi / float(np.median(_Gaps.from_sweep(sweep).step_rad)))


class _Lost(NamedTuple):
    """Lost pulses (k,): azimuths and elevations, radians, rings, and ranges around their gaps."""

    azimuth: Floats
    elevation: Floats
    ring: Ints
    range_m: Floats


class _Gaps(NamedTuple):
    """Returns of a sweep, ring by ring with ascending azimuths, and the gaps between them."""

    azimuth: Floats  # (n,): radians
    elevation: Floats  # (n,): radians
    range_m: Floats  # (n,)
    ring: Ints  # (n,)
    following: Ints  # (n,): next return of the ring; the first follows the last
    gap_rad: Floats  # (n,): to the next return of the ring
    step_rad: Floats  # (n,): between the azimuths of neighboring pulses of the ring

    @classmethod
    def from_sweep(cls, sweep: Sweep) -> _Gaps:
        """Sort the returns of a sweep."""
        azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
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
        # Rings of some sensors fire half as often as others. A ring with few returns tells nothing.
        parts = np.split(gap_rad, starts[1:])
        steps_rad = np.array([_step_rad(part) for part in parts])
        typical_rad = float(np.median(steps_rad[counts >= counts.max() / 2]))
        is_known = (counts >= _MIN_RETURNS) & (steps_rad < _MAX_STEPS * typical_rad)
        step_rad = np.where(is_known, steps_rad, typical_rad).repeat(counts)
        elevation = elevations(sweep.points)[order]
        range_m = np.linalg.norm(sweep.points, axis=1)[order]
        return cls(azimuth, elevation, range_m, ring, following, gap_rad, step_rad)

    def between(self, moved_m: float) -> _Lost:
        """Return the pulses at the steps within gaps."""
        parallax_rad = moved_m * np.abs(1 / self.range_m - 1 / self.range_m[self.following])
        steps = np.rint(self.gap_rad / self.step_rad).astype(np.int64)
        is_gap = self.gap_rad > _MIN_STEPS * self.step_rad + parallax_rad
        lost = np.where(is_gap, steps - 1, 0)
        before = np.arange(len(self.ring)).repeat(lost)
        number = np.arange(len(before)) - (np.cumsum(lost) - lost).repeat(lost)
        share = (number + 1) / (lost[before] + 1)
        azimuth = self.azimuth[before] + share * self.gap_rad[before]
        elevation = self.elevation[before]
        elevation = elevation + share * (self.elevation[self.following[before]] - elevation)
        return _Lost(azimuth, elevation, self.ring[before], self._ranges(before, share))

    def _ranges(self, before: Ints, share: Floats) -> Floats:
        """Return the ranges (k,) at shares of gaps that begin at returns (k,).

        NaN where the gap is wide, or its ends are of different surfaces.
        """
        from_m = self.range_m[before]
        to_m = self.range_m[self.following[before]]
        nearer_m = np.minimum(from_m, to_m)
        is_narrow = self.gap_rad[before] * nearer_m < _MAX_GAP_M
        is_one = np.abs(from_m - to_m) < _MAX_STEP_M + _MAX_STEP_PER_M * nearer_m
        range_m = 1 / ((1 - share) / from_m + share / to_m)  # of a plane
        return np.where(is_narrow & is_one, range_m, np.nan)


def _step_rad(gap_rad: Floats) -> float:
    """Return the median of the gaps (k,) of a ring that are between pulses, not within one."""
    return float(np.median(gap_rad[gap_rad > _MIN_STEP_RAD]))


def _received(gaps: _Gaps, ring_count: int) -> Bools:
    """Return in which sectors packets came: some rings have returns there."""
    cells = np.unique(_sectors(gaps.azimuth) * ring_count + gaps.ring)
    rings = np.bincount(cells // ring_count, minlength=_SECTORS)
    return np.asarray(rings >= max(_MIN_RINGS * ring_count, 1))


def _sectors(azimuth: Floats) -> Ints:
    """Return the sectors of azimuths, radians."""
    return np.asarray(np.floor(azimuth / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS)


class SensorCoverage(NamedTuple):
    """Where a sensor has returns at all."""

    cells: Bools  # (r, c): rings and columns; in the others the carrier hides all
    max_range_m: float  # of a return

    @classmethod
    def from_sweeps(cls, sweeps: RecordedSweeps) -> SensorCoverage:
        """Look where any sweep has a return; LidarError if the recording cannot be read."""
        returned = np.zeros((sweeps.ring_count, _COLUMNS), np.int64)
        max_range_m = 0.0
        numbers = even_indices(sweeps.count, _COVERAGE_SWEEPS).tolist()
        for number in numbers:
            sweep = sweeps.read(number)
            cells = np.zeros_like(returned, bool)
            cells[_cells(sweep)] = True
            returned += cells
            if len(sweep):
                max_range_m = max(max_range_m, float(np.linalg.norm(sweep.points, axis=1).max()))
        # Below the horizon is the ground, unless the carrier hides it in most sweeps.
        is_low = np.zeros(sweeps.ring_count, bool)
        is_low[: len(sweeps.elevation_rad)] = sweeps.elevation_rad < _LOW_RAD
        least = np.where(is_low, _MIN_RETURN_SHARE * len(numbers), 0)
        return cls(returned > least[:, None], max_range_m)


def _cells(sweep: Sweep) -> tuple[Ints, Ints]:
    """Return the rings and columns (n,) of the rays of a sweep."""
    turns = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) / (2 * np.pi) + 0.5
    return sweep.columns["row"], (turns * _COLUMNS).astype(np.int64) % _COLUMNS
