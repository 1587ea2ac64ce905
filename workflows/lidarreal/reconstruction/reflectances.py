"""Estimate the reflectances of surfels from recorded intensities.

A recorded intensity is modeled as the product of the surface reflectance and the response of the
sensor. The response is a factor for each ring that depends on the range, times a power of the
cosine of incidence. If intensities are energies (`IntensityModel`), they also decrease with the
square of the range. The response is fitted to the intensities of surfels that were observed from
several positions. A simulation applies the same response, which is part of the sensor file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from lidarsim.media.materials import MAX_REFLECTANCE_SPREAD
from lidarsim.numerics.arrays import AnyFloats, Floats, Integers, Ints
from lidarsim.sensor.beams import Beams
from lidarsim.sensor.optics import MIN_COSINE

from .porosity import dithered
from .surface_map import Observations

_ROUNDS = 12  # iterations of fitting the response and the reflectances
# Ranges in meters at which the factors of the rings are estimated.
RANGES_M = np.array([3, 5, 7, 10, 15, 20, 30, 45, 65, 100, 150], np.float64)
_EDGES_M = np.sqrt(RANGES_M[:-1] * RANGES_M[1:])
_MIN_RAYS = 200  # A factor with fewer rays is not changed.
_WHITE_QUANTILE = 0.999  # quantile of the intensities above which a surface counts as white
_WHITE_SHARE = 0.99  # quantile of the reflectances, weighted by rays, that counts as white
_MIN_REFLECTANCE = 0.01  # for surfaces that were recorded as black
_MAX_DIFFERENCE = 0.9  # maximum error of a model relative to that of the simpler model
_WHITE_RANGE_M = 10.0  # range at which a white surface has a simulated intensity of 1
_FACTOR_DECIMALS = 3
_EXPONENT_DECIMALS = 2
_MIN_FACTOR = 0.001  # for rings and ranges that only recorded black
_MAX_EXPONENT = 4.0
# Minimum variance of the logarithm of the cosine of incidence, over the rays of a surfel, from
# which the exponent is estimated. It is smaller if the sensor is stationary.
_MIN_INCIDENCE_VARIANCE = 0.003
_NEIGHBORS = 9  # surfels whose mean reflectance supplements surfels with few rays
_PRIOR_RAYS = 3.0  # weight of this mean, in rays
_SPREAD_STEP = 0.1  # step to which the spreads of reflectances are rounded


class IntensityModel(StrEnum):
    """Model of how intensities depend on range and angle of incidence."""

    COMPENSATED = "compensated for range"
    ENERGIES = "energies"

    @property
    def incidence_exponent(self) -> float:
        """Exponent of the cosine of incidence, unless the observations determine it."""
        return 1.0 if self is IntensityModel.ENERGIES else 0.0

    def attenuation(self, range_m: AnyFloats) -> Floats:
        """Return the relative intensities of equally bright surfaces at normal incidence."""
        if self is IntensityModel.COMPENSATED:
            return np.ones(len(range_m))
        return np.asarray((_WHITE_RANGE_M / np.asarray(range_m, np.float64)) ** 2)

    def law(self, range_m: AnyFloats, cosine: AnyFloats) -> Floats:
        """Return the relative intensities of equally bright surfaces."""
        return self.attenuation(range_m) * incidence_factors(cosine, self.incidence_exponent)


def incidence_factors(cosine: AnyFloats, exponent: float) -> Floats:
    """Return the relative intensities of surfaces, given the cosines of incidence.

    As in a simulation, the received intensity is proportional to the cosine, and the sensor applies
    a power of the cosine to it.
    """
    cosine = np.asarray(cosine, np.float64)
    return np.asarray(cosine * np.maximum(cosine, MIN_COSINE) ** (exponent - 1))


@dataclass(frozen=True, eq=False)
class Response:
    """Relationship between the intensities of a sensor and the reflectances of surfaces.

    Attributes
    ----------
    model
        How intensities depend on the range.
    by_ring
        Intensity factors of the r rings at the k ranges `RANGES_M`, between which they are
        interpolated. float64 array of shape (r, k).
    incidence_exponent
        Exponent of the cosine of incidence.
    white
        Intensity of a white surface. If intensities are energies, this is the intensity at 10 m and
        normal incidence.
    brightest
        Maximum ratio of intensity to the law of the model. Brighter surfaces, such as
        retroreflectors, are clipped to it.
    typical
        Median reflectance.
    scale
        Mean ratio of recorded to simulated intensities.
    """

    model: IntensityModel
    by_ring: Floats
    incidence_exponent: float
    white: float
    brightest: float
    typical: float
    scale: float

    def white_intensities(self, range_m: AnyFloats, cosine: AnyFloats, ring: Integers) -> Floats:
        """Return the intensities that a simulation stores for white surfaces.

        Energies correspond to the simulated column `intensity`. Intensities that are compensated
        for range correspond to the column `reflectance`, to which `reflectivity` is proportional.
        The array has shape (n,).
        """
        beams = Beams(
            np.zeros(len(self.by_ring)),
            intensity_factor=self.by_ring,
            intensity_range_m=RANGES_M,
        )
        factors = beams.intensity_factors(ring, range_m)
        factors *= incidence_factors(cosine, self.incidence_exponent)
        return factors * self.model.attenuation(range_m)

    def reflectances(self, observations: Observations, centers: Floats) -> Reflectances:
        """Estimate the reflectances of surfels, given the centers of the surfels.

        The centers have shape (m, 3). A surfel with few rays has about the mean reflectance of its
        neighbors. If these have no rays, because they are occluded for example, it has the
        reflectance of the nearest surfel whose reflectance is known.
        """
        from scipy.spatial import cKDTree

        rays = observations.select(np.isfinite(observations.intensity))
        count = len(centers)
        expected = self.white * self.white_intensities(rays.range_m, rays.cosine, rays.ring)
        law = self.model.law(rays.range_m, rays.cosine)
        intensity = np.minimum(rays.intensity, self.brightest * law)
        ray_count = np.bincount(rays.surfel, minlength=count)
        recorded = np.bincount(rays.surfel, intensity, count)
        white = np.bincount(rays.surfel, expected, count)
        neighbors = cKDTree(centers).query(centers, min(_NEIGHBORS, count))[1].reshape(count, -1)
        with np.errstate(divide="ignore", invalid="ignore"):  # surfels without rays
            surfels = np.nan_to_num(recorded / white)
            nearby = recorded[neighbors].sum(axis=1) / white[neighbors].sum(axis=1)
        spreads = _spreads(rays, intensity, expected * surfels[rays.surfel], neighbors)
        surfels = (ray_count * surfels + _PRIOR_RAYS * nearby) / (ray_count + _PRIOR_RAYS)
        known = np.isfinite(surfels)
        if known.any():
            _, nearest = cKDTree(centers[known]).query(centers[~known])
            surfels[~known] = surfels[known][nearest]
        else:
            surfels[:] = self.typical
        return Reflectances(np.clip(surfels, _MIN_REFLECTANCE, 1.0), spreads, self)

    def figures(self) -> dict[str, Any]:
        """Return the response as a dictionary for the report."""
        return {
            "model": self.model.value,
            "white": self.white,
            "incidence_exponent": self.incidence_exponent,
            "ranges_m": RANGES_M.tolist(),
            "by_ring": self.by_ring.tolist(),
        }


@dataclass(frozen=True, eq=False)
class Reflectances:
    """Reflectances of surfels, and the sensor response that converts them to intensities."""

    surfels: Floats  # (m,), 0.01 to 1
    spreads: Floats  # (m,), relative standard deviation of the intensities of the rays
    response: Response

    def intensities(
        self, surfel: Ints, range_m: AnyFloats, cosine: AnyFloats, ring: Integers
    ) -> Floats:
        """Simulate the mean intensities of rays that hit surfels, on the scale of the recording.

        All arrays have shape (n,).
        """
        white = self.response.white_intensities(range_m, cosine, ring)
        return self.surfels[surfel] * white * self.response.scale


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
        np.isfinite(observations.intensity) & (observations.cosine > MIN_COSINE)
    )
    if not (observations.intensity > 0).any():
        return None
    models = (IntensityModel.ENERGIES,) if are_energies else tuple(IntensityModel)
    fits = [_Fit.best_of(observations, model, ring_count) for model in models]
    best = fits[0]
    if fits[-1].difference < _MAX_DIFFERENCE * best.difference:
        best = fits[-1]
    # A reflectance of 1 is white, and the factors absorb larger values. Reflectances of surfels
    # with few rays are noisy, so they are weighted by rays.
    reflectance = best.reflectance[observations.surfel]
    white = max(float(np.quantile(reflectance, _WHITE_SHARE)), 1e-6 * best.brightest)
    response = Response(
        best.model,
        best.by_ring,
        best.incidence_exponent,
        white,
        best.brightest,
        typical=float(np.nanmedian(best.reflectance)) / white,
        scale=1.0,
    )
    simulated = (reflectance / white).clip(_MIN_REFLECTANCE, 1.0) * response.white_intensities(
        observations.range_m, observations.cosine, observations.ring
    )
    return replace(response, scale=float(best.intensity.sum() / simulated.sum()))


class _Fit(NamedTuple):
    """Fitted sensor response and reflectances of surfels, which are NaN for unobserved surfels."""

    model: IntensityModel
    by_ring: Floats  # (r, k)
    incidence_exponent: float
    intensity: Floats  # (n,), where retroreflectors are clipped to white
    reflectance: Floats  # (m,), intensity divided by the response
    brightest: float
    difference: float  # mean relative difference between modeled and recorded intensities

    @classmethod
    def best_of(cls, observations: Observations, model: IntensityModel, ring_count: int) -> _Fit:
        """Fit the response, and the incidence exponent only if it clearly improves the fit.

        Errors of the normals bias the exponent, and on level ground the ranges have the same effect
        as the angles of incidence.
        """
        stated, fitted = (
            cls.to_rays(observations, model, ring_count, fits_exponent=fits_exponent)
            for fits_exponent in (False, True)
        )
        return fitted if fitted.difference < _MAX_DIFFERENCE * stated.difference else stated

    @classmethod
    def to_rays(
        cls,
        observations: Observations,
        model: IntensityModel,
        ring_count: int,
        *,
        fits_exponent: bool,
    ) -> _Fit:
        """Alternately fit the response and the reflectances to the intensities of rays.

        A surface is observed at few ranges, incidences and rings, so what they do not determine
        remains unchanged.
        """
        product = model.law(observations.range_m, observations.cosine)
        brightest = float(np.quantile(observations.intensity / product, _WHITE_QUANTILE))
        intensity = np.minimum(observations.intensity, brightest * product)
        surfel = observations.surfel
        unknown = np.full(int(surfel.max()) + 1, np.nan)
        factors = _RingFactors.ones(ring_count)
        slopes = _within_surfels(observations)
        exponent = model.incidence_exponent
        for _ in range(_ROUNDS):
            reflectance = _ratios(surfel, intensity, product, unknown)
            factors, product = factors.fit(observations, intensity, product, reflectance[surfel])
            if not fits_exponent:
                continue
            reflectance = _ratios(surfel, intensity, product, unknown)
            step = _exponent_step(slopes, intensity / product, reflectance[surfel])
            step = float(np.clip(exponent + step, 0, _MAX_EXPONENT)) - exponent
            exponent += step
            product = product * np.asarray(observations.cosine, np.float64) ** step
        reflectance = _ratios(surfel, intensity, product, unknown)
        return cls(
            model,
            factors.table.round(_FACTOR_DECIMALS).clip(_MIN_FACTOR),
            round(exponent, _EXPONENT_DECIMALS),
            intensity,
            reflectance,
            brightest,
            _relative_difference(intensity, reflectance[surfel] * product),
        )


class _RingFactors(NamedTuple):
    """Factors for k ranges, for r rings, and for each of these rings at each range."""

    by_range: Floats  # (k,)
    by_ring: Floats  # (r,)
    by_cell: Floats  # (r * k,)

    @classmethod
    def ones(cls, ring_count: int) -> _RingFactors:
        """Return factors that change nothing."""
        count = len(RANGES_M)
        return cls(np.ones(count), np.ones(ring_count), np.ones(ring_count * count))

    @property
    def table(self) -> Floats:
        """Products of the factors. Shape (r, k)."""
        by_cell = self.by_cell.reshape(len(self.by_ring), len(self.by_range))
        return self.by_ring[:, None] * self.by_range * by_cell

    def fit(
        self, observations: Observations, intensity: Floats, product: Floats, reflectance: Floats
    ) -> tuple[_RingFactors, Floats]:
        """Fit one kind of factor after the other.

        Parameters
        ----------
        observations
            The n rays.
        intensity
            Their intensities, where retroreflectors are clipped to white.
        product
            The response, which includes the factors.
        reflectance
            Reflectance of the surfel of each ray.

        Returns
        -------
        tuple
            The fitted factors and the product that includes them.
        """
        range_row = np.searchsorted(_EDGES_M, observations.range_m)
        ring = observations.ring
        fitted = []
        for factor, row in zip(
            self, (range_row, ring, ring * len(RANGES_M) + range_row), strict=True
        ):
            others = product / factor[row]
            ratios = _ratios(row, intensity, others * reflectance, factor).clip(_MIN_FACTOR)
            ratios /= np.average(ratios, weights=np.bincount(row, minlength=len(ratios)))
            product = others * ratios[row]
            fitted.append(ratios)
        return _RingFactors(*fitted), product


def _spreads(rays: Observations, intensity: Floats, mean: Floats, neighbors: Ints) -> Floats:
    """Return the standard deviation of the intensities of each surfel relative to their mean.

    It is derived from the differences between successive rays of the same ring, so that patterns of
    the surface and errors of the response hardly contribute.

    Parameters
    ----------
    rays
        Rays in the order in which they were recorded.
    intensity, mean
        Recorded intensity and mean simulated intensity of each ray. Shape (n,).
    neighbors
        Surfels whose rays supplement those of each surfel. Shape (m, q).

    Returns
    -------
    array
        Standard deviations in a few steps, because each becomes a material. Shape (m,).
    """
    count = len(neighbors)
    order = np.lexsort((rays.ring, rays.surfel))
    surfel, ring = rays.surfel[order], rays.ring[order]
    pairs = np.flatnonzero((surfel[1:] == surfel[:-1]) & (ring[1:] == ring[:-1]))
    deviation = (intensity - mean)[order]
    half_squares = 0.5 * np.square(deviation[pairs + 1] - deviation[pairs])
    squares = np.bincount(surfel[pairs], half_squares, count)
    pair_count = np.bincount(surfel[pairs], minlength=count)
    ray_count = np.maximum(np.bincount(surfel, minlength=count), 1)
    mean_square = np.bincount(surfel, np.square(mean)[order], count) / ray_count
    relative = np.divide(squares, mean_square, out=np.zeros(count), where=mean_square > 0)
    relative = np.minimum(relative, pair_count * MAX_REFLECTANCE_SPREAD**2)
    nearby = relative[neighbors].sum(axis=1) / np.maximum(pair_count[neighbors].sum(axis=1), 1)
    variance = (relative + _PRIOR_RAYS * nearby) / (pair_count + _PRIOR_RAYS)
    return dithered(np.sqrt(variance), _SPREAD_STEP).clip(max=MAX_REFLECTANCE_SPREAD)


def _relative_difference(intensity: Floats, expected: Floats) -> float:
    """Return the mean difference between recorded and modeled intensities, relative to their sum.

    Both arrays have shape (n,).
    """
    total = np.maximum(expected + intensity, 1e-300)
    return float(np.mean(np.abs(expected - intensity) / total))


def _within_surfels(observations: Observations) -> Floats:
    """Return the logarithms of the cosines of incidence minus their means over each surfel."""
    logarithm = np.log(np.asarray(observations.cosine, np.float64))
    counts = np.bincount(observations.surfel)
    means = np.bincount(observations.surfel, logarithm) / np.maximum(counts, 1)
    return np.asarray(logarithm - means[observations.surfel])


def _exponent_step(slopes: Floats, brightness: Floats, reflectance: Floats) -> float:
    """Return the change of the incidence exponent that best explains the rays of each surfel.

    The step is 0 if each surfel was observed at about the same incidence.

    Parameters
    ----------
    slopes
        Result of `_within_surfels`.
    brightness
        Intensity of each ray divided by the response.
    reflectance
        Reflectance of the surfel of each ray.
    """
    if np.square(slopes).mean() < _MIN_INCIDENCE_VARIANCE:
        return 0.0
    variance = float(reflectance @ np.square(slopes))
    return float((brightness - reflectance) @ slopes) / variance if variance > 0 else 0.0


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
