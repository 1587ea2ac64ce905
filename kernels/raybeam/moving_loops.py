"""Loops of moving.py, which compare rays with the boxes and spheres around moving bodies.

Rays are float64 (6, n): origins, meters, and directions of about unit length. Times are in
seconds. A pose is a column of a table (12, p): position, meters, and rotation from the body's axes
by rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from .arrays import Floats, Indices, Ints
from .body_rays import NearestHits, RayBodyPairs
from .cast_record import float64s, int64s
from .compiled import compiled, inlined, stage

CELL = 64  # rays of a cell
WIDE = 16  # cells of a wide cell
PADS_M = 1e-3  # margin around boxes, besides 2e-6 of the distance: far more than rounding
# Columns of cells: axis, and cosine and sine of the half angle, of the cone around the directions;
# center and radius of the sphere around the origins, meters; first and last time; normal of the
# plane that the directions lie near, and the sine of the greatest angle between a direction and
# the plane.
AXIS = 0
COSINE = 3
SINE = 4
MIDDLE = 5
RADIUS = 8
BEGIN = 9
END = 10
NORMAL = 11
MAX_SINE = 14
_TINY = 1e-300
_f64_1 = types.float64[::1]
_f64_2 = types.float64[:, ::1]
_i64_1 = types.int64[::1]
_i64_2 = types.int64[:, ::1]
_i32_1 = types.int32[::1]


class BodySamples(NamedTuple):
    """Boxes of bodies, sampled at steps of time.

    Attributes
    ----------
    sample_of_cell
        int64 (c, 2): number of the last sample up to the first time, and up to the last time of
        each cell of rays.
    boxes
        float64 (b, s, 12): centers of the bodies' boxes, and halves of their sides as vectors,
        meters.
    spheres
        float64 (b, 4): radius of the sphere around the box, meters; slack: how far the box may be
        from its sample during a step of time, meters; first and last time of the body's presence.
    """

    sample_of_cell: Ints
    boxes: Floats
    spheres: Floats


class CellBodyPairs(NamedTuple):
    """Pairs of a cell of rays and a body.

    Attributes
    ----------
    cell
        int64 (m,): number of the cell.
    pose
        int64 (m,): column of the body's pose in a table.
    shape
        int64 (m,): number of the body's shape.
    pads
        float64 (m,): margin around the body's box, meters.
    """

    cell: Ints
    pose: Ints
    shape: Ints
    pads: Floats


def named_tuple_type(kind: type, *fields: types.Type) -> types.Type:
    """Return the numba type of a NamedTuple class `kind`, whose fields have these types."""
    return types.BaseTuple.from_types(fields, kind)


_SAMPLES = named_tuple_type(BodySamples, _i64_2, types.float64[:, :, ::1], _f64_2)
_PAIRS = named_tuple_type(CellBodyPairs, _i64_1, _i64_1, _i64_1, _f64_1)
LIMITS = types.UniTuple(types.float64, 2)
PAIRS = named_tuple_type(
    RayBodyPairs, _f64_2, _i64_1, _i64_1, _i64_1, _f64_2, _f64_1, LIMITS, _f64_1
)
NEAREST_HITS = named_tuple_type(NearestHits, _f64_1, _i64_1, _i32_1, _i32_1)


@compiled("f8[:, ::1](f8[:, ::1], f8[::1], i8)")
def make_cells(rays, times, size):  # type: ignore[no-untyped-def]  # noqa: PLR0914, PLR0915 - a compiled loop
    """Return cells (c, 15): each is `size` consecutive rays (6, n), fired at times (n,).

    The constants `AXIS` to `MAX_SINE` are the columns of cells.
    """
    count = -(-len(times) // size)
    cells = np.empty((count, 15))
    for c in range(count):
        begin = c * size
        end = min((c + 1) * size, len(times))
        ax = ay = az = px = py = pz = 0.0
        first = last = times[begin]
        for k in range(begin, end):
            ax = ax + rays[3, k]
            ay = ay + rays[4, k]
            az = az + rays[5, k]
            px = px + rays[0, k]
            py = py + rays[1, k]
            pz = pz + rays[2, k]
            first = min(first, times[k])
            last = max(last, times[k])
        length = max(np.sqrt(ax * ax + ay * ay + az * az), _TINY)
        ax = ax / length
        ay = ay / length
        az = az / length
        n = end - begin
        px = px / n
        py = py / n
        pz = pz / n
        x = rays[3, begin]
        y = rays[4, begin]
        z = rays[5, begin]
        dx = rays[3, end - 1]
        dy = rays[4, end - 1]
        dz = rays[5, end - 1]
        nx = y * dz - z * dy
        ny = z * dx - x * dz
        nz = x * dy - y * dx
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), _TINY)
        nx = nx / length
        ny = ny / length
        nz = nz / length
        cosine = 1.0
        max_squared = 0.0
        max_sine = 0.0
        for k in range(begin, end):
            side = nx * rays[3, k] + ny * rays[4, k] + nz * rays[5, k]
            max_sine = max(max_sine, abs(side))
            along_axis = ax * rays[3, k] + ay * rays[4, k] + az * rays[5, k]
            cosine = min(cosine, along_axis)
            x = rays[0, k] - px
            y = rays[1, k] - py
            z = rays[2, k] - pz
            max_squared = max(max_squared, x * x + y * y + z * z)
        cosine = max(cosine, -1.0)
        cells[c, AXIS] = ax
        cells[c, AXIS + 1] = ay
        cells[c, AXIS + 2] = az
        cells[c, COSINE] = cosine
        cells[c, SINE] = np.sqrt(1 - cosine * cosine)
        cells[c, MIDDLE] = px
        cells[c, MIDDLE + 1] = py
        cells[c, MIDDLE + 2] = pz
        cells[c, RADIUS] = np.sqrt(max_squared)
        cells[c, BEGIN] = first
        cells[c, END] = last
        cells[c, NORMAL] = nx
        cells[c, NORMAL + 1] = ny
        cells[c, NORMAL + 2] = nz
        cells[c, MAX_SINE] = max_sine
    return cells


@inlined
def _may_meet(cell, box, sphere, reach):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Return whether rays of a cell may meet a body in its box.

    `cell` points to a row of `make_cells`, `box` and `sphere` point to rows of `BodySamples`. `reach`
    is the greatest distance at which a ray ends, meters.
    """
    radius = sphere[0]
    slack = sphere[1]
    first = sphere[2]
    last = sphere[3]
    x = box[0] - cell[MIDDLE]
    y = box[1] - cell[MIDDLE + 1]
    z = box[2] - cell[MIDDLE + 2]
    nx = cell[NORMAL]
    ny = cell[NORMAL + 1]
    nz = cell[NORMAL + 2]
    plane_distance = abs(x * nx + y * ny + z * nz)
    distance_bound = abs(x) + abs(y) + abs(z)
    reach_bound = radius + slack + cell[RADIUS] + 1e-6 * distance_bound
    if (
        plane_distance > reach_bound + (distance_bound + reach_bound) * cell[MAX_SINE]
    ):  # which needs no root
        return False
    distance = np.sqrt(x * x + y * y + z * z)
    margin = slack + cell[RADIUS] + 1e-6 * distance
    radius = radius + margin
    if distance - radius > reach or cell[END] < first or cell[BEGIN] > last:
        return False
    side = 0.0
    for k in range(3, 12, 3):
        side += abs(box[k] * nx + box[k + 1] * ny + box[k + 2] * nz)
    if plane_distance - (distance + radius) * cell[MAX_SINE] > side + margin:
        return False
    if distance > radius:
        sine = radius / distance
        cosine = np.sqrt(1 - sine * sine)
        if cell[SINE] * cosine + cell[COSINE] * sine >= 0:  # within a half turn
            edge = distance * (cell[COSINE] * cosine - cell[SINE] * sine)
            return (
                x * cell[AXIS] + y * cell[AXIS + 1] + z * cell[AXIS + 2] >= edge - 1e-6 * distance
            )
    return True


# Loops write to arrays that are long enough: numba takes 8 s to compile slices and copies.
@compiled(types.int64(_f64_2, _f64_2, _SAMPLES, types.float64, _i64_2))
def _pair_cells(wide_cells, cells, samples, reach, pairs):  # type: ignore[no-untyped-def]
    """Write pairs (2, k) of a cell and a body that may meet, and return the number of pairs k."""
    sample_of_cell, boxes, spheres = samples
    count = 0
    # Pointers: views of arrays would be counted, which takes longer than the comparisons.
    cell = cells.ctypes.data
    wide_cell = wide_cells.ctypes.data
    box = boxes.ctypes.data
    for b in range(len(spheres)):
        sphere = float64s(spheres.ctypes.data + 32 * b)
        body_boxes = box + 96 * boxes.shape[1] * b
        for w in range(len(wide_cells)):
            begin = w * WIDE
            end = min((w + 1) * WIDE, len(cells))
            first = sample_of_cell[begin, 0]
            if sample_of_cell[end - 1, 1] - first <= 1:  # the slack of spheres covers a step
                sampled_box = float64s(body_boxes + 96 * first)
                if not _may_meet(float64s(wide_cell + 120 * w), sampled_box, sphere, reach):
                    continue
            for c in range(begin, end):
                first = sample_of_cell[c, 0]
                if sample_of_cell[c, 1] - first <= 1:
                    sampled_box = float64s(body_boxes + 96 * first)
                    if not _may_meet(float64s(cell + 120 * c), sampled_box, sphere, reach):
                        continue
                pairs[0, count] = c
                pairs[1, count] = b
                count += 1
    return count


def pair_cells_with_bodies(
    wide_cells: Floats, cells: Floats, samples: BodySamples, reach: float
) -> tuple[Indices, Indices]:
    """Return pairs of a cell and a body that its rays may meet, by body, then by cell.

    Parameters
    ----------
    wide_cells, cells
        float64 (w, 15) and (c, 15), from `make_cells`: cells of `WIDE` times as many rays, and cells
        of `CELL` rays. Most wide cells rule out all their cells at once.
    samples
        The bodies.
    reach
        Greatest distance at which a ray ends, meters.

    Returns
    -------
    cell, body
        int64 (k,): rows of `cells`, and of the arrays of `samples`.
    """
    pairs = np.empty((2, len(cells) * len(samples.spheres)), np.int64)
    count = _pair_cells(wide_cells, cells, samples, reach, pairs)
    return pairs[0, :count], pairs[1, :count]


@inlined
def pose_rotation(poses, p):  # type: ignore[no-untyped-def]
    """Return the rotation from the body's axes, three rows, of the pose in column p."""
    return (
        (poses[3, p], poses[4, p], poses[5, p]),
        (poses[6, p], poses[7, p], poses[8, p]),
        (poses[9, p], poses[10, p], poses[11, p]),
    )


@inlined
def to_body_axes(rotation, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate a vector in the scene to the axes of a body, by the transposed `pose_rotation`."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    return (x * a + y * d) + z * g, (x * b + y * e) + z * h, (x * c + y * f) + z * i


@inlined
def box_corners(box):  # type: ignore[no-untyped-def]
    """Return the lower and the upper corner of a box, which points to six numbers."""
    return (box[0], box[1], box[2]), (box[3], box[4], box[5])


@inlined
def _clip_axis(slab, o, d, interval):  # type: ignore[no-untyped-def]
    """Return the part of an interval of distances along a ray that lies within a slab."""
    enters, leaves = interval
    inverse = 1 / (d if abs(d) >= _TINY else _TINY)
    lower = (slab[0] - o) * inverse
    upper = (slab[1] - o) * inverse
    return max(enters, min(lower, upper)), min(leaves, max(lower, upper))


@inlined
def passes_box(corners, pad, reach, origin, direction):  # type: ignore[no-untyped-def]
    """Return whether a ray passes through a box, enlarged by `pad`, before the distance `reach`.

    The ray and the corners of the box are in the axes of the body, meters.
    """
    (a, b, c), (d, e, f) = corners
    x, y, z = origin
    pad += 2e-6 * (abs(x) + abs(y) + abs(z))
    interval = _clip_axis((a - pad, d + pad), x, direction[0], (-np.inf, np.inf))
    interval = _clip_axis((b - pad, e + pad), y, direction[1], interval)
    enters, leaves = _clip_axis((c - pad, f + pad), z, direction[2], interval)
    return (enters <= leaves) & (leaves >= 0) & (enters * (1 - 1e-6) <= reach)


@inlined
def _sphere_around(corners, pose, pad):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Return the center (3), in the scene, and the radius of a sphere around a box at a pose.

    The sphere encloses what `passes_box` adds to the box for a ray from the sphere's center;
    `_near_sphere` adds what grows with the distance.
    """
    (a, b, c), (d, e, f) = corners
    (px, py, pz), (row_1, row_2, row_3) = pose
    x = (a + d) / 2
    y = (b + e) / 2
    z = (c + f) / 2
    u = (d - a) / 2
    v = (e - b) / 2
    w = (f - c) / 2
    radius = np.sqrt(u * u + v * v + w * w) + 2 * pad + 4e-6 * (abs(x) + abs(y) + abs(z))
    center = (
        px + (row_1[0] * x + row_1[1] * y + row_1[2] * z),
        py + (row_2[0] * x + row_2[1] * y + row_2[2] * z),
        pz + (row_3[0] * x + row_3[1] * y + row_3[2] * z),
    )
    return center, radius


@stage
def _near_sphere(rays, n, x, y, z, radius, near):  # type: ignore[no-untyped-def]
    """Write which rays of a cell pass through the sphere around a body, and return their number.

    `rays` is the address of the cell's first ray in (6, n). `x`, `y`, `z` and `radius` are of the
    sphere, meters. The output `near`, 0 or 1, is the address of int64 (`CELL`,).
    """
    ray = float64s(rays)
    is_near = int64s(near)
    near_count = np.int64(0)
    for k in range(CELL):
        u = x - ray[k]
        v = y - ray[n + k]
        w = z - ray[2 * n + k]
        dx = ray[3 * n + k]
        dy = ray[4 * n + k]
        dz = ray[5 * n + k]
        along = u * dx + v * dy + w * dz
        squared = u * u + v * v + w * w
        reach = radius + 8e-6 * (abs(u) + abs(v) + abs(w))
        outside = squared - reach * reach  # above 0 for a ray that starts outside
        length = dx * dx + dy * dy + dz * dz
        is_near[k] = np.int64((outside <= 0) | ((along >= 0) & (outside * length <= along * along)))
        near_count += is_near[k]
    return near_count


@inlined
def _ray_passes_box(rays, n, k, reach, pose, corners, pad):  # type: ignore[no-untyped-def]
    """Return whether ray k of rays (6, n), at an address, passes through a box at a pose."""
    ray = float64s(rays)
    (px, py, pz), rotation = pose
    origin = to_body_axes(rotation, ray[k] - px, ray[n + k] - py, ray[2 * n + k] - pz)
    direction = to_body_axes(rotation, ray[3 * n + k], ray[4 * n + k], ray[5 * n + k])
    return passes_box(corners, pad, reach, origin, direction)


@compiled(types.int64(_f64_2, _f64_1, _PAIRS, _f64_2, _f64_2, _i64_1, _i64_2))
def _pair_rays(rays, reaches, pairs, poses, boxes, near, ray_pairs):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write the rays that pass through boxes to `ray_pairs`, with the pair of each.

    Returns the number of columns written: number of the ray, and of the pair of a cell and a body.
    `near` is memory for a cell. The other arguments are as in `rays_through_boxes`.
    """
    cell, pose_of_pair, shape, pads = pairs
    written = 0
    count = rays.shape[1]
    for pair in range(len(cell)):
        begin = cell[pair] * CELL
        end = min((cell[pair] + 1) * CELL, len(reaches))
        corners = box_corners(float64s(boxes.ctypes.data + 48 * shape[pair]))
        p = pose_of_pair[pair]
        first = min(begin, count - CELL)
        pose = (poses[0, p], poses[1, p], poses[2, p]), pose_rotation(poses, p)
        ray = rays.ctypes.data + 8 * first
        (x, y, z), radius = _sphere_around(corners, pose, pads[pair])
        if not _near_sphere(ray, count, x=x, y=y, z=z, radius=radius, near=near.ctypes.data):
            continue
        for k in range(begin, end):
            if near[k - first] and _ray_passes_box(
                ray, count, k - first, reach=reaches[k], pose=pose, corners=corners, pad=pads[pair]
            ):
                ray_pairs[0, written] = k
                ray_pairs[1, written] = pair
                written += 1
    return written


def rays_through_boxes(
    rays: Floats, reaches: Floats, pairs: CellBodyPairs, poses: Floats, boxes: Floats
) -> tuple[Indices, Indices]:
    """Return the rays of cells that pass through boxes of bodies, and the pair of each.

    Parameters
    ----------
    rays
        float64 (6, n): origins, meters, and directions.
    reaches
        float64 (n,): distance at which each ray ends, meters.
    pairs
        Pairs of a cell and a body.
    poses
        float64 (12, p): positions, meters, and rotations from the bodies' axes by rows.
    boxes
        float64 (s, 6): lower and upper corner of the box of each shape, meters.

    Returns
    -------
    ray, pair
        int64 (k,): numbers of rays and pairs, by pair, then by ray.
    """
    cell = np.ascontiguousarray(pairs.cell)
    pairs = pairs._replace(cell=cell, shape=np.ascontiguousarray(pairs.shape))
    ray_pairs = np.empty((2, len(cell) * CELL), np.int64)
    if len(reaches) < CELL:  # the loop over a cell has a constant length
        rays = np.concatenate([rays, np.zeros((6, CELL - len(reaches)))], axis=1)
        # A ray that ends at NaN passes no box.
        reaches = np.concatenate([reaches, np.full(CELL - len(reaches), np.nan)])
    near = np.empty(CELL, np.int64)
    count = _pair_rays(rays, reaches, pairs, poses, boxes, near=near, ray_pairs=ray_pairs)
    return ray_pairs[0, :count], ray_pairs[1, :count]
