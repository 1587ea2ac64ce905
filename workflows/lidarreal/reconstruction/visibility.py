"""Estimate the visibility from the intensities of surfaces that were observed at several ranges.

Air with the extinction coefficient α attenuates the return from a surface at the range r by the
factor exp(-2 α r). Each surface is compared with itself, so its reflectance does not matter. The
backscatter is not used, because the energy of returns from the air depends on the optics of the
sensor, which recordings do not describe.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lidarsim.media.materials import extinction
from lidarsim.numerics.arrays import Floats

from .surface_map import Observations

_RANGES_M = (5.0, 40.0)  # At shorter ranges, the receiver may see only a part of the beam.
_EXPONENTS = (2.0, 0.0)  # of the range: energies, and intensities that are compensated for range
_MIN_COSINE = 0.1
_MIN_SPREAD_M = 1.0  # minimum standard deviation of the ranges at which a surface was observed
_MIN_RAYS = 5000
_ROUNDS = 8  # iterations of a robust fit
_CAUCHY_SIGMAS = 2.0  # residual at which the weight of a ray is halved
_MIN_SIGMA = 1e-3
_MAX_VISIBILITY_KM = 1.0  # In better visibility, attenuation at these ranges is hardly measurable.
_VISIBILITIES_KM = np.geomspace(0.005, 2 * _MAX_VISIBILITY_KM, 500)
_GROUPS = 8  # groups of surfels that are fitted separately to determine the standard error
_MIN_SIGNIFICANCE = 4.0  # minimum ratio of the extinction to its standard error


class _Fit(NamedTuple):
    extinction: float  # 1/m
    sigma: float  # of the residuals of logarithms


def estimate_visibility(parts: Sequence[Observations], wavelength_nm: float) -> float | None:
    """Estimate the visibility from recorded rays that end on surfels.

    Parameters
    ----------
    parts
        Observations of distinct surfels.
    wavelength_nm
        Wavelength of the laser in nanometers.

    Returns
    -------
    float or None
        Meteorological optical range in meters, or None if the attenuation cannot be determined,
        for example without intensities or if the visibility exceeds 1 km.
    """
    rays = Observations.concatenate(parts)
    with np.errstate(invalid="ignore"):
        rays = rays.select(
            (rays.intensity > 0)
            & (rays.cosine > _MIN_COSINE)
            & (rays.range_m > _RANGES_M[0])
            & (rays.range_m < _RANGES_M[1])
        )
    rays = rays.select(_range_spread(rays) > _MIN_SPREAD_M)
    if len(rays.surfel) < _MIN_RAYS:
        return None
    exponent = min(_EXPONENTS, key=lambda power: _fit(rays, power).sigma)
    alpha = _fit(rays, exponent).extinction
    groups = [rays.select(rays.surfel % _GROUPS == group) for group in range(_GROUPS)]
    fits = [_fit(group, exponent).extinction for group in groups if len(group.surfel)]
    error = float(np.std(fits)) / np.sqrt(len(fits))
    least = extinction(_MAX_VISIBILITY_KM, wavelength_nm)
    if alpha < max(least, _MIN_SIGNIFICANCE * error):
        return None
    known = [extinction(float(value), wavelength_nm) for value in _VISIBILITIES_KM]
    return 1000 * float(np.interp(-alpha, np.negative(known), _VISIBILITIES_KM))


def _range_spread(rays: Observations) -> Floats:
    """Return the standard deviation of the ranges at which the surfel of each ray was observed."""
    return np.sqrt(_means(rays, np.square(_deviations(rays, rays.range_m))))


def _means(rays: Observations, values: Any) -> Floats:
    """Return the mean of values of the rays that end on the same surfel, for each ray."""
    count = np.bincount(rays.surfel)
    return np.asarray((np.bincount(rays.surfel, values) / np.maximum(count, 1))[rays.surfel])


def _deviations(rays: Observations, values: Any) -> Floats:
    """Return the difference of each value from the mean of its surfel."""
    return np.asarray(values - _means(rays, values))


def _fit(rays: Observations, exponent: float) -> _Fit:
    """Fit the extinction if intensities decrease with the given power of the range.

    The exponent of the cosine of incidence is fitted, too.
    """
    range_m = rays.range_m.astype(np.float64)
    logarithms = np.log(rays.intensity.astype(np.float64)) + exponent * np.log(range_m)
    target = _deviations(rays, logarithms)
    incidence = np.log(rays.cosine.astype(np.float64))
    design = np.stack([_deviations(rays, -2 * range_m), _deviations(rays, incidence)], axis=1)
    weights = np.ones(len(target))
    sigma = 0.0
    alpha = 0.0
    for _ in range(_ROUNDS):
        weighted = design * weights[:, None]
        normal = weighted.T @ design + 1e-9 * np.eye(2)
        alpha, slope = np.linalg.solve(normal, weighted.T @ target)
        residual = target - design @ np.array([alpha, slope])
        sigma = max(1.4826 * float(np.median(np.abs(residual))), _MIN_SIGMA)
        weights = 1 / (1 + np.square(residual / (_CAUCHY_SIGMAS * sigma)))
    return _Fit(float(alpha), sigma)
