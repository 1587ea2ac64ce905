"""Leaf angle distributions, and the light that leaves intercept and scatter.

Leaves are small and flat, and their azimuths are uniformly distributed. The leaf angle is the angle
between the normal of a leaf and the vertical.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from ..numerics.arrays import Floats
from ..numerics.elementary import arccos, arcsin, cos, interp, log, sin, sin_cos
from ..schema.declared import describe_allowed

LeafAngles = Literal[
    "spherical", "planophile", "erectophile", "plagiophile", "extremophile", "uniform"
]
NAMES: tuple[str, ...] = LeafAngles.__args__  # type: ignore[attr-defined]
_NODES = 361  # number of light directions in the table, from 0 to 90 degrees
_ANGLES = 500  # number of leaf angles in the integrals


LeafAngle = Annotated[
    LeafAngles | Annotated[float, Field(ge=0.05, le=20)],
    describe_allowed(
        f"one of {', '.join(NAMES)}, or the axis ratio of an ellipsoid from 0.05 to 20"
    ),
]


def leaf_angle_density(leaf_angle: str | float, angle: Floats) -> Floats:
    """Return the density of a leaf angle distribution, per radian.

    The integral of the density over leaf angles from 0 to π/2 is 1.

    Parameters
    ----------
    leaf_angle
        Name of a distribution of de Wit (1965), in the trigonometric form of Bunnik (1978), or
        parameter of the ellipsoidal distribution of Campbell (1990). In a "spherical" distribution,
        the normals are uniformly distributed over all directions. In an ellipsoidal distribution,
        they are distributed as on an ellipsoid. The parameter is the ratio of its horizontal axis
        to its vertical axis, and 1 is equivalent to "spherical".
    angle
        Leaf angles in radians, from 0 to π/2. Shape (n,).

    Returns
    -------
    array
        Density for each angle. Shape (n,).
    """
    sine, cosine = sin_cos(angle)
    if leaf_angle == "spherical":
        return sine
    if isinstance(leaf_angle, str):
        wave = {
            "planophile": 1 + cos(2 * angle),
            "erectophile": 1 - cos(2 * angle),
            "plagiophile": 1 - cos(4 * angle),
            "extremophile": 1 + cos(4 * angle),
            "uniform": np.ones_like(angle),
        }[leaf_angle]
        return np.asarray(2 / np.pi * wave)
    axis_ratio = float(leaf_angle)
    shape = sine / (cosine**2 + (axis_ratio * sine) ** 2) ** 2
    if axis_ratio == 1:
        return np.asarray(shape)
    if axis_ratio < 1:
        eccentricity = np.sqrt(1 - axis_ratio * axis_ratio)
        axes = axis_ratio + arcsin(eccentricity) / eccentricity
    else:
        eccentricity = np.sqrt(1 - 1 / (axis_ratio * axis_ratio))
        axes = axis_ratio + log((1 + eccentricity) / (1 - eccentricity)) / (
            2 * eccentricity * axis_ratio
        )
    return np.asarray(2 * (axis_ratio * axis_ratio * axis_ratio) / axes * shape)


class _LightTable(NamedTuple):
    """Projection and brightness of leaves, tabulated by the direction of the light."""

    cosine: Floats  # (361,), cosine of the angle between the light and the vertical, ascending
    projection: Floats  # (361,), as returned by `mean_projection`
    brightness: Floats  # (361,), as returned by `mean_brightness`


@cache
def _light_table(leaf_angle: str | float) -> _LightTable:
    """Integrate the projection and the brightness of leaves over all leaf angles."""
    cosine = sin(np.linspace(0, np.pi / 2, _NODES))[:, None]
    angle = (np.arange(_ANGLES, dtype=np.float64) + 0.5) * (np.pi / 2 / _ANGLES)
    fraction = leaf_angle_density(leaf_angle, angle)
    fraction /= fraction.sum()
    # The cosine of the angle between the light and the normal of a leaf is
    # `constant + amplitude * cos(azimuth)`.
    leaf_sine, leaf_cosine = sin_cos(angle)
    constant = cosine * leaf_cosine
    amplitude = np.sqrt(np.maximum(1 - cosine**2, 0)) * leaf_sine
    # The mean absolute value over all azimuths follows Ross (1981). At azimuths beyond `edge_on`,
    # the light hits the lower side of the leaf.
    edge_on = arccos(-np.minimum(constant / np.maximum(amplitude, 1e-300), 1))
    mean = (constant * (2 * edge_on - np.pi) + 2 * amplitude * sin(edge_on)) / np.pi
    square = constant**2 + amplitude**2 / 2
    projected = (mean * fraction).sum(axis=1)
    bright = (square * fraction).sum(axis=1)
    return _LightTable(cosine[:, 0], projected, bright / projected)


def mean_projection(leaf_angle: str | float, cosine: Floats) -> Floats:
    """Return the mean projected area of leaves as a fraction of their area.

    This is the G function of Ross (1981). `cosine` is the cosine of the angle between the light and
    the vertical, from 0 to 1. `cosine` and the result have shape (n,).

    Examples
    --------
    >>> mean_projection("spherical", np.array([0.0, 0.3, 1.0])).round(4).tolist()
    [0.5, 0.5, 0.5]
    """
    table = _light_table(leaf_angle)
    return interp(cosine, table.cosine, table.projection)


def mean_brightness(leaf_angle: str | float, cosine: Floats) -> Floats:
    """Return the mean cosine of the incidence angle at which light hits leaves.

    The probability that a leaf is hit is proportional to its projected area, so leaves that face
    the light have a larger weight. The mean for a "spherical" distribution is two thirds in every
    direction.

    `cosine` is the cosine of the angle between the light and the vertical, from 0 to 1. `cosine`
    and the result have shape (n,).
    """
    table = _light_table(leaf_angle)
    return interp(cosine, table.cosine, table.brightness)
