"""Leaves by the angles of their surfaces: the light that they intercept, and their brightness.

Leaves are small, flat, and turned to all points of the compass. The angle of a leaf is the angle of
its normal from the vertical.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from ..numerics.arrays import Floats
from ..numerics.elementary import arccos, arcsin, cos, interp, log, sin, sin_cos
from ..schema.declared import allowed

LeafAngles = Literal[
    "spherical", "planophile", "erectophile", "plagiophile", "extremophile", "uniform"
]
NAMES: tuple[str, ...] = LeafAngles.__args__  # type: ignore[attr-defined]
_NODES = 361  # number of angles of light in the table, from 0 to 90 degrees
_ANGLES = 500  # number of angles of leaves in the integrals


LeafAngle = Annotated[
    LeafAngles | Annotated[float, Field(ge=0.05, le=20)],
    allowed(f"one of {', '.join(NAMES)}, or the axis ratio of an ellipsoid from 0.05 to 20"),
]


def density(leaf_angle: str | float, angle: Floats) -> Floats:
    """Return the share of the leaf area per radian, at leaf angles (n,) from 0 to π/2: (n,).

    The integral over leaf angles is 1. Names are the distributions of de Wit (1965), as
    trigonometric functions after Bunnik (1978). With "spherical", normals point evenly in all
    directions. A number is the parameter of Campbell (1990), for normals distributed as on an
    ellipsoid: the ratio of its horizontal axis to the vertical axis; 1 is spherical.
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
    """Projection and brightness of leaves, by the direction of light."""

    cosine: Floats  # (361,): of the light's angle from the vertical, ascending from 0 to 1
    projection: Floats  # (361,), from `projection`
    brightness: Floats  # (361,), from `brightness`


@cache
def _light_table(leaf_angle: str | float) -> _LightTable:
    """Integrate the projection and brightness of leaves over their angles."""
    cosine = sin(np.linspace(0, np.pi / 2, _NODES))[:, None]
    angle = (np.arange(_ANGLES, dtype=np.float64) + 0.5) * (np.pi / 2 / _ANGLES)
    share = density(leaf_angle, angle)
    share /= share.sum()
    # Cosine between light and a leaf's normal: `constant + amplitude * cos(azimuth)`.
    leaf_sine, leaf_cosine = sin_cos(angle)
    constant = cosine * leaf_cosine
    amplitude = np.sqrt(np.maximum(1 - cosine**2, 0)) * leaf_sine
    # Its mean size over all azimuths (Ross 1981): beyond `edge_on`, light meets the lower side.
    edge_on = arccos(-np.minimum(constant / np.maximum(amplitude, 1e-300), 1))
    mean = (constant * (2 * edge_on - np.pi) + 2 * amplitude * sin(edge_on)) / np.pi
    square = constant**2 + amplitude**2 / 2
    projected = (mean * share).sum(axis=1)
    bright = (square * share).sum(axis=1)
    return _LightTable(cosine[:, 0], projected, bright / projected)


def projection(leaf_angle: str | float, cosine: Floats) -> Floats:
    """Return the mean projection of leaves, as a share of their area: (n,).

    This is the G function of Ross (1981); `cosine` (n,) is the cosine of the light's angle from
    the vertical, 0 to 1.

    Examples
    --------
    >>> projection("spherical", np.array([0.0, 0.3, 1.0])).round(4).tolist()
    [0.5, 0.5, 0.5]
    """
    table = _light_table(leaf_angle)
    return interp(cosine, table.cosine, table.projection)


def brightness(leaf_angle: str | float, cosine: Floats) -> Floats:
    """Return the mean cosine between light and the normals of the leaves that light hits: (n,).

    `cosine` (n,) is the cosine of the light's angle from the vertical, 0 to 1. A leaf is hit in
    proportion to its projection, so leaves that face the light count more: the mean is two thirds
    for "spherical", in any direction.
    """
    table = _light_table(leaf_angle)
    return interp(cosine, table.cosine, table.brightness)
