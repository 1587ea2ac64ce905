"""Leaves by the angles of their surfaces: what they intercept of light, and how bright they are.

Leaves are small, flat, and turned to all points of the compass. The angle of a leaf is that of its
normal from the vertical.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ..base.arrays import Floats
from ..base.declared import allowed
from ..base.elementary import arccos, arcsin, cos, interp, log, sin, sin_cos

LeafAngles = Literal[
    "spherical", "planophile", "erectophile", "plagiophile", "extremophile", "uniform"
]
NAMES: tuple[str, ...] = LeafAngles.__args__  # type: ignore[attr-defined]
_NODES = 361  # angles of light for which integrals are tabulated, from 0 to 90 degrees
_ANGLES = 500  # of leaves, in the integrals


LeafAngle = Annotated[
    LeafAngles | Annotated[float, Field(ge=0.05, le=20)],
    allowed(f"one of {', '.join(NAMES)}, or the ratio of an ellipsoid's axes, 0.05 to 20"),
]


def density(leaf_angle: str | float, angle: Floats) -> Floats:
    """Share of the leaf area for each radian of its angle (n,), from 0 to π/2; its integral is 1.

    Names are the distributions of de Wit (1965), as trigonometric functions after Bunnik (1978).
    With "spherical", normals point everywhere alike. A number is that of Campbell (1990): normals
    as those of an ellipsoid, its horizontal axis so many times the vertical one; 1 is spherical.
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
    x = float(leaf_angle)
    shape = sine / (cosine**2 + (x * sine) ** 2) ** 2
    if x == 1:
        return np.asarray(shape)
    if x < 1:
        e = np.sqrt(1 - x * x)
        axes = x + arcsin(e) / e
    else:
        e = np.sqrt(1 - 1 / (x * x))
        axes = x + log((1 + e) / (1 - e)) / (2 * e * x)
    return np.asarray(2 * (x * x * x) / axes * shape)


@cache
def _tables(leaf_angle: str | float) -> tuple[Floats, Floats, Floats]:
    """Cosines of light from the vertical, and for them what `projection` and `brightness` are."""
    cosine = sin(np.linspace(0, np.pi / 2, _NODES))[:, None]
    angle = (np.arange(_ANGLES, dtype=np.float64) + 0.5) * (np.pi / 2 / _ANGLES)
    share = density(leaf_angle, angle)
    share /= share.sum()
    # Cosine between light and a leaf's normal: `along + across * cos(azimuth)`.
    of_leaf = sin_cos(angle)
    along = cosine * of_leaf[1]
    across = np.sqrt(np.maximum(1 - cosine**2, 0)) * of_leaf[0]
    # Its mean size over all azimuths (Ross 1981): beyond `turn`, light meets the other side.
    turn = arccos(-np.minimum(along / np.maximum(across, 1e-300), 1))
    mean = (along * (2 * turn - np.pi) + 2 * across * sin(turn)) / np.pi
    square = along**2 + across**2 / 2
    crossing, bright = ((of * share).sum(axis=1) for of in (mean, square))
    return cosine[:, 0], crossing, bright / crossing


def projection(leaf_angle: str | float, cosine: Floats) -> Floats:
    """Mean projection of leaves, as a share of their area: the G function of Ross (1981), (n,).

    `cosine` (n,) is that of the light's angle from the vertical, 0 to 1.

    Examples
    --------
    >>> projection("spherical", np.array([0.0, 0.3, 1.0])).round(4).tolist()
    [0.5, 0.5, 0.5]
    """
    nodes, found, _ = _tables(leaf_angle)
    return interp(cosine, nodes, found)


def brightness(leaf_angle: str | float, cosine: Floats) -> Floats:
    """Mean cosine between light and the normals of the leaves that it meets: (n,).

    A leaf is met in proportion to its projection, so those that face the light count more: two
    thirds for "spherical", whatever the direction.
    """
    nodes, _, found = _tables(leaf_angle)
    return interp(cosine, nodes, found)
