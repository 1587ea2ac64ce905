"""Reflectances of surfels from intensities, freed from range, incidence and ring.

A recorded intensity is taken as the product of the reflectance of the surface and three factors of
the sensor: of the range, as of optics that see near surfaces in part and electronics that
compensate for distance, of the incidence, and of the ring. Each factor is the one that explains the
intensities of surfels that were seen from several places.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.base.arrays import Floats, Ints

from .alignment import AlignedSweep
from .place import Observations, Seen
from .surfels import Surfels

_ROUNDS = 12  # of factors and reflectances in turn
_RANGE_EDGES_M = (0, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 65, 80, 100, 130, 200, np.inf)
_INCIDENCE_BINS = 10  # of the cosine
_MIN_RAYS = 200  # of a factor; fewer do not change it
_WHITE_QUANTILE = 0.999  # of the intensities: what is brighter is as bright as white
_MIN_REFLECTANCE = 0.01  # surfaces that were recorded as black


@dataclass(frozen=True, eq=False)
class Reflectances:
    """Reflectances of surfels, and the response of the sensor, by which intensities follow.

    Attributes
    ----------
    surfels
        float64 (m,): reflectances, 0.01 to 1.
    by_range, by_incidence, by_ring
        float64: factors of intensities, of the ranges between `_RANGE_EDGES_M`, of evenly spaced
        cosines, and of each ring.
    white
        Intensity of a white surface.
    """

    surfels: Floats
    by_range: Floats
    by_incidence: Floats
    by_ring: Floats
    white: float

    def intensities(self, sweep: AlignedSweep, seen: Seen) -> Floats:
        """Return the intensities (n,) of the rays of a sweep, NaN for a ray that meets nothing."""
        factors = self.by_range[_range_bin(seen.distance_m)]
        factors = factors * self.by_incidence[_incidence_bin(seen.cosine)]
        factors *= self.by_ring[sweep.ring[seen.rays]] * self.white
        intensities = np.full(len(sweep.points), np.nan)
        intensities[seen.rays] = self.surfels[seen.surfel] * factors
        return intensities

    def figures(self) -> dict[str, Any]:
        """Return the response of the sensor for the report."""
        return {
            "white": self.white,
            "by_range": self.by_range.round(4).tolist(),
            "by_incidence": self.by_incidence.round(4).tolist(),
            "by_ring": self.by_ring.round(4).tolist(),
        }


def fit_reflectances(seen: Observations, surfels: Surfels, ring_count: int) -> Reflectances | None:
    """Fit reflectances of surfels and the sensor's response, or return None without intensities.

    Surfels that no ray meets, behind others, are as bright as the nearest surfel that is met.
    Sums, not logarithms, are compared: many sensors report dark surfaces as 0.
    """
    seen = seen.part(np.isfinite(seen.intensity))
    if not (seen.intensity > 0).any():
        return None
    from scipy.spatial import cKDTree

    surfel_count = len(surfels)
    white = float(np.quantile(seen.intensity, _WHITE_QUANTILE))
    intensity = np.minimum(seen.intensity / white, 1.0)
    rows = (_range_bin(seen.range_m), _incidence_bin(seen.cosine), seen.ring)
    factors = [np.ones(len(_RANGE_EDGES_M) - 1), np.ones(_INCIDENCE_BINS), np.ones(ring_count)]
    reflectance = np.ones(surfel_count)
    for _ in range(_ROUNDS):
        product = np.prod([f[row] for f, row in zip(factors, rows, strict=True)], axis=0)
        reflectance = _ratios(seen.surfel, intensity, product, np.full(surfel_count, np.nan))
        for index, row in enumerate(rows):
            others = product / factors[index][row]
            expected = others * reflectance[seen.surfel]
            factors[index] = _ratios(row, intensity, expected, factors[index])
            factors[index] /= np.average(
                factors[index], weights=np.bincount(row, minlength=len(factors[index]))
            )
            product = others * factors[index][row]
    known = np.isfinite(reflectance)
    _, nearest = cKDTree(surfels.centres[known]).query(surfels.centres[~known])
    reflectance[~known] = reflectance[known][nearest]
    # Reflectances of 1 are white: the factors take what is above.
    scale = max(float(np.quantile(reflectance, _WHITE_QUANTILE)), 1e-6)
    reflectance = np.clip(reflectance / scale, _MIN_REFLECTANCE, 1.0)
    return Reflectances(reflectance, factors[0], factors[1], factors[2], white * scale)


def _ratios(row: Ints, values: Floats, expected: Floats, before: Floats) -> Floats:
    """Return ratios of sums of values (k,) to sums of expected values, by row, or `before`."""
    count = len(before)
    sums = np.bincount(row, values, count)
    sums_expected = np.bincount(row, expected, count)
    enough = sums_expected > 0
    if np.isfinite(before).all():  # a factor, not a reflectance
        enough &= np.bincount(row, minlength=count) >= _MIN_RAYS
    return np.divide(sums, sums_expected, out=before.copy(), where=enough)


def _range_bin(range_m: Floats) -> Ints:
    return np.asarray(np.searchsorted(_RANGE_EDGES_M, range_m, side="right") - 1)


def _incidence_bin(cosine: Floats) -> Ints:
    return np.asarray((cosine * _INCIDENCE_BINS).astype(np.int64).clip(0, _INCIDENCE_BINS - 1))
