"""Reflectances of surfels from intensities, freed from range, incidence and ring.

A recorded intensity is taken as the product of the reflectance of the surface and three factors of
the sensor: of the range, as of optics that see near surfaces in part and electronics that
compensate for distance, of the incidence, and of the ring. Each factor is the one that explains the
intensities of surfels that were seen from several places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lidarsim.base.arrays import AnyFloats, Floats, Integers, Ints

from .alignment import AlignedSweep
from .place import Observations, Seen

_ROUNDS = 12  # of factors and reflectances in turn
_RANGE_EDGES_M = (0, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 65, 80, 100, 130, 200, np.inf)
_INCIDENCE_BINS = 10  # of the cosine
_MIN_RAYS = 200  # of a factor; fewer do not change it
_WHITE_QUANTILE = 0.999  # of the intensities: what is brighter is as bright as white
_WHITE_SHARE = 0.99  # of the rays, which end on surfaces up to white
_MIN_REFLECTANCE = 0.01  # surfaces that were recorded as black


@dataclass(frozen=True, eq=False)
class Response:
    """How the intensities of a sensor follow from reflectances.

    Attributes
    ----------
    by_range, by_incidence, by_ring
        float64: factors of intensities, of the ranges between `_RANGE_EDGES_M`, of evenly spaced
        cosines, and of each ring.
    white
        Intensity of a white surface.
    brightest
        Intensity as which all that is brighter counts, such as a reflector.
    typical
        Median reflectance.
    """

    by_range: Floats
    by_incidence: Floats
    by_ring: Floats
    white: float
    brightest: float
    typical: float

    def factors(self, range_m: AnyFloats, cosine: AnyFloats, ring: Integers) -> Floats:
        """Return the intensities (k,) of white surfaces."""
        factors = self.by_range[_range_bin(range_m)] * self.by_incidence[_incidence_bin(cosine)]
        return np.asarray(factors * self.by_ring[ring] * self.white)

    def reflectances(self, seen: Observations, centers: Floats) -> Reflectances:
        """Return the reflectances of surfels with centers (m, 3).

        Surfels that no ray meets, behind others, are as bright as the nearest surfel that is met.
        """
        from scipy.spatial import cKDTree

        seen = seen.part(np.isfinite(seen.intensity))
        count = len(centers)
        expected = self.factors(seen.range_m, seen.cosine, seen.ring)
        intensity = np.minimum(seen.intensity, self.brightest)
        surfels = _ratios(seen.surfel, intensity, expected, np.full(count, np.nan))
        known = np.isfinite(surfels)
        if known.any():
            _, nearest = cKDTree(centers[known]).query(centers[~known])
            surfels[~known] = surfels[known][nearest]
        else:
            surfels[:] = self.typical
        return Reflectances(np.clip(surfels, _MIN_REFLECTANCE, 1.0), self)

    def figures(self) -> dict[str, Any]:
        """Return the response of the sensor for the report."""
        return {
            "white": self.white,
            "by_range": self.by_range.round(4).tolist(),
            "by_incidence": self.by_incidence.round(4).tolist(),
            "by_ring": self.by_ring.round(4).tolist(),
        }


@dataclass(frozen=True, eq=False)
class Reflectances:
    """Reflectances of surfels, and the response of the sensor, by which intensities follow."""

    surfels: Floats  # (m,): 0.01 to 1
    response: Response

    def intensities(self, sweep: AlignedSweep, seen: Seen) -> Floats:
        """Return the intensities (n,) of the rays of a sweep, NaN for a ray that meets nothing."""
        factors = self.response.factors(seen.distance_m, seen.cosine, sweep.ring[seen.rays])
        intensities = np.full(len(sweep.points), np.nan)
        intensities[seen.rays] = self.surfels[seen.surfel] * factors
        return intensities


def fit_response(
    parts: Sequence[Observations], ring_count: int, *, are_energies: bool
) -> Response | None:
    """Fit the response of a sensor to rays that end on surfels, or return None without intensities.

    Each of the `parts` has surfels of its own. Intensities that are compensated for the range do
    not depend on it, at first, and energies fall with the square of the range and the cosine of the
    incidence: unless it is known that they `are_energies`, what explains the intensities better is
    kept. Sums, not logarithms, are compared: many sensors report dark surfaces as 0.
    """
    seen = Observations.joined(parts)
    seen = seen.part(np.isfinite(seen.intensity))
    if not (seen.intensity > 0).any():
        return None
    brightest = float(np.quantile(seen.intensity, _WHITE_QUANTILE))
    intensity = np.minimum(seen.intensity / brightest, 1.0)
    fits = [
        _Factors.of_rays(seen, intensity, _first_factors(ring_count, energies=energies))
        for energies in ((True,) if are_energies else (False, True))
    ]
    best = min(fits, key=lambda fit: fit.difference)
    # Reflectances of 1 are white: the factors take what is above. Surfels that few rays met
    # scatter, so rays count.
    scale = max(float(np.quantile(best.reflectance[seen.surfel], _WHITE_SHARE)), 1e-6)
    typical = float(np.nanmedian(best.reflectance)) / scale
    by_range, by_incidence, by_ring = best.factors
    return Response(by_range, by_incidence, by_ring, brightest * scale, brightest, typical)


def _first_factors(ring_count: int, *, energies: bool) -> list[Floats]:
    """Return the factors by range, incidence and ring from which fitting starts.

    A surface is met by few ranges, incidences and rings: what these do not tell stays.
    """
    edges_m = np.array(_RANGE_EDGES_M[:-1], np.float64)
    widths_m = np.diff(edges_m, append=1.5 * edges_m[-1])
    cosines = (np.arange(_INCIDENCE_BINS) + 0.5) / _INCIDENCE_BINS
    if not energies:
        return [np.ones(len(edges_m)), np.ones(_INCIDENCE_BINS), np.ones(ring_count)]
    return [1 / (edges_m + widths_m / 2) ** 2, cosines, np.ones(ring_count)]


class _Factors(NamedTuple):
    """Factors by range, incidence and ring, and reflectances of surfels, NaN if not seen."""

    factors: list[Floats]
    reflectance: Floats
    difference: float  # mean, of intensities

    @classmethod
    def of_rays(cls, seen: Observations, intensity: AnyFloats, factors: list[Floats]) -> _Factors:
        """Fit factors and reflectances in turn to the intensities (k,) of rays."""
        unknown = np.full(int(seen.surfel.max()) + 1, np.nan)
        rows: list[Integers] = [_range_bin(seen.range_m), _incidence_bin(seen.cosine), seen.ring]
        reflectance = unknown
        product = intensity
        for _ in range(_ROUNDS):
            product = np.prod([f[row] for f, row in zip(factors, rows, strict=True)], axis=0)
            reflectance = _ratios(seen.surfel, intensity, product, unknown)
            for index, row in enumerate(rows):
                others = product / factors[index][row]
                expected = others * reflectance[seen.surfel]
                factors[index] = _ratios(row, intensity, expected, factors[index])
                factors[index] /= np.average(
                    factors[index], weights=np.bincount(row, minlength=len(factors[index]))
                )
                product = others * factors[index][row]
        difference = np.abs(reflectance[seen.surfel] * product - intensity).mean()
        return cls(factors, reflectance, float(difference))


def _ratios(row: Integers, values: AnyFloats, expected: AnyFloats, before: Floats) -> Floats:
    """Return ratios of sums of values (k,) to sums of expected values, by row, or `before`."""
    count = len(before)
    sums = np.bincount(row, values, count)
    sums_expected = np.bincount(row, expected, count)
    enough = sums_expected > 0
    if np.isfinite(before).all():  # a factor, not a reflectance
        enough &= np.bincount(row, minlength=count) >= _MIN_RAYS
    return np.divide(sums, sums_expected, out=before.copy(), where=enough)


def _range_bin(range_m: AnyFloats) -> Ints:
    return np.asarray(np.searchsorted(_RANGE_EDGES_M, range_m, side="right") - 1)


def _incidence_bin(cosine: AnyFloats) -> Ints:
    return np.asarray((cosine * _INCIDENCE_BINS).astype(np.int64).clip(0, _INCIDENCE_BINS - 1))
