"""Polygons to triangles, also those that are not convex, such as a wall with a door in it."""

from __future__ import annotations

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

# One that crosses itself all over takes the clipper their cube, 20 seconds for this many;
# outlines with more are rather files gone wrong.
MOST_CORNERS = 5000

_FLAT = 1e-12  # a corner turns back if its sine, of a plane polygon, is below minus this


def triangulated(
    vertices: NDArray[np.float64], corners: NDArray[np.int64], sizes: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Cut polygons into triangles with the same corners and the same outside.

    Convex ones and quadrangles become fans, all of one size at once; of others ears are clipped
    off by mapbox_earcut.

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
    int64 (t, 3), in the order of the polygons: of each two triangles less than it has corners.
    There are fewer where an outline crosses or touches itself or runs back on itself, such as
    around a hole: what it encloses is filled, and parts without area are left out.

    Raises
    ------
    ValueError
        If a corner names no vertex, or a polygon that is not convex has too many corners.
    """
    _check(vertices, corners)
    first = np.cumsum(sizes) - sizes
    ends = np.cumsum(np.maximum(sizes - 2, 0))
    out = np.full((int(ends[-1]) if len(ends) else 0, 3), -1, dtype=np.int64)
    for size in np.unique(sizes[sizes > 2]).tolist():
        which = np.flatnonzero(sizes == size)
        rows = _begun_well(vertices, corners[first[which, None] + np.arange(size)])
        places = ends[which, None] - (size - 2) + np.arange(size - 2)
        out[places, 0] = rows[:, :1]
        out[places, 1] = rows[:, 1:-1]
        out[places, 2] = rows[:, 2:]
        if size > 4:
            for i in np.flatnonzero(_turns(vertices, rows).any(axis=1)).tolist():
                clipped = _clipped(vertices[rows[i]])
                if len(clipped):  # else it has no area, and the fan has none that matters
                    out[places[i]] = -1
                    out[places[i, : len(clipped)]] = rows[i][clipped]
    return out[out[:, 0] >= 0]


def with_holes(vertices: NDArray[np.float64], rings: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Triangles (t, 3) of one polygon: its outline, and outlines of holes in it.

    Raises
    ------
    ValueError
        As `triangulated`.
    """
    corners = np.concatenate(rings)
    _check(vertices, corners)
    flat = _plane(vertices[corners], len(rings[0]))
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    found = mapbox_earcut.triangulate_float64(flat, ends).astype(np.int64)
    return corners[found].reshape(-1, 3)


def _check(vertices: NDArray[np.float64], corners: NDArray[np.int64]) -> None:
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise ValueError(
            f"faces name vertices {corners.min()} to {corners.max()}, counted from 0, of "
            f"{len(vertices)}"
        )


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


def _clipped(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangles (t, 3) of the corners (k, 3) of one polygon; none where it has no area."""
    if len(points) > MOST_CORNERS:
        raise ValueError(f"a face has {len(points):,} corners and is not convex: triangulate it")
    rings = np.array([len(points)], dtype=np.uint32)
    found = mapbox_earcut.triangulate_float64(_plane(points), rings)
    return found.astype(np.int64).reshape(-1, 3)


def _plane(points: NDArray[np.float64], outline: int | None = None) -> NDArray[np.float64]:
    """Corners (k, 3) of a polygon as seen from its outside, anticlockwise: (k, 2).

    The clipper makes triangles that run anticlockwise, whatever the polygon does. Of a polygon
    with holes only the first corners are its `outline`.
    """
    points = points - points[0]  # of coordinates far from zero nothing is lost
    around = points[:outline]
    normal = np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)
    drop = int(np.abs(normal).argmax())
    across, up = (drop + 1) % 3, (drop + 2) % 3
    if normal[drop] < 0:
        across, up = up, across
    return np.ascontiguousarray(points[:, [across, up]])
