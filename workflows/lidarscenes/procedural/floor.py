"""Find the floor below a sensor position, and the ceiling above it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.numerics.arrays import Bools, Floats, Indices
from lidarsim.scene.scene import Scene

# Maximum thickness of a floor slab. Sensors can be inside thicker objects, such as a hall.
SLAB_M = 0.5
FURNITURE_M = 1.5  # minimum height of a ceiling above the floor


def floor_and_ceiling(scene: Scene, x: float, y: float) -> tuple[float, float]:
    """Return the world heights of the floor and the ceiling at the given x and y.

    The floor is the lowest triangle at the position if it faces up, as ground does, or the top of
    the lowest slab. Otherwise, it is the lowest point of the scene. The ceiling is the lowest
    triangle above the height of furniture, or infinite if there is none.
    """
    heights, up = _crossings(scene, np.array([x, y]) - scene.origin[:2])
    floor = scene.bounds[0, 2]
    if up.any() and heights[up].min() <= heights.min() + SLAB_M:
        floor = heights[up].min()
    ceiling = heights[heights > floor + FURNITURE_M].min(initial=np.inf)
    return float(floor + scene.origin[2]), float(ceiling + scene.origin[2])


def surface_heights(scene: Scene, x: float, y: float) -> Floats:
    """Return the world heights at which a vertical line at x and y crosses triangles."""
    heights, _ = _crossings(scene, np.array([x, y]) - scene.origin[:2])
    return heights + scene.origin[2]


def triangles_in_box(scene: Scene, lower: ArrayLike, upper: ArrayLike) -> Indices:
    """Return the indices of all triangles whose bounding boxes overlap the given box.

    The corners of the box are local coordinates of shape (3,), or (2,) for any height.
    """
    candidates = np.arange(len(scene.faces))
    for axis, (axis_lower, axis_upper) in enumerate(
        zip(np.asarray(lower), np.asarray(upper), strict=True)
    ):
        corners = scene.vertices[:, axis][scene.faces[candidates]]
        candidates = candidates[
            (corners.max(axis=1) >= axis_lower) & (corners.min(axis=1) <= axis_upper)
        ]
    return candidates


def _crossings(scene: Scene, position: Floats) -> tuple[Floats, Bools]:
    """Return the heights at which a vertical line crosses triangles.

    The line is at a local position (2,). The second result is a mask (k,) of the triangles that
    face up.
    """
    a, b, c = np.moveaxis(
        scene.vertices[scene.faces[triangles_in_box(scene, position, position)]], 1, 0
    )
    # Twice the areas of the triangles between the position and each side, in plan view.
    parts = np.stack([_areas(p, q, position) for p, q in ((b, c), (c, a), (a, b))], axis=1)
    area = parts.sum(axis=1)
    crossed = ((parts >= 0).all(axis=1) | (parts <= 0).all(axis=1)) & (area != 0)
    corners = np.stack([a[crossed, 2], b[crossed, 2], c[crossed, 2]], axis=1)
    return (corners * parts[crossed]).sum(axis=1) / area[crossed], area[crossed] > 0


def _areas(p: Floats, q: Floats, position: Floats) -> Floats:
    """Return twice the signed area of each triangle (p, q, position) in plan view.

    Counterclockwise triangles have positive areas.
    """
    to_p = p[:, :2] - position
    to_q = q[:, :2] - position
    return np.asarray(to_p[:, 0] * to_q[:, 1] - to_p[:, 1] * to_q[:, 0])
