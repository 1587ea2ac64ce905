"""Estimate the reflectances of surfels from recorded intensities.

A recorded intensity is modeled as the product of the surface reflectance, a law of range and
incidence (`IntensityModel`), and three sensor factors. The factors depend on the range, on the
incidence, and on the ring. The range factor describes optics that see only part of a surface at
close range, for example. The factors are fitted to the intensities of surfels that were observed
from several positions. A simulation applies its own law of range and incidence to the reflectances,
and the factors of the rings, but not those of range and incidence.
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

_ROUNDS = 12  # iterations of fitting the factors and the reflectances
_RANGE_EDGES_M = (0, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 65, 80, 100, 130, 200, np.inf)
_INCIDENCE_BINS = 10  # bins of the cosine
_MIN_RAYS = 200  # A factor with fewer rays is not changed.
_WHITE_QUANTILE = 0.999  # quantile of the intensities above which a surface counts as white
_WHITE_SHARE = 0.99  # quantile of the reflectances, weighted by rays, that counts as white
_MIN_REFLECTANCE = 0.01  # for surfaces that were recorded as black
_MAX_DIFFERENCE = 0.9  # maximum error of the energy model relative to the compensated model
_MIN_COSINE = 1e-3  # minimum cosine of the incidence of rays that are used for the fit
_WHITE_RANGE_M = 10.0  # range at which a white surface has a simulated intensity of 1


class IntensityModel(StrEnum):
    """Model of how intensities depend on range and angle of incidence."""

    COMPENSATED = "compensated for range"
    ENERGIES = "energies"

    def law(self, range_m: AnyFloats, cosine: AnyFloats) -> Floats:
        """Return the relative intensities of surfaces that have equal reflectance."""
        if self is IntensityModel.COMPENSATED:
            return np.ones(len(range_m))
        return self.white_intensities(range_m, cosine)

    def white_intensities(self, range_m: AnyFloats, cosine: AnyFloats) -> Floats:
        """Return the intensities that a simulation stores for white surfaces.

        Energies correspond to the simulated column `intensity`. Intensities that are compensated
        for range correspond to the column `reflectance`, to which `reflectivity` is proportional.
        """
        level = np.asarray(cosine, np.float64)
        if self is IntensityModel.COMPENSATED:
            return level
        return level * (_WHITE_RANGE_M / np.asarray(range_m, np.float64)) ** 2


@dataclass(frozen=True, eq=False)
class Response:
    """Relationship between the intensities of a sensor and the reflectances of surfaces.

    Attributes
    ----------
    model
        How intensities depend on range and incidence.
    by_range, by_incidence, by_ring
        Intensity factors for the ranges between `_RANGE_EDGES_M`, for evenly spaced cosines, and
        for the rings. float64 arrays.
    white
        Intensity of a white surface. If intensities are energies, this is the intensity at 10 m and
        normal incidence.
    brightest
        Maximum ratio of intensity to the law of the model. Brighter surfaces, such as
        retroreflectors, are clipped to it.
    typical
        Median reflectance.
    scale
        Mean ratio of recorded to simulated intensities, which include the factors of the rings.
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
        """Return the expected intensities of white surfaces.

        The array has shape (k,).
        """
        factors = self.by_range[_range_bin(range_m)] * self.by_incidence[_incidence_bin(cosine)]
        law = self.model.law(range_m, cosine)
        return np.asarray(factors * self.by_ring[ring] * self.white * law)

    def reflectances(self, observations: Observations, centers: Floats) -> Reflectances:
        """Estimate the reflectances of surfels, given the centers of the surfels.

        The centers have shape (m, 3). A surfel that no ray hits, for example because it is
        occluded, has the reflectance of the nearest surfel with observations.
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
        """Return the response as a dictionary for the report."""
        return {
            "model": self.model.value,
            "white": self.white,
            "by_range": self.by_range.round(4).tolist(),
            "by_incidence": self.by_incidence.round(4).tolist(),
            "by_ring": self.by_ring.round(4).tolist(),
        }


@dataclass(frozen=True, eq=False)
class Reflectances:
    """Reflectances of surfels, and the sensor response that converts them to intensities."""

    surfels: Floats  # (m,), 0.01 to 1
    response: Response

    def intensities(self, sweep: AlignedSweep, hits: SurfelHits) -> Floats:
        """Simulate the intensities of a sweep's rays, on the scale of the recorded intensities.

        The array has shape (n,), and is NaN for rays that hit nothing.
        """
        law = self.response.model.white_intensities(hits.distance_m, hits.cosine)
        intensities = np.full(len(sweep.points), np.nan)
        law *= self.response.by_ring[sweep.ring[hits.rays]]
        intensities[hits.rays] = self.surfels[hits.surfel] * law * self.response.scale
        return intensities


def fit_response(
    parts: Sequence[Observations], ring_count: int, *, are_energies: bool
) -> Response | None:
    """Fit a sensor's response to rays that end on surfels.

    Return None if there are no intensities.

    Parameters
    ----------
    parts
        Observations of distinct surfels.
    ring_count
        Number of rings.
    are_energies
        Whether intensities are known to be energies. Otherwise, they are assumed to be compensated
        for range, unless the energy model fits clearly better. Surfaces that were observed from a
        single distance fit both models.

    Notes
    -----
    Model errors are relative, because energies span several decades and close surfaces would
    otherwise dominate. The fit compares sums instead of logarithms, because many sensors report 0
    for dark surfaces.
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
    # A reflectance of 1 is white, and the factors absorb larger values. Reflectances of surfels
    # with few rays are noisy, so they are weighted by rays.
    reflectance = best.reflectance[observations.surfel]
    white = max(float(np.quantile(reflectance, _WHITE_SHARE)), 1e-6 * best.brightest)
    typical = float(np.nanmedian(best.reflectance)) / white
    simulated = (reflectance / white).clip(_MIN_REFLECTANCE, 1.0)
    simulated *= best.model.white_intensities(observations.range_m, observations.cosine)
    by_range, by_incidence, by_ring = best.factors
    simulated *= by_ring[observations.ring]
    scale = float(best.intensity.sum() / simulated.sum())
    return Response(
        best.model, by_range, by_incidence, by_ring, white, best.brightest, typical, scale
    )


class _Factors(NamedTuple):
    """Fitted sensor factors and reflectances of surfels, which are NaN for unobserved surfels."""

    model: IntensityModel
    intensity: Floats  # (k,), where retroreflectors are clipped to white
    factors: list[Floats]
    reflectance: Floats  # intensity divided by the law of the model and the factors
    brightest: float
    difference: float  # mean relative difference between modeled and recorded intensities

    @classmethod
    def from_rays(
        cls, observations: Observations, model: IntensityModel, ring_count: int
    ) -> _Factors:
        """Alternately fit the factors and the reflectances to the intensities of rays.

        A surface is observed at few ranges, incidences and rings, so what they do not determine
        remains unchanged.
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
    """Divide the sum of the values in each row by the sum of the expected values.

    Rows with too little data keep their value in `before`.
    """
    count = len(before)
    sums = np.bincount(row, values, count)
    sums_expected = np.bincount(row, expected, count)
    enough = sums_expected > 0
    if np.isfinite(before).all():  # factors, not reflectances
        enough &= np.bincount(row, minlength=count) >= _MIN_RAYS
    return np.divide(sums, sums_expected, out=before.copy(), where=enough)


def _range_bin(range_m: AnyFloats) -> Ints:
    return np.asarray(np.searchsorted(_RANGE_EDGES_M, range_m, side="right") - 1)


def _incidence_bin(cosine: AnyFloats) -> Ints:
    return np.asarray((cosine * _INCIDENCE_BINS).astype(np.int64).clip(0, _INCIDENCE_BINS - 1))
