"""Positions and directions of a sensor's lasers, determined from a few sweeps.

In some sensors, the lasers are not at the origin of the recorded points. The lasers of an HDL-64E
are 0.1 to 0.2 m above it, for example. The elevation of a point above the origin then depends on
its range, and the ring is not a cone. The same applies to the azimuth if a laser is beside the axis
of the head.

Only the part of an offset that is perpendicular to the beam has an effect on the directions. As in
Velodyne's calibration files, the vertical offset points upward and the horizontal offset leftward,
both at right angles to the beam. An offset along the beam is part of the range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.rings import MIN_RINGS, elevations
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats, Ints

_MIN_RETURNS = 50  # minimum number of returns of a ring in a sweep
_MIN_RANGE_M = 0.5  # The lasers are closer to the origin than the returns that are used.
_MIN_OFFSET_M = 0.002  # Smaller typical offsets are treated as 0.
_MAX_OFFSET_M = 0.5  # Larger offsets are implausible.
_MIN_SIGNIFICANCE = 5.0  # minimum ratio of the typical offset to its standard error
_MAX_ERROR_M = 0.01  # An offset with a larger standard error is taken from the nearest rings.
_MAX_SPREAD_SHARE = 0.7  # maximum spread of the elevations relative to that of cones
_MAX_MODELED_RAD = np.radians(0.02)  # maximum spread of rings whose elevations are constant
_ROUNDS = 12  # iterations of a robust fit
_CONVERGED = 1e-7  # change of the coefficients, radians and meters, below which a fit ends
_CAUCHY_SIGMAS = 2.0  # residual at which the weight of a return is halved
_MIN_SIGMA_RAD = 1e-7  # minimum spread of residuals, because files without noise have none
_MODEL_RAD = 1e-5  # minimum spread of residuals for standard errors, because the model is linear
_MAX_PULSES = 3  # maximum number of pulses between returns whose azimuths are compared
# Changes of azimuth due to the offset that are certainly smaller than the azimuth step, in steps.
_MAX_SHIFT = 0.3
_FIRST_OFFSET_M = 0.06  # largest horizontal offset that is found


@dataclass(frozen=True, eq=False)
class RingLasers:
    """Lasers of the rings of a sensor.

    Attributes
    ----------
    elevation_rad
        Elevation of the beam of each ring in radians, of shape (r,). Empty for a sensor without
        rings.
    vertical_m, horizontal_m
        Offset of each laser from the origin of the points in meters, upward and leftward, and
        perpendicular to the beam. Both have shape (r,).
    spread_rad
        Typical interquartile range of the elevations within a ring, as seen from its laser.
    is_measured
        Whether the ranges of each ring differ enough to measure the vertical offset of its laser.
        Otherwise, the offset is that of a neighboring ring or 0. Shape (r,), or None if offsets
        were not estimated.
    """

    elevation_rad: Floats
    vertical_m: Floats
    horizontal_m: Floats
    spread_rad: float = float("inf")
    is_measured: Bools | None = None

    @classmethod
    def at_origin(cls, elevation_rad: Floats, spread_rad: float = float("inf")) -> RingLasers:
        """Return lasers at the origin of the points."""
        zeros = np.zeros(len(elevation_rad))
        return cls(elevation_rad, zeros, zeros, spread_rad)

    @classmethod
    def from_sweeps(
        cls, sweeps: Sequence[tuple[Floats, Ints]], elevation_rad: Floats
    ) -> RingLasers:
        """Determine the lasers of a sensor.

        If no vertical offset is significant, the elevations are not changed.

        Parameters
        ----------
        sweeps
            Points of each sweep, of shape (n, 3), and the indices of their rings, of shape (n,),
            in the order of `elevation_rad`. Points of an unknown ring have the index -1. The points
            should not be motion-compensated.
        elevation_rad
            Median elevation of each ring as seen from the origin, in radians. Shape (r,).
        """
        count = len(elevation_rad)
        if count < MIN_RINGS:
            return cls.at_origin(elevation_rad)
        parts = [_RingReturns.from_sweep(*sweep, count) for sweep in sweeps]
        vertical = _Offsets.combine([part.vertical_offsets() for part in parts])
        horizontal = _Offsets.combine([part.horizontal_offsets() for part in parts])
        # Lasers of neighboring rings are at similar heights, but often on opposite sides.
        is_measured = vertical.are_certain
        vertical_m, known = vertical.significant()
        if known.any():
            apart = np.abs(elevation_rad[:, None] - elevation_rad[known])
            vertical_m = vertical_m[known][apart.argmin(axis=1)]
        horizontal_m, _ = horizontal.significant()
        level, level_spread_rad = cls(
            elevation_rad, np.zeros(count), horizontal_m, is_measured=is_measured
        )._with_elevations(parts)
        raised, spread_rad = replace(level, vertical_m=vertical_m)._with_elevations(parts)
        if not vertical_m.any() or spread_rad > _MAX_SPREAD_SHARE * level_spread_rad:
            return replace(level, elevation_rad=elevation_rad, spread_rad=level_spread_rad)
        return replace(raised, spread_rad=spread_rad)

    def _with_elevations(self, parts: Sequence[_RingReturns]) -> tuple[RingLasers, float]:
        """Return the lasers with the median elevations as seen from them, and the spread."""
        elevation_rad = self.elevation_rad.copy()
        spreads_rad = []
        for ring in range(len(self)):
            points = np.concatenate([part.points[part.slices[ring]] for part in parts])
            if not len(points):
                continue
            _, elevation = self.angles(points, np.full(len(points), ring))
            low, middle, high = np.quantile(elevation, (0.25, 0.5, 0.75))
            elevation_rad[ring] = middle
            spreads_rad.append(high - low)
        spread_rad = float(np.median(spreads_rad)) if spreads_rad else float("inf")
        return replace(self, elevation_rad=elevation_rad), spread_rad

    def __len__(self) -> int:
        return len(self.elevation_rad)

    def sort_by_elevation(self) -> RingLasers:
        """Return the lasers from the highest beam to the lowest.

        The rings are sorted by median elevation as seen from the origin, which depends on the
        ranges.
        """
        order = np.argsort(-self.elevation_rad, kind="stable")
        return RingLasers(
            self.elevation_rad[order],
            self.vertical_m[order],
            self.horizontal_m[order],
            self.spread_rad,
            None if self.is_measured is None else self.is_measured[order],
        )

    @cached_property
    def is_at_origin(self) -> bool:
        """Whether all lasers are at the origin of the points."""
        return not (self.vertical_m.any() or self.horizontal_m.any())

    @property
    def have_constant_elevations(self) -> bool:
        """Whether the returns of a ring have the same elevation as seen from its laser.

        This is not the case if the points are motion-compensated while the sensor moves.
        """
        return self.spread_rad < _MAX_MODELED_RAD

    def angles(self, points: Floats, ring: Ints) -> tuple[Floats, Floats]:
        """Return the azimuth and elevation of the beams that ended at some points, in radians.

        `points` are in the sensor frame, with shape (n, 3).
        """
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        if self.is_at_origin:
            return azimuth, elevations(points)
        vertical_m = self.vertical_m[ring]
        horizontal_m = self.horizontal_m[ring]
        level_sq = np.square(points[:, 0]) + np.square(points[:, 1]) - np.square(horizontal_m)
        forward = np.sqrt(np.maximum(level_sq, 0))
        range_m = np.hypot(forward, points[:, 2])
        sine = np.clip(vertical_m / np.maximum(range_m, 1e-9), -1, 1)
        elevation = np.arctan2(points[:, 2], forward) - np.arcsin(sine)
        return azimuth - np.arctan2(horizontal_m, forward), elevation

    def origins(self, points: Floats, ring: Ints) -> Floats:
        """Return the position of the laser for each point, in the sensor frame.

        `points` and the result have shape (n, 3).
        """
        if self.is_at_origin:
            return np.zeros_like(points)
        return self.positions(*self.angles(points, ring), ring)

    def ranges(self, points: Floats, ring: Ints) -> Floats:
        """Return the distances between points and their lasers in meters, of shape (n,)."""
        # The offsets are perpendicular to the beam.
        x, y, z = points.T
        squares = np.square(x) + np.square(y) + np.square(z)
        if not self.is_at_origin:
            squares -= np.square(self.vertical_m[ring]) + np.square(self.horizontal_m[ring])
        return np.sqrt(np.maximum(squares, 0))

    def positions(self, azimuth: Floats, elevation: Floats, ring: Ints) -> Floats:
        """Return the positions of lasers whose beams have the given angles, of shape (n, 3)."""
        vertical_m = self.vertical_m[ring]
        horizontal_m = self.horizontal_m[ring]
        sin, cos = np.sin(azimuth), np.cos(azimuth)
        backward = vertical_m * np.sin(elevation)
        return np.stack(
            [
                -backward * cos - horizontal_m * sin,
                -backward * sin + horizontal_m * cos,
                vertical_m * np.cos(elevation),
            ],
            axis=1,
        )

    def ends(self, azimuth: Floats, elevation: Floats, ring: Ints, range_m: Floats) -> Floats:
        """Return the points at some distances along beams, in the sensor frame.

        `range_m` and the angles have shape (n,), and the result has shape (n, 3).
        """
        directions = unit_vectors(azimuth, elevation)
        points: Floats = range_m[:, None] * directions
        return points if self.is_at_origin else points + self.positions(azimuth, elevation, ring)

    def on_rings(self, sweep: Sweep) -> Sweep:
        """Return a sweep whose points are moved to the elevations of their rings.

        The distances from the lasers and the azimuths of the beams remain. The elevations of the
        beams then no longer depend on the recorded points.
        """
        ring = sweep.columns["row"]
        azimuth, _ = self.angles(sweep.points, ring)
        range_m = self.ranges(sweep.points, ring)
        points = self.ends(azimuth, self.elevation_rad[ring], ring, range_m)
        return sweep.replace(points=points)


def unit_vectors(azimuth: Floats, elevation: Floats) -> Floats:
    """Return the unit vectors with the given angles in radians, of shape (n, 3)."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)


class _Offsets(NamedTuple):
    """Offsets of the lasers of r rings, as determined from a sweep."""

    values_m: Floats  # (r,), NaN if unknown
    errors_m: Floats  # (r,), standard errors, inf if unknown

    @classmethod
    def unknown(cls, count: int) -> _Offsets:
        return cls(np.full(count, np.nan), np.full(count, np.inf))

    @classmethod
    def combine(cls, parts: Sequence[_Offsets]) -> _Offsets:
        """Return the medians of several sweeps.

        Their errors are those of the sweeps, or the deviations between sweeps if these are larger.
        An error that all sweeps have in common does not cancel out.
        """
        values_m = np.stack([part.values_m for part in parts])  # (sweeps, r)
        formal_m = np.stack([part.errors_m for part in parts])
        count = np.isfinite(values_m).sum(axis=0)
        found = cls.unknown(values_m.shape[1])
        known = count >= min(2, len(parts))
        values_m = values_m[:, known]
        medians_m = np.nanmedian(values_m, axis=0)
        deviations_m = 1.4826 * np.nanmedian(np.abs(values_m - medians_m), axis=0)
        found.values_m[known] = medians_m
        found.errors_m[known] = np.maximum(
            deviations_m / np.sqrt(count[known]), np.median(formal_m[:, known], axis=0)
        )
        return found

    @property
    def are_certain(self) -> Bools:
        """Mask of the rings whose offset is known and plausible. Shape (r,)."""
        return (self.errors_m < _MAX_ERROR_M) & (np.abs(self.values_m) < _MAX_OFFSET_M)

    def significant(self) -> tuple[Floats, Bools]:
        """Return the offsets, and a mask of the rings for which they are known.

        The offsets are zeros if those of most rings are small or insignificant, and they are 0 for
        rings for which they are unknown.
        """
        known = self.are_certain
        zeros = np.zeros(len(known))
        if known.sum() < MIN_RINGS:
            return zeros, ~known
        size_m = np.abs(self.values_m[known])
        significance = np.median(size_m / self.errors_m[known])
        if np.median(size_m) < _MIN_OFFSET_M or significance < _MIN_SIGNIFICANCE:
            return zeros, np.ones_like(known)
        return np.where(known, self.values_m, 0.0), known


class _RingReturns(NamedTuple):
    """Returns of a sweep sorted by ring and azimuth."""

    points: Floats  # (n, 3), meters
    slices: list[slice]  # of each ring

    @classmethod
    def from_sweep(cls, points: Floats, ring: Ints, count: int) -> _RingReturns:
        points = np.asarray(points, np.float64)
        used = np.flatnonzero((ring >= 0) & (np.linalg.norm(points, axis=1) > _MIN_RANGE_M))
        azimuth = np.arctan2(points[used, 1], points[used, 0])
        order = used[np.lexsort((azimuth, ring[used]))]
        edges = np.searchsorted(ring[order], np.arange(count + 1))
        return cls(points[order], [slice(*edges[row : row + 2]) for row in range(count)])

    def vertical_offsets(self) -> _Offsets:
        """Return the vertical offset of each ring.

        To first order, the elevation seen from the origin is that of the beam plus the offset
        divided by the range.
        """
        offsets = _Offsets.unknown(len(self.slices))
        for ring, rows in enumerate(self.slices):
            points = self.points[rows]
            if len(points) < _MIN_RETURNS:
                continue
            elevation = elevations(points)
            range_m = np.linalg.norm(points, axis=1)
            design = np.stack([np.ones(len(points)), 1 / range_m], axis=1)
            value_m, error_m = _robust_slope(design, elevation)
            offsets.values_m[ring] = value_m
            offsets.errors_m[ring] = max(error_m, _noise_slope(1 / range_m, elevation))
        return offsets

    def horizontal_offsets(self) -> _Offsets:
        """Return the horizontal offset of each ring.

        The head turns by whole steps between the pulses of a ring. What remains of the azimuth
        differences is due to different ranges.
        """
        offsets = _Offsets.unknown(len(self.slices))
        for ring, rows in enumerate(self.slices):
            points = self.points[rows]
            if len(points) < _MIN_RETURNS:
                continue
            turned = np.diff(np.arctan2(points[:, 1], points[:, 0]))
            change = np.diff(1 / np.hypot(points[:, 0], points[:, 1]))
            step = float(np.median(turned))
            if step <= 0:
                continue
            pulses = np.rint(turned / step)
            used = (pulses >= 1) & (pulses <= _MAX_PULSES)
            used &= np.abs(change) * _FIRST_OFFSET_M < _MAX_SHIFT * step
            if used.sum() < _MIN_RETURNS:
                continue
            design = np.stack([pulses[used], change[used]], axis=1)
            offsets.values_m[ring], offsets.errors_m[ring] = _robust_slope(design, turned[used])
        return offsets


def _noise_slope(x: Floats, y: Floats) -> float:
    """Return the largest slope of y over x that noise alone can cause.

    The rounding of coordinates changes the range and the elevation of a point together. If all
    returns of a ring have almost the same range, the slope reflects only this noise. The noise is
    estimated from the differences between neighbors.
    """
    variance = float(np.var(np.clip(x, *np.quantile(x, (0.01, 0.99)))))
    noise = [1.4826 * float(np.median(np.abs(np.diff(values)))) / np.sqrt(2) for values in (x, y)]
    return noise[0] * noise[1] / variance if variance > 0 else float("inf")


def _robust_slope(design: Floats, values: Floats) -> tuple[float, float]:
    """Fit a linear model, and return the second coefficient and its standard error.

    `design` has shape (n, 2). Values that deviate from the model have little weight.
    """
    weights = np.ones(len(values))
    normal = design.T @ design
    found: Floats = np.zeros(2)
    sigma = float("inf")
    for _ in range(_ROUNDS):
        weighted = design * weights[:, None]
        normal = weighted.T @ design
        if np.linalg.matrix_rank(normal, hermitian=True) < 2:
            return float("nan"), float("inf")
        before = found
        found = np.asarray(np.linalg.solve(normal, weighted.T @ values), np.float64)
        residuals = values - design @ found
        sigma = max(1.4826 * float(np.median(np.abs(residuals))), _MIN_SIGMA_RAD)
        if np.abs(found - before).max() < _CONVERGED:
            break
        weights = 1 / (1 + np.square(residuals / (_CAUCHY_SIGMAS * sigma)))
    variance = float(np.linalg.inv(normal)[1, 1])
    return float(found[1]), max(sigma, _MODEL_RAD) * float(np.sqrt(max(variance, 0.0)))
