"""Compiled loops over the voxels that surfaces, solids and rays occupy.

Coordinates are in voxels: voxel (i, j, k) is the cube from (i, j, k) to (i + 1, j + 1, k + 1).
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np

from raybeam.compiled import compiled, inlined

from .marks import HIT, TRAVERSED

# A surface within this distance of a voxel intersects it, regardless of rounding errors.
SLACK = 1e-6
_HALF = 0.5 + SLACK
_NEAR_SQUARE = (0.5 - SLACK) ** 2  # squared distance of the center from the sides of its voxel


@inlined
def _separated(a, b, c, first, second, u, v):
    """Return whether an axis separates the projections of a triangle and the cube.

    The axis has the components `u` and `v` along the coordinate axes `first` and `second`.
    """
    p = u * a[first] + v * a[second]
    q = u * b[first] + v * b[second]
    r = u * c[first] + v * c[second]
    radius = _HALF * (abs(u) + abs(v))
    return min(p, min(q, r)) > radius or max(p, max(q, r)) < -radius


@inlined
def _intersects(a, b, c, n):
    """Return whether a triangle intersects the cube around the origin.

    The corners `a`, `b` and `c` and the normal `n` are tuples. The bounding boxes must overlap.
    The axes are those of the separating axis theorem (Akenine-Möller 2001).
    """
    if abs(n[0] * a[0] + n[1] * a[1] + n[2] * a[2]) > _HALF * (abs(n[0]) + abs(n[1]) + abs(n[2])):
        return False
    for edge in range(3):
        if edge == 0:
            x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        elif edge == 1:
            x, y, z = c[0] - b[0], c[1] - b[1], c[2] - b[2]
        else:
            x, y, z = a[0] - c[0], a[1] - c[1], a[2] - c[2]
        if (
            _separated(a, b, c, 1, 2, -z, y)
            or _separated(a, b, c, 0, 2, z, -x)
            or _separated(a, b, c, 0, 1, -y, x)
        ):
            return False
    return True


@inlined
def _dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@inlined
def _step(p, q, t):
    """Return the linear interpolation between `p` and `q` at the fraction `t`."""
    return (p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1]), p[2] + t * (q[2] - p[2]))


@inlined
def _edge_square(p, q):
    """Return the squared distance of the origin from an edge."""
    e = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
    size = _dot(e, e)
    t = 0.0 if size == 0 else min(max(-_dot(p, e) / size, 0.0), 1.0)
    nearest = _step(p, q, t)
    return _dot(nearest, nearest)


@inlined
def _square(a, b, c, n):
    """Return the squared distance of the origin from a triangle."""
    size = _dot(n, n)
    edges = min(_edge_square(a, b), min(_edge_square(b, c), _edge_square(c, a)))
    if size == 0:
        return edges
    height = _dot(n, a) / size
    foot = (height * n[0], height * n[1], height * n[2])
    for edge in range(3):
        if edge == 0:
            p, q = a, b
        elif edge == 1:
            p, q = b, c
        else:
            p, q = c, a
        e = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
        f = (foot[0] - p[0], foot[1] - p[1], foot[2] - p[2])
        across = (e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0])
        if _dot(across, n) < 0:
            return edges
    return height * height * size


@inlined
def _ranked(square, part, inside):
    """Return the squared distance of a surface from the center of a voxel, for comparison.

    `part` is the closed surface to which the surface belongs, and `inside` the one that contains
    the center, or -1. It wins ties. The result for other surfaces that only touch the voxel is
    infinite.
    """
    if inside < 0:
        return square
    if part == inside:
        return square - SLACK
    return square if square < _NEAR_SQUARE else np.inf


@inlined
def _first(low, limit):
    """Return the first voxel along an axis that a surface with the lower bound `low` touches."""
    return max(math.ceil(max(low - 1 - SLACK, -1.0)), 0) if low < limit + 1 else limit


@inlined
def _last(high, limit):
    """Return the last voxel along an axis that a surface up to `high` touches, or -1 for none."""
    return min(math.floor(min(high + SLACK, limit + 1.0)), limit - 1) if high > -1 else -1


@compiled()
def add_surfaces(corners, numbers, parts, solid, triangle, square):  # noqa: PLR0914 - a loop
    """Set the triangle of each voxel that a triangle intersects.

    `corners` (f, 3, 3) and `numbers` (f,) are triangles and their numbers, and `parts` (f,) are the
    closed surfaces to which they belong, or -1. If several triangles intersect a voxel, `triangle`
    (x, y, z) receives the one that is closest to its center, and `square` (x, y, z) the squared
    distance. Ties are resolved in favor of earlier triangles.

    `solid` (x, y, z) is the closed surface that contains the center of each voxel, or -1. In these
    voxels, triangles of other surfaces are ignored if they are not closer to the center than the
    sides of the voxel, or than the closed surface itself.
    """
    shape = triangle.shape
    for row in range(len(corners)):
        t = corners[row]
        e = (t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2])
        f = (t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2])
        n = (e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0])
        main = 0  # dominant axis of the normal
        for axis in range(1, 3):
            if abs(n[axis]) > abs(n[main]):
                main = axis
        second = (main + 1) % 3
        third = (main + 2) % 3
        low = (min(t[0, 0], t[1, 0], t[2, 0]), min(t[0, 1], t[1, 1], t[2, 1]),
               min(t[0, 2], t[1, 2], t[2, 2]))  # fmt: skip
        high = (max(t[0, 0], t[1, 0], t[2, 0]), max(t[0, 1], t[1, 1], t[2, 1]),
                max(t[0, 2], t[1, 2], t[2, 2]))  # fmt: skip
        radius = _HALF * (abs(n[0]) + abs(n[1]) + abs(n[2]))
        at_plane = n[0] * t[0, 0] + n[1] * t[0, 1] + n[2] * t[0, 2]
        voxel = np.zeros(3, np.int64)
        for j in range(_first(low[second], shape[second]), _last(high[second], shape[second]) + 1):
            for k in range(_first(low[third], shape[third]), _last(high[third], shape[third]) + 1):
                lower = low[main]
                upper = high[main]
                if n[main] != 0:  # restrict the column to the voxels near the plane
                    away = at_plane - n[second] * (j + 0.5) - n[third] * (k + 0.5)
                    middle = away / n[main]
                    reach = radius / abs(n[main]) + 1.0
                    lower = max(lower, middle - reach)
                    upper = min(upper, middle + reach)
                for i in range(_first(lower, shape[main]), _last(upper, shape[main]) + 1):
                    voxel[main] = i
                    voxel[second] = j
                    voxel[third] = k
                    x = voxel[0] + 0.5
                    y = voxel[1] + 0.5
                    z = voxel[2] + 0.5
                    a = (t[0, 0] - x, t[0, 1] - y, t[0, 2] - z)
                    b = (t[1, 0] - x, t[1, 1] - y, t[1, 2] - z)
                    c = (t[2, 0] - x, t[2, 1] - y, t[2, 2] - z)
                    if not _intersects(a, b, c, n):
                        continue
                    inside = solid[voxel[0], voxel[1], voxel[2]]
                    distance = _ranked(_square(a, b, c, n), parts[row], inside)
                    if distance < square[voxel[0], voxel[1], voxel[2]]:
                        square[voxel[0], voxel[1], voxel[2]] = distance
                        triangle[voxel[0], voxel[1], voxel[2]] = numbers[row]


@inlined
def _turns(t, x, y):
    """Return the signed number of crossings of a triangle by a vertical line through (x, y).

    The result is -1, 0 or 1. It is positive if the corners are in counterclockwise order. Triangles
    that share an edge classify the line consistently, so the sum over a closed surface is always 0.
    """
    turns = 0
    for edge in range(3):
        p = edge
        q = (edge + 1) % 3
        if (t[p, 1] > y) == (t[q, 1] > y):
            continue
        up = t[q, 1] > t[p, 1]
        if not up:
            p, q = q, p
        at = t[p, 0] + (y - t[p, 1]) * (t[q, 0] - t[p, 0]) / (t[q, 1] - t[p, 1])
        if x < at:
            turns += 1 if up else -1
    return turns


@compiled()
def add_interior(corners, number, solid):  # noqa: C901 - a compiled loop
    """Set `solid` (x, y, z) to a number in each voxel whose center is inside a closed surface.

    `corners` (f, 3, 3) are the triangles of the surface, with consistent orientation. Voxels inside
    an earlier surface do not change.
    """
    first = np.empty(3, np.int64)
    stop = np.empty(3, np.int64)
    for axis in range(3):
        first[axis] = _first(corners[:, :, axis].min(), solid.shape[axis])
        stop[axis] = _last(corners[:, :, axis].max(), solid.shape[axis]) + 1
        if first[axis] >= stop[axis]:
            return
    # Sum of the turns of all triangles below each center, as differences along z.
    turns = np.zeros((stop[0] - first[0], stop[1] - first[1], stop[2] - first[2] + 1), np.int32)
    for row in range(len(corners)):
        t = corners[row]
        e = (t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2])
        f = (t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2])
        n = (e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0])
        begin_x = max(_first(min(t[0, 0], t[1, 0], t[2, 0]), solid.shape[0]), first[0])
        end_x = min(_last(max(t[0, 0], t[1, 0], t[2, 0]), solid.shape[0]) + 1, stop[0])
        begin_y = max(_first(min(t[0, 1], t[1, 1], t[2, 1]), solid.shape[1]), first[1])
        end_y = min(_last(max(t[0, 1], t[1, 1], t[2, 1]), solid.shape[1]) + 1, stop[1])
        for i in range(begin_x, end_x):
            for j in range(begin_y, end_y):
                turn = _turns(t, i + 0.5, j + 0.5)
                if turn == 0:
                    continue
                z = min(t[0, 2], t[1, 2], t[2, 2])
                if n[2] != 0:
                    rise = (n[0] * (i + 0.5 - t[0, 0]) + n[1] * (j + 0.5 - t[0, 1])) / n[2]
                    z = min(max(t[0, 2] - rise, z), max(t[0, 2], t[1, 2], t[2, 2]))
                k = min(max(math.ceil(z - 0.5), first[2]), stop[2])
                turns[i - first[0], j - first[1], k - first[2]] += turn
    for i in range(first[0], stop[0]):
        for j in range(first[1], stop[1]):
            total = 0
            for k in range(first[2], stop[2]):
                total += turns[i - first[0], j - first[1], k - first[2]]
                if total != 0 and solid[i, j, k] < 0:
                    solid[i, j, k] = number


@compiled()
def add_rays(origins, directions, t_min, t_ends, hits, marks):  # noqa: C901 - a compiled loop
    """Mark the voxels that rays pass through or hit.

    Each ray k is the segment from `t_min` to `t_ends[k]` of ``origins[:, k] + t * directions[:,
    k]``. If `hits[k]` is set, a surface is at its end. `marks` (x, y, z) receives the bits
    `TRAVERSED` and `HIT`. The traversal follows Amanatides and Woo 1987, but computes each crossing
    from the plane between two voxels, so that rounding errors do not accumulate.
    """
    shape = marks.shape
    voxel = np.empty(3, np.int64)
    for ray in range(origins.shape[1]):
        begin = t_min
        end = t_ends[ray]
        for axis in range(3):  # the part of the ray inside the grid
            origin = origins[axis, ray]
            direction = directions[axis, ray]
            if direction == 0:
                if not 0 <= origin < shape[axis]:
                    begin = np.inf
                continue
            near = (0 - origin) / direction
            far = (shape[axis] - origin) / direction
            begin = max(begin, min(near, far))
            end = min(end, max(near, far))
        if not begin < end:
            continue
        for axis in range(3):
            at = origins[axis, ray] + begin * directions[axis, ray]
            voxel[axis] = min(max(math.floor(at), 0), shape[axis] - 1)
        while True:
            crossing = np.inf
            across = 0
            for axis in range(3):
                direction = directions[axis, ray]
                if direction == 0:
                    continue
                plane = voxel[axis] + (1 if direction > 0 else 0)
                t = (plane - origins[axis, ray]) / direction
                if t < crossing:
                    crossing = t
                    across = axis
            if crossing >= end:
                is_hit = hits[ray] and end == t_ends[ray]
                marks[voxel[0], voxel[1], voxel[2]] |= TRAVERSED | HIT if is_hit else TRAVERSED
                break
            marks[voxel[0], voxel[1], voxel[2]] |= TRAVERSED
            voxel[across] += 1 if directions[across, ray] > 0 else -1
            if not 0 <= voxel[across] < shape[across]:
                break


@compiled()
def components_of(faces, count):
    """Return the smallest vertex that faces (f, 3) connect to each of `count` vertices."""
    parents = np.arange(count)
    for row in range(len(faces)):
        for corner in range(2):
            a = faces[row, corner]
            b = faces[row, corner + 1]
            while parents[a] != a:
                parents[a] = parents[parents[a]]
                a = parents[a]
            while parents[b] != b:
                parents[b] = parents[parents[b]]
                b = parents[b]
            if a < b:
                parents[b] = a
            else:
                parents[a] = b
    for vertex in range(count):
        parents[vertex] = parents[parents[vertex]]
    return parents
