"""Triangulation of polygons, also non-convex polygons, such as a wall with a door."""

from __future__ import annotations

import mapbox_earcut
import numpy as np

from ...numerics.arrays import Bools, Floats, Ints
from ...numerics.vectors import matvec, norm, rotate

# For an outline that crosses itself everywhere, the clipper's time grows with the cube of the
# corners: 20 s for this number. Larger outlines are probably broken files.
MAX_CORNERS = 5000

_WARPED = 1e-5  # largest distance of a plane polygon's corners from the plane, over its size
_FLAT = 1e-12  # a corner turns back if its sine, of a plane polygon, is below minus this


def triangulated(vertices: Floats, corners: Ints, sizes: Ints) -> Ints:
    """Cut polygons into triangles with the same corners and orientation.

    Convex polygons and quadrangles become fans, all of the same size at once; mapbox_earcut clips
    the ears of other polygons.

    Parameters
    ----------
    vertices
        (v, 3).
    corners
        (sum of sizes,): rows of `vertices` of all polygons in order.
    sizes
        (p,): number of corners of each polygon; polygons with fewer than three are dropped.

    Returns
    -------
    (t, 3), rows of `vertices`, in the order of the polygons: for each polygon two triangles less
    than corners. There are fewer triangles if a plane outline crosses or touches itself or runs
    back on itself, such as around a hole: the enclosed area is filled, and parts without area are
    left out.

    Raises
    ------
    ValueError
        If a corner refers to a missing vertex, or a non-convex polygon has too many corners.
    """
    check_corners(corners, len(vertices))
    first = np.cumsum(sizes) - sizes
    stops = np.cumsum(np.maximum(sizes - 2, 0))
    triangles = np.full((int(stops[-1]) if len(stops) else 0, 3), -1, dtype=np.int64)
    for size in np.unique(sizes[sizes > 2]).tolist():
        polygons = np.flatnonzero(sizes == size)
        polygon_corners = corners[first[polygons, None] + np.arange(size)]
        if size == 4:
            polygon_corners = _from_reflex_corner(vertices, polygon_corners)
        triangle_rows = stops[polygons, None] - (size - 2) + np.arange(size - 2)
        triangles[triangle_rows] = fanned(polygon_corners)
        if size > 4:
            has_reflex = _reflex_corners(vertices[polygon_corners]).any(axis=1)
            for i in np.flatnonzero(has_reflex).tolist():
                clipped = _clipped_polygon(vertices, polygon_corners[i])
                if len(clipped):  # else neither polygon nor fan have an area
                    triangles[triangle_rows[i]] = -1
                    triangles[triangle_rows[i, : len(clipped)]] = clipped
    return triangles[triangles[:, 0] >= 0]


def _clipped_polygon(vertices: Floats, corners: Ints) -> Ints:
    """Return the triangles (t, 3) of a polygon with reflex corners, or none without an area."""
    clipped = with_holes(vertices, [corners])
    if len(clipped) < len(corners) - 2 and _leaves_gaps(vertices[corners], vertices[clipped]):
        return np.asarray(corners[_all_triangles(vertices[corners])])
    return clipped


def _from_reflex_corner(vertices: Floats, quadrangles: Ints) -> Ints:
    """Rotate the corners of quadrangles (p, 4) to start at a reflex corner, so that a fan fits.

    The clipper would leave out half of a quadrangle so warped that its projection crosses itself.
    """
    reflex = _reflex_corners(vertices[quadrangles])
    start = np.where(reflex.sum(axis=1) == 1, reflex.argmax(axis=1), 0)
    return np.take_along_axis(quadrangles, (start[:, None] + np.arange(4)) % 4, axis=1)


def with_holes(vertices: Floats, rings: list[Ints]) -> Ints:
    """Return the triangles (t, 3) of a polygon with holes.

    The first of the `rings` is the outline, further rings are outlines of holes. The triangles have
    the orientation of the outline; there are no triangles if the outline has no area.

    Raises
    ------
    ValueError
        If a corner refers to a missing vertex, or there are too many corners.
    """
    corners = np.concatenate(rings)
    if len(corners) > MAX_CORNERS:
        raise ValueError(f"a face has {len(corners):,} corners and is not convex. Triangulate it")
    check_corners(corners, len(vertices))
    points = vertices[corners] - vertices[corners[0]]  # so that large coordinates lose no digits
    outline = points[: len(rings[0])]
    normal = _newell(outline)
    drop = int(np.abs(normal).argmax())
    across = (drop + 1) % 3
    up = (drop + 2) % 3
    if normal[drop] < 0:  # the clipper's triangles run anticlockwise, whatever the polygon does
        across, up = up, across
    return corners[_clipped(points[:, [across, up]], [len(ring) for ring in rings])]


def _clipped(flat: Floats, sizes: list[int]) -> Ints:
    """Return the triangles (t, 3) of plane rings (k, 2): outline and holes, of `sizes` corners."""
    stops = np.cumsum(sizes).astype(np.uint32)
    triangles = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), stops)
    return np.asarray(triangles, np.int64).reshape(-1, 3)


def unrolled(strip: Ints) -> Ints:
    """Return the triangles (t, 3) of a strip of corners (t + 2,), all with the same orientation."""
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def fanned(corners: Ints) -> Ints:
    """Return the triangles (…, t, 3) of fans of corners (…, t + 2)."""
    first = np.broadcast_to(corners[..., :1], corners[..., 2:].shape)
    return np.stack([first, corners[..., 1:-1], corners[..., 2:]], axis=-1)


def _leaves_gaps(points: Floats, triangles: Floats) -> bool:
    """Return True if a polygon (k, 3) is warped and its triangles (t, 3, 3) leave gaps.

    The projection of a warped polygon may cross itself, where the clipper leaves triangles out.
    The area vectors of all triangles add up to the polygon's, however the polygon is cut.
    """
    points = points - points[0]
    size = np.abs(points).max()
    normal = _newell(points)
    deviation = np.ptp(matvec(points, normal))
    a, b, c = np.moveaxis(triangles, 1, 0)
    missing = normal - np.cross(b - a, c - a).sum(axis=0)
    return bool(deviation > _WARPED * size * norm(normal) and norm(missing) > _WARPED * size * size)


def _all_triangles(points: Floats) -> Ints:
    """Return triangles (k - 2, 3) of a warped polygon (k, 3): clipped along its normal, or a fan.

    The fan is the fan of the least area, which starts at the reflex corner if there is only one.
    """
    count = len(points)
    points = points - points[0]
    normal = _newell(points)
    normal = normal / norm(normal)
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    clipped = _clipped(rotate(points, np.stack([across, np.cross(normal, across)])), [count])
    if len(clipped) == count - 2:
        return clipped

    def area(start: int) -> float:
        rotated = np.roll(points, -start, axis=0) - points[start]
        return float(norm(np.cross(rotated[1:-1], rotated[2:])).sum())

    best = min(range(count), key=area)
    return fanned((best + np.arange(count)) % count)


def _newell(points: Floats) -> Floats:
    """Return twice the area vector of a polygon (k, 3) (Newell)."""
    return np.asarray(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0))


def check_corners(corners: Ints, vertex_count: int) -> None:
    """Check that corners refer to existing vertices, numbered from 0.

    Raises ValueError if not.
    """
    if len(corners) and not 0 <= corners.min() <= corners.max() < vertex_count:
        raise ValueError(
            f"faces refer to vertices {corners.min()} to {corners.max()}, counted from 0, but "
            f"there are {vertex_count} vertices"
        )


def _reflex_corners(points: Floats) -> Bools:
    """Return the mask (p, k) of reflex corners of polygons (p, k, 3)."""
    points = points - points[:, :1]
    into = points - np.roll(points, 1, axis=1)
    out_of = np.roll(into, -1, axis=1)
    bend = np.cross(into, out_of)
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    bend_along_normal = (bend * normal[:, None]).sum(axis=2)
    scale = norm(into) * norm(out_of)
    return np.asarray(bend_along_normal < -_FLAT * scale * norm(normal)[:, None])
