"""Polygons to triangles, also those that are not convex, such as a wall with a door in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Clipping takes their square in the worst case; outlines with more are rather files gone wrong.
MOST_CORNERS = 5000

_FLAT = 1e-12  # a corner turns back if its sine, of a plane polygon, is below minus this

Point = tuple[float, float]


def triangulated(
    vertices: NDArray[np.float64], corners: NDArray[np.int64], sizes: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Cut polygons into triangles with the same corners and the same outside.

    Parameters
    ----------
    vertices
        float64 (v, 3).
    corners
        int64 (sum of sizes,): the corners of all polygons one after the other.
    sizes
        int64 (p,): how many corners each polygon has; those with less than three give nothing.

    Returns
    -------
    int64 (t, 3): of each polygon two triangles less than it has corners, in the same order.

    Raises
    ------
    ValueError
        If a corner names no vertex, or a polygon that is not convex has too many corners.
    """
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise ValueError(
            f"faces name vertices {corners.min()} to {corners.max()}, counted from 0, of "
            f"{len(vertices)}"
        )
    first = np.cumsum(sizes) - sizes
    ends = np.cumsum(np.maximum(sizes - 2, 0))
    out = np.empty((int(ends[-1]) if len(ends) else 0, 3), dtype=np.int64)
    for size in np.unique(sizes[sizes > 2]).tolist():
        which = np.flatnonzero(sizes == size)
        rows = _begun_well(vertices, corners[first[which, None] + np.arange(size)])
        places = ends[which, None] - (size - 2) + np.arange(size - 2)
        out[places, 0] = rows[:, :1]
        out[places, 1] = rows[:, 1:-1]
        out[places, 2] = rows[:, 2:]
        if size > 4:
            for i in np.flatnonzero(_turns(vertices, rows).any(axis=1)).tolist():
                out[places[i]] = rows[i][_clipped(_plane(vertices[rows[i]]))]
    return out


def _begun_well(vertices: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows (p, k) of corners; of four that are not convex the one that turns back is first.

    A fan from there fills it.
    """
    if rows.shape[1] != 4:
        return rows
    back = _turns(vertices, rows)
    begin = np.where(back.sum(axis=1) == 1, back.argmax(axis=1), 0)
    return np.take_along_axis(rows, (begin[:, None] + np.arange(4)) % 4, axis=1)


def _turns(vertices: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which corners (p, k) turn back, against the sense of the whole polygon."""
    if rows.shape[1] == 3:
        return np.zeros(rows.shape, dtype=np.bool_)
    points = vertices[rows]
    points = points - points[:, :1]  # of coordinates far from zero nothing is lost
    into = points - np.roll(points, 1, axis=1)
    out_of = np.roll(into, -1, axis=1)
    turn = np.cross(into, out_of)
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)  # Newell
    along = (turn * normal[:, None]).sum(axis=2)
    scale = np.linalg.norm(into, axis=2) * np.linalg.norm(out_of, axis=2)
    return along < -_FLAT * scale * np.linalg.norm(normal, axis=1)[:, None]


def _plane(points: NDArray[np.float64]) -> list[Point]:
    """Corners (k, 3) of a polygon as seen from its outside, anticlockwise."""
    points = points - points[0]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    drop = int(np.abs(normal).argmax())
    across, up = (drop + 1) % 3, (drop + 2) % 3
    if normal[drop] < 0:
        across, up = up, across
    return list(map(tuple, points[:, [across, up]].tolist()))


def _clipped(points: list[Point]) -> list[tuple[int, int, int]]:
    """Cut ears off a polygon that runs anticlockwise (Meisters, 1975); numbers of its corners."""
    if len(points) > MOST_CORNERS:
        raise ValueError(f"a face has {len(points):,} corners and is not convex: triangulate it")
    left = list(range(len(points)))
    ears = []
    at = missed = 0  # where we look, and in vain for how long
    while len(left) > 3:
        i, j, k = (left[(at + step) % len(left)] for step in (-1, 0, 1))
        # Of one that crosses itself there may be no ear: then any corner will do.
        if missed > len(left) or _is_ear(points, left, i, j, k):
            ears.append((i, j, k))
            left.pop(at % len(left))
            at, missed = at - 1, 0
        else:
            at, missed = at + 1, missed + 1
        at %= len(left)
    return [*ears, (left[0], left[1], left[2])]


def _is_ear(points: list[Point], left: list[int], i: int, j: int, k: int) -> bool:
    """Whether the triangle of a corner and its neighbours is within the polygon."""
    a, b, c = points[i], points[j], points[k]
    if _side(a, b, c) <= 0:
        return False
    for other in left:
        p = points[other]
        if (
            p not in (a, b, c)
            and _side(a, b, p) >= 0
            and _side(b, c, p) >= 0
            and _side(c, a, p) >= 0
        ):
            return False
    return True


def _side(a: Point, b: Point, p: Point) -> float:
    """Twice the area of a, b and p: positive where p is to the left."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])
