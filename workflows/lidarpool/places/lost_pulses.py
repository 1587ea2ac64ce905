"""Pulses of a sweep that returned nothing: the steps of a ring at which no return is.

A ring fires at even steps of azimuth, so a gap of several steps between two returns holds lost
pulses. Two gaps are none. Dropped packets leave gaps in all rings at once. And where points are
compensated for the motion within their sweep, near and far surfaces are moved apart: a sensor that
moves by d metres sees them turn by up to d/r.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Ints

from .alignment import AlignedSweep, placed
from .recorded_sweeps import elevations

_MIN_STEPS = 1.6  # of a gap that holds a lost pulse: motion within a sweep stretches steps
_MIN_RETURNS = 8  # of a ring whose steps are known
_SECTORS = 360  # of azimuth, in which all rings may be empty
_MIN_RINGS = 0.05  # share of the rings that return in a sector; with less, no packet came


def lost_pulses(
    sweep: AlignedSweep, pose: Floats, elevation_rad: Floats, moved_m: float
) -> AlignedSweep:
    """Return the lost pulses of a sweep, as points a metre away without intensities.

    Parameters
    ----------
    sweep, pose
        The returns, and the pose (4, 4) of the sensor.
    elevation_rad
        (r,): of the rings, radians; empty for a sensor without rings, whose lost pulses are
        unknown.
    moved_m
        How far the sensor moves during the sweep.
    """
    directions = np.empty((0, 3))
    ring = np.empty(0, np.int64)
    if len(elevation_rad) and len(sweep.points) >= _MIN_RETURNS:
        directions, ring = _lost(sweep, elevation_rad, moved_m)
    world = placed(directions, pose)
    return AlignedSweep(directions, world, sweep.origin, ring, None, None)


def _lost(sweep: AlignedSweep, elevation_rad: Floats, moved_m: float) -> tuple[Floats, Ints]:
    """Return the directions (k, 3) of lost pulses in the sensor frame, and their rings (k,)."""
    gaps = _Gaps.of_sweep(sweep)
    azimuth, elevation, ring = gaps.between(moved_m)
    silent = np.setdiff1d(np.arange(len(elevation_rad)), gaps.ring)
    circle = np.arange(-np.pi, np.pi, gaps.step_rad)
    azimuth = np.append(azimuth, np.tile(circle, len(silent)))
    elevation = np.append(elevation, elevation_rad[silent].repeat(len(circle)))
    ring = np.append(ring, silent.repeat(len(circle)))
    level = np.cos(elevation)
    directions = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    known = _received(gaps, len(elevation_rad))[_sectors(azimuth)]
    return directions[known], ring[known]


class _Gaps(NamedTuple):
    """Returns of a sweep, ring by ring with ascending azimuths, and the gaps between them."""

    azimuth: Floats  # (n,): radians
    elevation: Floats  # (n,): radians
    range_m: Floats  # (n,)
    ring: Ints  # (n,)
    following: Ints  # (n,): next return of the ring; the first follows the last
    gap_rad: Floats  # (n,): to the next return of the ring
    step_rad: float  # of the azimuths of neighbouring pulses

    @classmethod
    def of_sweep(cls, sweep: AlignedSweep) -> _Gaps:
        """Sort the returns of a sweep."""
        azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
        order = np.lexsort((azimuth, sweep.ring))
        azimuth = azimuth[order]
        ring = sweep.ring[order]
        starts = np.flatnonzero(np.diff(ring, prepend=-1))
        counts = np.diff(np.append(starts, len(ring)))
        lasts = starts + counts - 1
        following = np.arange(len(ring)) + 1
        following[lasts] = starts
        gap_rad = azimuth[following] - azimuth
        gap_rad[lasts] += 2 * np.pi
        # Steps are those of the rings with few gaps.
        filled = (counts >= counts.max() / 2).repeat(counts) & (gap_rad > 0)
        step_rad = float(np.median(gap_rad[filled])) if filled.any() else 2 * np.pi
        elevation = elevations(sweep.points)[order]
        range_m = sweep.range_m[order]
        return cls(azimuth, elevation, range_m, ring, following, gap_rad, step_rad)

    def between(self, moved_m: float) -> tuple[Floats, Floats, Ints]:
        """Return the azimuths, elevations and rings (k,) of the steps within gaps."""
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
        return azimuth, elevation, self.ring[before]


def _received(gaps: _Gaps, ring_count: int) -> Bools:
    """Return in which sectors packets came: some rings have returns there."""
    cells = np.unique(_sectors(gaps.azimuth) * ring_count + gaps.ring)
    rings = np.bincount(cells // ring_count, minlength=_SECTORS)
    return np.asarray(rings >= max(_MIN_RINGS * ring_count, 1))


def _sectors(azimuth: Floats) -> Ints:
    """Return the sectors of azimuths, radians."""
    return np.asarray(np.floor(azimuth / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS)
