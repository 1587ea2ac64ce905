"""Density of hits on a scene's surfaces."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.scene import Scene
from .theme import UNSEEN, rgb

Floats = NDArray[np.float64]

ENOUGH_HITS = 12  # a density is estimated from about so many hits
MOST_ROUNDS = 12
WIDEST_RANGE = 300.0  # densest to sparsest colour


def hit_density(scene: Scene, hit_counts: NDArray[Any]) -> Floats:
    """Hits per square metre at each triangle, (f,).

    If triangles are so small that most have one hit or none, hits are shared with neighbours:
    each triangle gives a third to each of its corners, each corner returns them by area, until a
    density is estimated from a dozen hits. The total stays the same.

    Parameters
    ----------
    hit_counts
        (f,) hits of each triangle.
    """
    hits = hit_counts.astype(np.float64)
    a, b, c = (scene.vertices[scene.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    for _ in range(_rounds(hits)):
        hits = _share(scene.faces, hits, area, len(scene.vertices))
    return np.divide(hits, area, out=np.zeros_like(hits), where=area > 0)


def _rounds(hits: Floats) -> int:
    """Choose how many times to share hits with the neighbours."""
    hit = hits[hits > 0]
    if not len(hit):
        return 0
    # Counts of one do not show how many triangles were missed: assume three times as many as
    # were hit, so that the rings of a sparse scan merge.
    typical = hit.mean() if hit.mean() > 3 else hit.mean() / 3
    return min(MOST_ROUNDS, math.floor(ENOUGH_HITS / typical / 2))


def _share(faces: NDArray[np.int32], hits: Floats, area: Floats, vertices: int) -> Floats:
    """Spread hits (f,) over the triangles that share a corner, in proportion to area (f,)."""
    given, room = np.zeros(vertices), np.zeros(vertices)
    for corner in faces.T:
        given += np.bincount(corner, weights=hits / 3, minlength=vertices)
        room += np.bincount(corner, weights=area, minlength=vertices)
    density = np.divide(given, room, out=np.zeros_like(given), where=room > 0)
    shared = area * density[faces].sum(axis=1)
    # Triangles without area have no density; they keep their hits.
    return np.where(area > 0, shared, hits)


def density_range(density: Floats, areas: Floats) -> tuple[float, float]:
    """Choose the ends of a logarithmic scale over densities on areas (f,).

    Few hits are on surfaces with less, and little area has more.
    """
    low, high = 1.0, 10.0
    if (density * areas).any():
        low, high = (
            np.percentile(density, end, weights=weights, method="inverted_cdf")
            for end, weights in ((2, density * areas), (99.5, areas * (density > 0)))
        )
    low = max(low, high / WIDEST_RANGE)
    return float(low), float(max(high, 2 * low))


def density_colours(
    density: Floats, hit: NDArray[np.bool_], limits: tuple[float, float], table: Floats
) -> Floats:
    """Colours (..., 3) by density and whether there were hits, both (...,).

    Shared hits fade out to grey; triangles that were hit themselves are never grey.

    Parameters
    ----------
    limits, table
        Ends of the logarithmic scale, and its colours (256, 3).
    """
    low, high = limits
    share = np.log(np.maximum(density, low) / low) / np.log(high / low)
    colours = table[np.clip(share * 255, 0, 255).astype(np.int64)]
    seen = np.where(hit, 1.0, np.clip(density / low / 0.6 - 0.3, 0, 1))[..., None]
    return np.asarray(rgb(UNSEEN) * (1 - seen) + colours * seen)
