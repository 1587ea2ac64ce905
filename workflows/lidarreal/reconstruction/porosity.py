"""Estimate the gaps in surfels and the depths of their returns from recorded rays.

Hedges, fences and the outlines of objects are not opaque: some rays end on a surfel, and others
pass through it. A ray crosses several surfels until it ends on one that is close to its return. If
several surfels are close to the return, it is unknown on which of them the ray ended, so each is
assigned a probability. Expectation maximization alternates between these probabilities and the gap
fractions, so that a ray passes through all surfels of a layer as often as in the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Bytes, Floats, Floats32, Ints, Ints32

from .porosity_loops import RaySums, add_rays

_PRIOR_RAYS = 2.2  # weight of the prior, in rays
_PRIOR_GAPS = 0.2  # rays of the prior that pass through, without observations nearby
_NEIGHBORS = 9  # surfels whose rays determine the prior
_ROUNDS = 8  # iterations of expectation maximization
_GAP_STEP = 0.2  # step to which gap fractions are rounded
_MAX_GAP_FRACTION = 0.8
_SPREAD_STEP_M = 0.02  # step to which the spreads of the ranges are rounded
_PRIOR_SPREAD_RAYS = 4.0  # weight of the mean spread, in rays
_GOLDEN = 0.6180339887498949  # fraction whose multiples are evenly distributed modulo 1


class Crossings(NamedTuple):
    """Surfels that the rays of a sweep cross, the nearest first.

    The arrays have a row for each of the n rays, and k columns.
    """

    surfel: Ints32  # (n, k), -1 beyond the last surfel
    distance_m: Floats32  # (n, k), inf beyond the last surfel
    cell: Bytes  # (n, k), cell of the surfel that the ray crosses, see `outlines.py`
    range_m: Floats  # (n,), recorded range, inf for a lost pulse

    @property
    def present(self) -> Bools:
        """Mask of the surfels. Shape (n, k)."""
        return np.asarray(self.surfel >= 0)

    def as_lost(self) -> Crossings:
        """Return the crossings of lost pulses, whose ranges are inf."""
        return self._replace(range_m=np.full(len(self.range_m), np.inf))

    def select(self, kept: Bools) -> Crossings:
        """Select crossings with a mask of shape (n, k)."""
        order = np.argsort(~kept, axis=1, kind="stable")
        surfel = np.where(kept, self.surfel, -1).astype(np.int32)
        distance_m = np.where(kept, self.distance_m, np.inf).astype(np.float32)
        return Crossings(
            np.take_along_axis(surfel, order, 1),
            np.take_along_axis(distance_m, order, 1),
            np.take_along_axis(self.cell, order, 1),
            self.range_m,
        )


class Porosity(NamedTuple):
    """Gaps of m surfels, and depths of their returns."""

    gap_fraction: Floats  # (m,), share of the rays that pass through
    range_spread_m: Floats  # (m,), standard deviation of the ranges of the other rays

    @classmethod
    def opaque(cls, count: int) -> Porosity:
        """Return the porosity of surfels without gaps."""
        return cls(np.zeros(count), np.zeros(count))

    @classmethod
    def from_crossings(
        cls, sweeps: Sequence[Crossings], centers: Floats, dark: Bools, on_surfel_m: float
    ) -> Porosity:
        """Estimate the porosity of surfels from stationary returns.

        Parameters
        ----------
        sweeps
            Crossings of the rays of several sweeps.
        centers
            Centers of the surfels in meters. Shape (m, 3).
        dark
            Surfels that return no pulses, which are treated as opaque. Shape (m,).
        on_surfel_m
            Maximum range difference in meters between a surfel and a return from it.
        """
        from scipy.spatial import cKDTree

        neighbors = cKDTree(centers).query(centers, min(_NEIGHBORS, len(centers)))[1]
        neighbors = neighbors.reshape(len(centers), -1)
        counts = _RayCounts.from_crossings(sweeps, np.empty(0), dark, on_surfel_m)
        for _ in range(_ROUNDS):
            gap_fraction = counts.gap_fraction(neighbors)
            counts = _RayCounts.from_crossings(sweeps, gap_fraction, dark, on_surfel_m)
        gap_fraction = np.where(dark, 0, counts.gap_fraction(neighbors))
        gap_fraction = dithered(gap_fraction, _GAP_STEP).clip(max=_MAX_GAP_FRACTION)
        porous = gap_fraction > 0
        spread_m = np.where(porous, counts.spread_m(porous), 0)
        return cls(gap_fraction, np.round(_SPREAD_STEP_M * np.rint(spread_m / _SPREAD_STEP_M), 6))

    def select(self, rows: Bools) -> Porosity:
        """Select surfels with a mask."""
        return Porosity(self.gap_fraction[rows], self.range_spread_m[rows])

    def likely_crossings(self, crossings: Crossings, dark: Bools) -> Ints:
        """Return the column of the surfel from which the pulse of each ray most likely returns.

        This is the median of the surfels, weighted by the probabilities of their returns. If the
        first surfel returns no pulses, it is the first. The result has shape (n,).
        """
        is_dark = dark[crossings.surfel]
        gap_fraction = np.where(is_dark, 0.0, self.gap_fraction[crossings.surfel])
        gap_fraction[~crossings.present] = 1.0
        reaching = np.cumprod(gap_fraction, axis=1)
        reaching = np.column_stack([np.ones(len(reaching)), reaching[:, :-1]])
        returning = np.where(is_dark, 0.0, reaching * (1 - gap_fraction))
        cumulative = np.cumsum(returning, axis=1)
        return np.asarray((cumulative >= cumulative[:, -1:] / 2).argmax(axis=1))


class _RayCounts(RaySums):
    """Rays that end on each of m surfels or pass through it."""

    @classmethod
    def from_crossings(
        cls, sweeps: Sequence[Crossings], gap_fraction: Floats, dark: Bools, on_surfel_m: float
    ) -> _RayCounts:
        """Count the rays of several sweeps, given the gap fractions of the surfels.

        If `gap_fraction` is empty, each ray ends on the first surfel that is close to its return.
        """
        counts = cls(*np.zeros((4, len(dark))))
        for one in sweeps:
            add_rays(one, gap_fraction, dark, on_surfel_m, RaySums(*counts))
        return counts

    def gap_fraction(self, neighbors: Ints) -> Floats:
        """Return the share of the rays that pass through each surfel.

        Surfels with few rays have about the mean of their neighbors, whose indices have shape
        (m, q). The result has shape (m,).
        """
        rays = self.passing + self.ending
        nearby = self.passing[neighbors].sum(axis=1) + _PRIOR_GAPS
        nearby /= rays[neighbors].sum(axis=1) + _PRIOR_RAYS
        return np.asarray((self.passing + _PRIOR_RAYS * nearby) / (rays + _PRIOR_RAYS))

    def spread_m(self, chosen: Bools) -> Floats:
        """Return the standard deviation of the offsets of each surfel in meters.

        The result has shape (m,). Surfels with few rays have about the mean of the chosen surfels.
        """
        offset_m = self.offset_m / np.maximum(self.ending, 1e-9)
        total_m2 = np.maximum(self.squared_m2 - self.ending * offset_m**2, 0)
        degrees = np.maximum(self.ending - 1, 0)
        typical_m2 = total_m2[chosen].sum() / max(float(degrees[chosen].sum()), 1.0)
        variance_m2 = total_m2 + _PRIOR_SPREAD_RAYS * typical_m2
        return np.asarray(np.sqrt(variance_m2 / (degrees + _PRIOR_SPREAD_RAYS)))


def dithered(values: Floats, step: float) -> Floats:
    """Round values to multiples of a step, up or down such that their mean is preserved."""
    thresholds = np.arange(len(values)) * _GOLDEN % 1
    return np.round(step * np.floor(values / step + thresholds), 6)
