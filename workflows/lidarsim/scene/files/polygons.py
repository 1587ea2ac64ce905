"""Triangulates polygons, also non-convex ones, such as a wall with a door."""

from __future__ import annotations

import mapbox_earcut
import numpy as np

from ...base.arrays import Bools, Floats, Ints
from ...base.vectors import applied, length, turned

# For an outline that crosses itself everywhere, the clipper's time grows with their cube: 20 s for
# so many. Larger outlines are probably broken files.
MOST_CORNERS = 5000

_WARPED = 1e-5  # a polygon is plane if its corners lie this near a plane, over its size
_FLAT = 1e-12  # a corner turns back if its sine, of a plane polygon, is below minus this


def triangulated(vertices: Floats, corners: Ints, sizes: Ints) -> Ints:
    """Cut polygons into triangles with the same corners and orientation.

    Convex polygons and quadrangles become fans, all of one size at once; mapbox_earcut clips the
    ears of others.

    `vertices` are (v, 3), `corners` (sum of sizes,) those of all polygons one after the other, and
    `sizes` (p,) how many each has; polygons with fewer than three are dropped.

    Returns
    -------
    (t, 3), in the order of the polygons: of each two triangles less than it has corners. There are
    fewer if a plane outline crosses or touches itself or runs back on itself, such as around a
    hole: the enclosed area is filled, and parts without area are left out.

    Raises
    ------
    ValueError
        If a corner refers to no vertex, or a non-convex polygon has too many corners.
    """
    check_corners(corners, len(vertices))
    first = np.cumsum(sizes) - sizes
    ends = np.cumsum(np.maximum(sizes - 2, 0))
    out = np.full((int(ends[-1]) if len(ends) else 0, 3), -1, dtype=np.int64)
    for size in np.unique(sizes[sizes > 2]).tolist():
        which = np.flatnonzero(sizes == size)
        rows = corners[first[which, None] + np.arange(size)]
        if size == 4:
            rows = _begun_well(vertices, rows)
        places = ends[which, None] - (size - 2) + np.arange(size - 2)
        out[places] = fanned(rows)
        if size > 4:
            for i in np.flatnonzero(_turns(vertices[rows]).any(axis=1)).tolist():
                clipped = with_holes(vertices, [rows[i]])
                if len(clipped) < size - 2 and _lost(vertices[rows[i]], vertices[clipped]):
                    clipped = rows[i][_all_triangles(vertices[rows[i]])]
                if len(clipped):  # else it has no area, nor has the fan
                    out[places[i]] = -1
                    out[places[i, : len(clipped)]] = clipped
    return out[out[:, 0] >= 0]


def _begun_well(vertices: Floats, rows: Ints) -> Ints:
    """Rotate quadrangles (p, 4) to begin at their reflex corner, if any, so that a fan fills them.

    The clipper would leave out half of a quadrangle so warped that its projection crosses itself.
    """
    back = _turns(vertices[rows])
    begin = np.where(back.sum(axis=1) == 1, back.argmax(axis=1), 0)
    return np.take_along_axis(rows, (begin[:, None] + np.arange(4)) % 4, axis=1)


def with_holes(vertices: Floats, rings: list[Ints]) -> Ints:
    """Clip the ears off one polygon: an outline, and the outlines of holes in it.

    The triangles (t, 3) have the orientation of the outline; none if it has no area.

    Raises
    ------
    ValueError
        As `triangulated`.
    """
    corners = np.concatenate(rings)
    if len(corners) > MOST_CORNERS:
        raise ValueError(f"a face has {len(corners):,} corners and is not convex: triangulate it")
    check_corners(corners, len(vertices))
    points = vertices[corners] - vertices[corners[0]]  # so that far ones lose no digits
    outline = points[: len(rings[0])]
    normal = _newell(outline)
    drop = int(np.abs(normal).argmax())
    across = (drop + 1) % 3
    up = (drop + 2) % 3
    if normal[drop] < 0:  # the clipper's triangles run anticlockwise, whatever the polygon does
        across, up = up, across
    return corners[_clipped(points[:, [across, up]], [len(ring) for ring in rings])]


def _clipped(flat: Floats, sizes: list[int]) -> Ints:
    """Triangles (t, 3) of a plane outline (k, 2) and holes in it, of so many corners each."""
    ends = np.cumsum(sizes).astype(np.uint32)
    found = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), ends)
    return np.asarray(found, np.int64).reshape(-1, 3)


def unrolled(strip: Ints) -> Ints:
    """Triangles (t, 3) of a strip of corners (t + 2,), all facing the same way."""
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def fanned(corners: Ints) -> Ints:
    """Triangles (…, t, 3) of fans of corners (…, t + 2)."""
    first = np.broadcast_to(corners[..., :1], corners[..., 2:].shape)
    return np.stack([first, corners[..., 1:-1], corners[..., 2:]], axis=-1)


def _lost(points: Floats, triangles: Floats) -> bool:
    """Whether a polygon (k, 3) is warped, and triangles (t, 3, 3) of it do not fill it.

    The projection of a warped polygon may cross itself, where the clipper leaves triangles out.
    All triangles together have the polygon's area vector, however it is cut.
    """
    points = points - points[0]
    size = np.abs(points).max()
    normal = _newell(points)
    off = np.ptp(applied(points, normal))
    a, b, c = np.moveaxis(triangles, 1, 0)
    missing = normal - np.cross(b - a, c - a).sum(axis=0)
    return bool(off > _WARPED * size * length(normal) and length(missing) > _WARPED * size * size)


def _all_triangles(points: Floats) -> Ints:
    """Triangles (k - 2, 3) of a warped polygon (k, 3): clipped as seen along its normal, or a fan.

    The fan is the one with the least area, which of a polygon with one reflex corner begins there.
    """
    count = len(points)
    points = points - points[0]
    normal = _newell(points)
    normal = normal / length(normal)
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    found = _clipped(turned(points, np.stack([across, np.cross(normal, across)])), [count])
    if len(found) == count - 2:
        return found

    def area(begin: int) -> float:
        rest = np.roll(points, -begin, axis=0) - points[begin]
        return float(length(np.cross(rest[1:-1], rest[2:])).sum())

    best = min(range(count), key=area)
    return fanned((best + np.arange(count)) % count)


def _newell(points: Floats) -> Floats:
    """Twice the area vector of a polygon (k, 3) (Newell)."""
    return np.asarray(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0))


def check_corners(corners: Ints, vertices: int) -> None:
    """Check that corners refer to some of so many vertices; ValueError if not."""
    if len(corners) and not 0 <= corners.min() <= corners.max() < vertices:
        raise ValueError(
            f"faces refer to vertices {corners.min()} to {corners.max()}, counted from 0, of "
            f"{vertices}"
        )


def _turns(points: Floats) -> Bools:
    """Whether corners (p, k, 3) are reflex, against the sense of the polygon: (p, k)."""
    points = points - points[:, :1]
    into = points - np.roll(points, 1, axis=1)
    out_of = np.roll(into, -1, axis=1)
    turn = np.cross(into, out_of)
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    along = (turn * normal[:, None]).sum(axis=2)
    scale = length(into) * length(out_of)
    return np.asarray(along < -_FLAT * scale * length(normal)[:, None])
