"""Reflectances of surfels from intensities, freed from range, incidence and ring.

A recorded intensity is modeled as the product of the reflectance of the surface, a law of range and
incidence (`IntensityModel`), and three factors of the sensor: of the range, as of optics that see
near surfaces in part, of the incidence, and of the ring. Each factor is the one that explains the
intensities of surfels that were seen from several places. A simulation applies its own law of range
and incidence to the reflectances, and none of the factors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import AnyFloats, Floats, Integers, Ints

from .alignment import AlignedSweep
from .surface_map import Observations, SurfelHits

_ROUNDS = 12  # of factors and reflectances in turn
_RANGE_EDGES_M = (0, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 65, 80, 100, 130, 200, np.inf)
_INCIDENCE_BINS = 10  # of the cosine
_MIN_RAYS = 200  # of a factor; fewer do not change it
_WHITE_QUANTILE = 0.999  # of the intensities: what is brighter is as bright as white
_WHITE_SHARE = 0.99  # of the rays, which end on surfaces up to white
_MIN_REFLECTANCE = 0.01  # surfaces that were recorded as black
_MAX_DIFFERENCE = 0.9  # of energies, over that of intensities that are compensated for range
_MIN_COSINE = 1e-3  # of the incidence of rays that the factors are fitted to
_WHITE_RANGE_M = 10.0  # range at which a white surface has the simulated intensity 1


class IntensityModel(StrEnum):
    """How intensities depend on range and incidence, apart from the factors of the sensor."""

    COMPENSATED = "compensated for range"
    ENERGIES = "energies"

    def law(self, range_m: AnyFloats, cosine: AnyFloats) -> Floats:
        """Return the intensities (k,) of equally bright surfaces."""
        if self is IntensityModel.COMPENSATED:
            return np.ones(len(range_m))
        return self.simulated(range_m, cosine)

    def simulated(self, range_m: AnyFloats, cosine: AnyFloats) -> Floats:
        """Return what a simulation writes for white surfaces (k,).

        Energies are compared with its column `intensity`, and intensities that are compensated for
        range with its column `reflectance`, to which `reflectivity` is proportional.
        """
        level = np.asarray(cosine, np.float64)
        if self is IntensityModel.COMPENSATED:
            return level
        return level * (_WHITE_RANGE_M / np.asarray(range_m, np.float64)) ** 2


@dataclass(frozen=True, eq=False)
class Response:
    """How the intensities of a sensor follow from reflectances.

    Attributes
    ----------
    model
        How intensities depend on range and incidence.
    by_range, by_incidence, by_ring
        float64: factors of intensities, of the ranges between `_RANGE_EDGES_M`, of evenly spaced
        cosines, and of each ring.
    white
        Intensity of a white surface; of energies at 10 m and normal incidence.
    brightest
        Intensity over the law of the model as which all that is brighter counts, such as a
        reflector.
    typical
        Median reflectance.
    scale
        Recorded over simulated intensity, in the mean of the rays.
    """

    model: IntensityModel
    by_range: Floats
    by_incidence: Floats
    by_ring: Floats
    white: float
    brightest: float
    typical: float
    scale: float

    def factors(self, range_m: AnyFloats, cosine: AnyFloats, ring: Integers) -> Floats:
        """Return the intensities (k,) of white surfaces."""
        factors = self.by_range[_range_bin(range_m)] * self.by_incidence[_incidence_bin(cosine)]
        law = self.model.law(range_m, cosine)
        return np.asarray(factors * self.by_ring[ring] * self.white * law)

    def reflectances(self, observations: Observations, centers: Floats) -> Reflectances:
        """Return the reflectances of surfels with centers (m, 3).

        Surfels that no ray meets, behind others, are as bright as the nearest surfel that is met.
        """
        from scipy.spatial import cKDTree

        observations = observations.select(np.isfinite(observations.intensity))
        count = len(centers)
        expected = self.factors(observations.range_m, observations.cosine, observations.ring)
        law = self.model.law(observations.range_m, observations.cosine)
        intensity = np.minimum(observations.intensity, self.brightest * law)
        surfels = _ratios(observations.surfel, intensity, expected, np.full(count, np.nan))
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
            "model": self.model.value,
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

    def intensities(self, sweep: AlignedSweep, hits: SurfelHits) -> Floats:
        """Return the simulated intensities (n,) of the rays of a sweep, on the recorded scale.

        They are NaN for rays that meet nothing.
        """
        law = self.response.model.simulated(hits.distance_m, hits.cosine)
        intensities = np.full(len(sweep.points), np.nan)
        intensities[hits.rays] = self.surfels[hits.surfel] * law * self.response.scale
        return intensities


def fit_response(
    parts: Sequence[Observations], ring_count: int, *, are_energies: bool
) -> Response | None:
    """Fit the response of a sensor to rays that end on surfels, or return None without intensities.

    Each of the `parts` has surfels of its own. Unless it is known that the intensities
    `are_energies`, they are taken as compensated for range, if the other model does not explain
    them clearly better: surfaces that were seen from one distance fit both models. Differences are
    relative, because energies span several decades, and near surfaces would decide alone. Sums, not
    logarithms, are compared: many sensors report dark surfaces as 0.
    """
    observations = Observations.concatenate(parts)
    observations = observations.select(
        np.isfinite(observations.intensity) & (observations.cosine > _MIN_COSINE)
    )
    if not (observations.intensity > 0).any():
        return None
    models = (IntensityModel.ENERGIES,) if are_energies else tuple(IntensityModel)
    fits = [_Factors.from_rays(observations, model, ring_count) for model in models]
    best = fits[0]
    if fits[-1].difference < _MAX_DIFFERENCE * best.difference:
        best = fits[-1]
    # Reflectances of 1 are white: the factors take what is above. Surfels that few rays met
    # scatter, so rays count.
    reflectance = best.reflectance[observations.surfel]
    white = max(float(np.quantile(reflectance, _WHITE_SHARE)), 1e-6 * best.brightest)
    typical = float(np.nanmedian(best.reflectance)) / white
    simulated = (reflectance / white).clip(_MIN_REFLECTANCE, 1.0)
    simulated *= best.model.simulated(observations.range_m, observations.cosine)
    scale = float(best.intensity.sum() / simulated.sum())
    by_range, by_incidence, by_ring = best.factors
    return Response(
        best.model, by_range, by_incidence, by_ring, white, best.brightest, typical, scale
    )


class _Factors(NamedTuple):
    """Factors by range, incidence and ring, and reflectances of surfels, NaN if not observations."""

    model: IntensityModel
    intensity: Floats  # (k,): those of reflectors as those of white surfaces
    factors: list[Floats]
    reflectance: Floats  # intensity over the law of the model and the factors
    brightest: float
    difference: float  # mean, of intensities, over their sum

    @classmethod
    def from_rays(
        cls, observations: Observations, model: IntensityModel, ring_count: int
    ) -> _Factors:
        """Fit factors and reflectances in turn to the intensities of rays.

        A surface is met by few ranges, incidences and rings: what these do not tell stays.
        """
        law = model.law(observations.range_m, observations.cosine)
        brightest = float(np.quantile(observations.intensity / law, _WHITE_QUANTILE))
        intensity = np.minimum(observations.intensity, brightest * law)
        unknown = np.full(int(observations.surfel.max()) + 1, np.nan)
        rows: list[Integers] = [
            _range_bin(observations.range_m),
            _incidence_bin(observations.cosine),
            observations.ring,
        ]
        counts = (len(_RANGE_EDGES_M) - 1, _INCIDENCE_BINS, ring_count)
        factors = [np.ones(count) for count in counts]
        reflectance = unknown
        product = law
        for _ in range(_ROUNDS):
            product = law * np.prod([f[row] for f, row in zip(factors, rows, strict=True)], axis=0)
            reflectance = _ratios(observations.surfel, intensity, product, unknown)
            for index, row in enumerate(rows):
                others = product / factors[index][row]
                expected = others * reflectance[observations.surfel]
                factors[index] = _ratios(row, intensity, expected, factors[index])
                factors[index] /= np.average(
                    factors[index], weights=np.bincount(row, minlength=len(factors[index]))
                )
                product = others * factors[index][row]
        expected = reflectance[observations.surfel] * product
        difference = np.abs(expected - intensity) / np.maximum(expected + intensity, 1e-300)
        return cls(model, intensity, factors, reflectance, brightest, float(difference.mean()))


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
