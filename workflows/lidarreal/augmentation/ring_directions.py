"""Directions of the pulses in a recording, and the search for the pulses closest to given rays.

The directions are measured from the returns of a few sweeps. The elevation of a ring is therefore a
function of the azimuth, so that tilted sensors and motion-compensated points need no special cases.
Results of lidarpool contain the exact directions, which are used instead.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarfiles.clouds.rings import elevations
from lidarfiles.recordings.opening import with_sweeps
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints, to_writable
from lidarsim.numerics.even_samples import even_indices

from ..scan_patterns.phases import MIN_STEP_RAD, RingSeries, ring_steps
from .nearest_pulse_loops import CandidateRings, SortedReturns, find_pulses, sort_returns

SECTORS = 36  # azimuth sectors in which the elevation of a ring is measured
_REFERENCE_SWEEPS = 5  # sweeps from which the directions are measured
_MAX_GAP_RAD = np.radians(60)  # A wider sector without returns is outside the field of view.
_MAX_COLUMNS = 4096  # maximum number of cells per ring in which returns are sorted
_SPREAD_QUANTILE = 0.99


class RingDirections:
    """Directions of the pulses in a recording.

    Rings are sorted from the highest to the lowest, as in `Recording.rings`.

    Parameters
    ----------
    recording
        Recording whose rings can be determined.
    silent_rad
        Elevations of rings without returns in radians, which lie above or below all others. Shape
        (s,).

    Attributes
    ----------
    elevation_rad
        Median elevation of each ring in radians, including the rings without returns. Shape (r,).
    silent_above
        Number of rings without returns that lie above the others.
    step_rad
        Azimuth difference between consecutive pulses of each ring in radians. Shape (r,).
    spread_rad
        Deviation of measured elevations from `elevations_at` in radians, for 99 % of the returns.
    max_range_m
        Largest range of the returns in meters.

    Raises
    ------
    LidarError
        If the recording cannot be read, or if its rings are unknown.
    """

    def __init__(self, recording: Recording, silent_rad: Floats | None = None) -> None:
        self.recording = recording
        self._check_rings()
        measured = recording.rings.elevation_rad
        silent = np.empty(0) if silent_rad is None else np.sort(silent_rad)[::-1]
        above = silent[silent > measured[0]]
        below = silent[silent < measured[-1]]
        self.elevation_rad = np.concatenate([above, measured, below])
        self.silent_above = len(above)
        numbers = even_indices(len(recording), _REFERENCE_SWEEPS).tolist()
        sweeps = [self._ringed(recording[number]) for number in numbers]
        points = np.concatenate([points for _, points, _ in sweeps])
        rings = np.concatenate([rings for _, _, rings in sweeps])
        if not len(points):
            raise LidarError(f"{recording.info.name} contains no returns.")
        self.max_range_m = float(np.linalg.norm(points, axis=1).max())
        self.step_rad = _steps_rad([ringed[1:] for ringed in sweeps], len(self))
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        self._azimuths = np.sort(azimuth)
        elevation = elevations(points)
        self._profiles = self._measured_profiles(rings, azimuth, elevation)
        known = rings >= 0
        deviation = np.abs(elevation - self._elevations_of(rings, azimuth))[known]
        self.spread_rad = float(np.quantile(deviation, _SPREAD_QUANTILE))

    def _check_rings(self) -> None:
        recording = self.recording
        with_sweeps(recording)
        if not len(recording.rings):
            reason = recording.rings.note or f"The rings of {recording.info.name} are unknown."
            raise LidarError(f"{reason} Without rings, its sweeps cannot be resampled.")

    def __len__(self) -> int:
        """Return the number of rings."""
        return len(self.elevation_rad)

    def _ringed(self, sweep: Sweep) -> tuple[Ints, Floats, Ints]:
        """Return the rows, the positions and the rings of the returns of a sweep.

        The rings are -1 if they are unknown.
        """
        rows = np.flatnonzero(sweep.has_return)
        columns = {"channel": sweep.columns["channel"]} if "channel" in sweep.columns else {}
        returns = Sweep(self._points_as_fired(sweep), columns)
        if len(rows) < len(sweep):
            returns = returns.select(rows)
        points = to_writable(returns.points)
        rings = self.recording.rings.ring_indices(returns)
        return rows, points, np.where(rings < 0, -1, rings + self.silent_above)

    def _points_as_fired(self, sweep: Sweep) -> AnyArray:
        """Return the points without motion compensation, as far as the recording contains them."""
        recording = self.recording
        if not recording.info.has_firing_poses or not sweep.compensated:
            return sweep.points
        fired = recording.fired(sweep.number)
        return fired.points if len(fired) == len(sweep) else sweep.points

    def _measured_profiles(self, rings: Ints, azimuth: Floats, elevation: Floats) -> Floats:
        """Return the elevation of each ring at the centers of sectors, with shape (r, SECTORS).

        Rings have no returns in some sectors. Their deviation from the median elevation is then
        that of the other rings.
        """
        known = rings >= 0
        sector = ((azimuth[known] + np.pi) / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS
        cell = rings[known] * SECTORS + sector
        order = np.lexsort((elevation[known], cell))
        counts = np.bincount(cell, minlength=len(self) * SECTORS)
        middles = np.cumsum(counts) - counts + counts // 2
        present = counts > 0
        deviations = np.full(len(self) * SECTORS, np.nan)
        deviations[present] = elevation[known][order][middles[present]]
        deviations = deviations.reshape(len(self), SECTORS) - self.elevation_rad[:, None]
        is_filled = ~np.isnan(deviations).all(axis=0)
        common = np.zeros(SECTORS)
        common[is_filled] = np.nanmedian(deviations[:, is_filled], axis=0)
        return self.elevation_rad[:, None] + np.where(np.isnan(deviations), common, deviations)

    def _elevations_of(self, rings: Ints, azimuth: Floats) -> Floats:
        before, after, share = _sectors_at(azimuth)
        return (1 - share) * self._profiles[rings, before] + share * self._profiles[rings, after]

    def elevations_at(self, azimuth: Floats) -> Floats:
        """Return the elevation of each ring at some azimuths in radians.

        For `azimuth` of shape (k,), the result has shape (k, r).
        """
        before, after, share = _sectors_at(azimuth)
        profiles = self._profiles.T
        return (1 - share)[:, None] * profiles[before] + share[:, None] * profiles[after]

    @cached_property
    def view_rad(self) -> tuple[float, float]:
        """Start and width of the horizontal field of view in radians, counterclockwise.

        A sector without returns is outside the field of view if it is wider than 60 degrees.
        """
        gaps = np.diff(self._azimuths, append=self._azimuths[0] + 2 * np.pi)
        widest = int(gaps.argmax())
        if gaps[widest] < _MAX_GAP_RAD:
            return -np.pi, 2 * np.pi
        start = float(self._azimuths[(widest + 1) % len(gaps)])
        return start, float(2 * np.pi - gaps[widest])

    def is_in_view(self, azimuth: Floats) -> Bools:
        """Return whether azimuths in radians lie in the horizontal field of view."""
        start, width = self.view_rad
        margin = float(np.median(self.step_rad)) / 2
        return np.asarray((azimuth - start + margin) % (2 * np.pi) <= width + 2 * margin)

    def closest(
        self, sweep: Sweep, azimuth: Floats, elevation: Floats, candidates: CandidateRings
    ) -> tuple[Ints, Ints]:
        """Return the rows of the recorded returns that are closest to k rays.

        Parameters
        ----------
        sweep
            Recorded sweep.
        azimuth, elevation
            Directions of the rays in radians, with shape (k,). Azimuths are from -pi to pi.
        candidates
            Rings that may contain the closest pulses.

        Returns
        -------
        rows
            Ascending rows of the sweep, with shape (m,). All returns of a pulse are included.
        rays
            Ray to which each return is closest, with shape (m,).
        """
        rows, points, rings = self._ringed(sweep)
        columns = int(np.clip(2 * np.pi / self.step_rad.min(), 1, _MAX_COLUMNS))
        count = len(points)
        returns = SortedReturns(
            np.empty(count, np.int64),
            np.empty(count),
            np.empty(count),
            np.empty(count, np.int64),
            np.zeros(len(self) * columns + 1, np.int64),
            columns,
        )
        rings = to_writable(rings, np.int64)
        is_used = _ring_mask(candidates, len(self))
        sort_returns(points, rings, is_used, self.step_rad, np.empty(count, np.int64), returns)
        sorted_count = int(returns.starts[-1])
        ray = np.full(sorted_count, -1)
        find_pulses(
            azimuth, elevation, candidates, returns, self.step_rad, ray, np.empty(sorted_count)
        )
        rays = np.full(count, -1)
        rays[returns.row[:sorted_count]] = ray
        chosen = np.flatnonzero(rays >= 0)
        return rows[chosen], rays[chosen]


def _ring_mask(candidates: CandidateRings, ring_count: int) -> Bools:
    changes = np.bincount(candidates.first_ring, minlength=ring_count + 1)
    changes = changes - np.bincount(
        candidates.first_ring + candidates.ring_count, minlength=ring_count + 1
    )
    return np.asarray(np.cumsum(changes)[:ring_count] > 0)


def _sectors_at(azimuth: Floats) -> tuple[Ints, Ints, Floats]:
    """Return the sectors around azimuths, and the weight of the second sector."""
    place = (azimuth + np.pi) / (2 * np.pi) * SECTORS - 0.5
    before = np.floor(place).astype(np.int64)
    return before % SECTORS, (before + 1) % SECTORS, place - before


def _steps_rad(sweeps: list[tuple[Floats, Ints]], ring_count: int) -> Floats:
    """Return the azimuth step of each ring, from the points and rings of several sweeps."""
    points = np.concatenate([points for points, _ in sweeps])
    ring = np.concatenate([ring for _, ring in sweeps])
    sweep = np.arange(len(sweeps)).repeat([len(ring) for _, ring in sweeps])
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    gaps = RingSeries.from_values(azimuth, ring, sweep).gaps(MIN_STEP_RAD)
    if not len(gaps[0]):
        raise LidarError("The sweeps have too few points to determine the azimuth step of a ring.")
    return ring_steps(*gaps, ring_count)
