"""How densely a scene's surfaces were hit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import LidarpoolError
from ..scene.scene import Scene

Floats = NDArray[np.float64]

ENOUGH_HITS = 12  # a density is read off about so many hits
MOST_ROUNDS = 12


def checked_counts(scene: Scene, hit_counts: ArrayLike) -> Floats:
    """Hits of each triangle as numbers, (f,); what is not finite or negative counts as none.

    Raises
    ------
    LidarpoolError
        If there is not one count a triangle.
    """
    hits = np.asarray(hit_counts, dtype=np.float64)
    if hits.shape != (len(scene.faces),):
        raise LidarpoolError(
            f"Hit counts have shape {hits.shape}; the scene has {len(scene.faces)} triangles, "
            "and needs one count for each."
        )
    return np.where(np.isfinite(hits) & (hits > 0), hits, 0.0)


def hit_density(scene: Scene, hits: Floats) -> Floats:
    """Hits per square metre at each triangle, (f,).

    Where triangles are so small that most were hit once or never, hits are shared with the
    triangles around: each gives a third to each of its corners, each corner gives them back by
    area, as often as it takes to read a density off a dozen hits. The total stays the same.

    Parameters
    ----------
    hits
        (f,) from `checked_counts`.
    """
    a, b, c = (scene.vertices[scene.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    for _ in range(_rounds(hits)):
        hits = _share(scene.faces, hits, area, len(scene.vertices))
    return np.divide(hits, area, out=np.zeros_like(hits), where=area > 0)


def _rounds(hits: Floats) -> int:
    """How often hits are to be shared with the neighbours."""
    hit = hits[hits > 0]
    if not len(hit):
        return 0
    # Counts of one leave it open how many triangles were seen and missed: take three times
    # as many as were hit, so that the rings of a sparse scan run together.
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
    # Triangles without area can hold no density; they keep what they have.
    return np.where(area > 0, shared, hits)
