"""The floor under a position, where a sensor stands, and the ceiling over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.base.arrays import Bools, Floats, Indices
from lidarsim.scene.scene import Scene

# More than the thickness of floors: a sensor stands inside thicker things, such as a box hall.
SLAB_M = 0.5
FURNITURE_M = 1.5  # a ceiling is at least so high above the floor


def room_at(scene: Scene, x: float, y: float) -> tuple[float, float]:
    """Heights of the floor at a position, and of the ceiling over it, in world metres.

    The floor is the lowest triangle there if it faces up, like ground, or the top of a slab if
    that is lowest; else the lowest point of the whole scene. The ceiling is the lowest triangle
    that is higher than furniture; infinite if there is none.
    """
    heights, up = _crossings(scene, np.array([x, y]) - scene.origin[:2])
    floor = scene.bounds[0, 2]
    if up.any() and heights[up].min() <= heights.min() + SLAB_M:
        floor = heights[up].min()
    ceiling = heights[heights > floor + FURNITURE_M].min(initial=np.inf)
    return float(floor + scene.origin[2]), float(ceiling + scene.origin[2])


def heights_at(scene: Scene, x: float, y: float) -> Floats:
    """Heights (k,), world metres, at which a vertical line at a place crosses triangles."""
    heights, _ = _crossings(scene, np.array([x, y]) - scene.origin[:2])
    return heights + scene.origin[2]


def reaching(scene: Scene, low: ArrayLike, high: ArrayLike) -> Indices:
    """Triangles that may reach into a box, or a rectangle seen from above, local: (k,)."""
    found = np.arange(len(scene.faces))
    for axis, (least, most) in enumerate(zip(np.asarray(low), np.asarray(high), strict=True)):
        ends = scene.vertices[:, axis][scene.faces[found]]
        found = found[(ends.max(axis=1) >= least) & (ends.min(axis=1) <= most)]
    return found


def _crossings(scene: Scene, at: Floats) -> tuple[Floats, Bools]:
    """Heights (k,) at which a vertical line crosses triangles, and which of them face up."""
    a, b, c = np.moveaxis(scene.vertices[scene.faces[reaching(scene, at, at)]], 1, 0)
    # Twice the areas of the triangles that the place makes with each side, seen from above.
    parts = np.stack([_areas(p, q, at) for p, q in ((b, c), (c, a), (a, b))], axis=1)
    whole = parts.sum(axis=1)
    here = ((parts >= 0).all(axis=1) | (parts <= 0).all(axis=1)) & (whole != 0)
    corners = np.stack([a[here, 2], b[here, 2], c[here, 2]], axis=1)
    return (corners * parts[here]).sum(axis=1) / whole[here], whole[here] > 0


def _areas(p: Floats, q: Floats, at: Floats) -> Floats:
    """Twice the areas of p, q and a place from above, positive where they turn left: (f,)."""
    to_p = p[:, :2] - at
    to_q = q[:, :2] - at
    return np.asarray(to_p[:, 0] * to_q[:, 1] - to_p[:, 1] * to_q[:, 0])
