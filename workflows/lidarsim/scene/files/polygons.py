"""Triangulation of polygons, including nonconvex ones such as a wall with a door."""

from __future__ import annotations

import mapbox_earcut
import numpy as np

from ...numerics.arrays import Bools, Floats, Ints
from ...numerics.vectors import matvec, norm, rotate

# If an outline intersects itself everywhere, the time for ear clipping grows with the cube of the
# number of corners. It is 20 s for this number. Files with larger outlines are probably invalid.
MAX_CORNERS = 5000

_WARPED = 1e-5  # maximum deviation of a planar polygon from its plane, relative to its size
_FLAT = 1e-12  # a corner is reflex if the sine of its turning angle is below minus this


def triangulate(vertices: Floats, corners: Ints, sizes: Ints) -> Ints:
    """Triangulate polygons without changing their corners and orientation.

    Convex polygons and quadrilaterals become fans. All of these with the same number of corners are
    processed together. Other polygons are triangulated by ear clipping with mapbox_earcut.

    Parameters
    ----------
    vertices
        Coordinates. Shape (v, 3).
    corners
        Indices into `vertices` of the corners of all polygons in order. Shape (sum of sizes,).
    sizes
        Number of corners of each polygon. Polygons with fewer than three corners are ignored. Shape
        (p,).

    Returns
    -------
    Ints
        Indices into `vertices` of the triangles in the order of the polygons. Shape (t, 3). A
        polygon with n corners has n - 2 triangles. It has fewer triangles if it is planar and its
        outline intersects, touches or retraces itself, such as around a hole. In this case, the
        enclosed area is filled, and parts without area are omitted.

    Raises
    ------
    ValueError
        If a corner refers to a vertex that does not exist, or if a nonconvex polygon has more than
        `MAX_CORNERS` corners.
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
        triangles[triangle_rows] = fan_triangles(polygon_corners)
        if size > 4:
            has_reflex = _reflex_corners(vertices[polygon_corners]).any(axis=1)
            for i in np.flatnonzero(has_reflex).tolist():
                clipped = _triangulate_nonconvex(vertices, polygon_corners[i])
                if len(clipped):  # otherwise, neither the polygon nor the fan has an area
                    triangles[triangle_rows[i]] = -1
                    triangles[triangle_rows[i, : len(clipped)]] = clipped
    return triangles[triangles[:, 0] >= 0]


def _triangulate_nonconvex(vertices: Floats, corners: Ints) -> Ints:
    """Triangulate a polygon with reflex corners.

    There are no triangles if the polygon has no area.
    """
    clipped = triangulate_with_holes(vertices, [corners])
    if len(clipped) < len(corners) - 2 and _leaves_gaps(vertices[corners], vertices[clipped]):
        return np.asarray(corners[_all_triangles(vertices[corners])])
    return clipped


def _from_reflex_corner(vertices: Floats, quadrangles: Ints) -> Ints:
    """Reorder the corners of quadrilaterals so that they start at a reflex corner.

    A fan of triangles is then valid. Ear clipping would omit half of a quadrilateral that is so
    warped that its projection intersects itself. Quadrilaterals have shape (p, 4).
    """
    reflex = _reflex_corners(vertices[quadrangles])
    start = np.where(reflex.sum(axis=1) == 1, reflex.argmax(axis=1), 0)
    return np.take_along_axis(quadrangles, (start[:, None] + np.arange(4)) % 4, axis=1)


def triangulate_with_holes(vertices: Floats, rings: list[Ints]) -> Ints:
    """Triangulate a polygon with holes.

    The first ring is the outline, and the other rings are holes. The triangles have the orientation
    of the outline. There are no triangles if the outline has no area.

    Raises
    ------
    ValueError
        If a corner refers to a vertex that does not exist, or if there are more than `MAX_CORNERS`
        corners.
    """
    corners = np.concatenate(rings)
    if len(corners) > MAX_CORNERS:
        raise ValueError(f"a face has {len(corners):,} corners and is not convex. Triangulate it")
    check_corners(corners, len(vertices))
    points = vertices[corners] - vertices[corners[0]]  # preserves precision of large coordinates
    outline = points[: len(rings[0])]
    normal = _newell(outline)
    drop = int(np.abs(normal).argmax())
    across = (drop + 1) % 3
    up = (drop + 2) % 3
    if normal[drop] < 0:  # mapbox_earcut always returns counterclockwise triangles
        across, up = up, across
    return corners[_clip_ears(points[:, [across, up]], [len(ring) for ring in rings])]


def _clip_ears(flat: Floats, sizes: list[int]) -> Ints:
    """Triangulate a planar outline with holes.

    `sizes` contains the number of points of each ring, starting with the outline. Points have shape
    (k, 2), and triangles have shape (t, 3).
    """
    stops = np.cumsum(sizes).astype(np.uint32)
    triangles = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), stops)
    return np.asarray(triangles, np.int64).reshape(-1, 3)


def unroll_strip(strip: Ints) -> Ints:
    """Return the triangles of a triangle strip with a consistent orientation.

    `strip` has shape (t + 2,), and the result has shape (t, 3).
    """
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def fan_triangles(corners: Ints) -> Ints:
    """Return the triangles of triangle fans.

    `corners` has shape (…, t + 2), and the result has shape (…, t, 3).
    """
    first = np.broadcast_to(corners[..., :1], corners[..., 2:].shape)
    return np.stack([first, corners[..., 1:-1], corners[..., 2:]], axis=-1)


def _leaves_gaps(points: Floats, triangles: Floats) -> bool:
    """Return whether a polygon is so warped that its triangles leave gaps.

    If the projection of a warped polygon intersects itself, ear clipping omits triangles. The area
    vectors of a complete triangulation add up to the area vector of the polygon. The polygon has
    shape (k, 3), and triangles have shape (t, 3, 3).
    """
    points = points - points[0]
    size = np.abs(points).max()
    normal = _newell(points)
    deviation = np.ptp(matvec(points, normal))
    a, b, c = np.moveaxis(triangles, 1, 0)
    missing = normal - np.cross(b - a, c - a).sum(axis=0)
    return bool(deviation > _WARPED * size * norm(normal) and norm(missing) > _WARPED * size * size)


def _all_triangles(points: Floats) -> Ints:
    """Triangulate a warped polygon without gaps.

    The polygon is clipped along its normal. If triangles are missing, the result is the fan with
    the smallest area, which starts at the reflex corner if there is only one. The polygon has shape
    (k, 3), and triangles have shape (k - 2, 3).
    """
    count = len(points)
    points = points - points[0]
    normal = _newell(points)
    normal = normal / norm(normal)
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    clipped = _clip_ears(rotate(points, np.stack([across, np.cross(normal, across)])), [count])
    if len(clipped) == count - 2:
        return clipped

    def area(start: int) -> float:
        rotated = np.roll(points, -start, axis=0) - points[start]
        return float(norm(np.cross(rotated[1:-1], rotated[2:])).sum())

    best = min(range(count), key=area)
    return fan_triangles((best + np.arange(count)) % count)


def _newell(points: Floats) -> Floats:
    """Compute twice the area vector of a polygon with Newell's method."""
    return np.asarray(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0))


def check_corners(corners: Ints, vertex_count: int) -> None:
    """Check that corners refer to existing vertices.

    Raises
    ------
    ValueError
        If a corner refers to a vertex that does not exist.
    """
    if len(corners) and not 0 <= corners.min() <= corners.max() < vertex_count:
        raise ValueError(
            f"faces refer to vertices {corners.min()} to {corners.max()}, counted from 0, but "
            f"there are {vertex_count} vertices"
        )


def _reflex_corners(points: Floats) -> Bools:
    """Return a mask of the reflex corners of polygons.

    Polygons have shape (p, k, 3), and the mask has shape (p, k).
    """
    points = points - points[:, :1]
    into = points - np.roll(points, 1, axis=1)
    out_of = np.roll(into, -1, axis=1)
    bend = np.cross(into, out_of)
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    bend_along_normal = (bend * normal[:, None]).sum(axis=2)
    scale = norm(into) * norm(out_of)
    return np.asarray(bend_along_normal < -_FLAT * scale * norm(normal)[:, None])
