"""Compiled loops that find rays that may hit moving bodies (moving.py).

Rays are float64 (6, n): origins in meters and directions of approximately unit length. Times are in
seconds. A pose is a column of a table (12, p): position in meters, and rotation matrix from the
body frame, row by row. The comparisons include margins for rounding errors, so that no hit is lost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from .arrays import Floats, Indices, Ints
from .body_rays import NearestHits, RayBodyPairs
from .cast_record import float64s, int64s
from .compiled import compiled, inlined, noinline

CELL_RAYS = 64  # rays per cell
CELLS_PER_WIDE_CELL = 16  # cells per wide cell
# Margin around boxes, in addition to 2e-6 of the distance. The margin exceeds all rounding errors.
PADS_M = 1e-3
# Columns of the table of cells: axis of the cone around the directions, and cosine and sine of its
# half angle; center and radius, in meters, of the sphere around the origins; first and last time;
# normal of a plane close to the directions, and sine of the largest angle between a direction and
# this plane.
AXIS = 0
COSINE = 3
SINE = 4
CENTER = 5
RADIUS = 8
FIRST_TIME = 9
LAST_TIME = 10
NORMAL = 11
MAX_SINE = 14
_TINY = 1e-300
_f64_1 = types.float64[::1]
_f64_2 = types.float64[:, ::1]
_i64_1 = types.int64[::1]
_i64_2 = types.int64[:, ::1]
_i32_1 = types.int32[::1]


class BodySamples(NamedTuple):
    """Bounding boxes of moving bodies, sampled at regular time steps.

    Attributes
    ----------
    sample_of_cell
        int64 (c, 2): last sample before the first time and before the last time of each cell of
        rays.
    boxes
        float64 (b, s, 12): center of each box, and its three half side vectors, in meters.
    spheres
        float64 (b, 4): radius of the box's bounding sphere in meters; slack, which is the distance
        in meters by which the box may move during a time step; first and last time at which the
        body is present.
    """

    sample_of_cell: Ints
    boxes: Floats
    spheres: Floats


class CellBodyPairs(NamedTuple):
    """Pairs of a cell and a body.

    Attributes
    ----------
    cell
        int64 (m,): index of the cell.
    pose
        int64 (m,): column of a pose table that contains the pose of the body.
    shape
        int64 (m,): index of the shape of the body.
    pads
        float64 (m,): margin around the box of the body, in meters.
    """

    cell: Ints
    pose: Ints
    shape: Ints
    pads: Floats


def named_tuple_type(kind: type, *fields: types.Type) -> types.Type:
    """Return the numba type for a NamedTuple class and the numba types of its fields."""
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
    """Divide rays into cells of `size` consecutive rays, and return a table of the cells.

    The table has shape (c, 15). The constants `AXIS` to `MAX_SINE` are its column indices.
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
        cells[c, CENTER] = px
        cells[c, CENTER + 1] = py
        cells[c, CENTER + 2] = pz
        cells[c, RADIUS] = np.sqrt(max_squared)
        cells[c, FIRST_TIME] = first
        cells[c, LAST_TIME] = last
        cells[c, NORMAL] = nx
        cells[c, NORMAL + 1] = ny
        cells[c, NORMAL + 2] = nz
        cells[c, MAX_SINE] = max_sine
    return cells


@inlined
def _may_hit(cell, box, sphere, reach):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Return whether any ray of a cell may hit a body.

    `cell` points to a row of the table of cells, and `box` and `sphere` point to rows of
    `BodySamples`. `reach` is the maximum distance at which a ray ends, in meters.
    """
    radius = sphere[0]
    slack = sphere[1]
    first = sphere[2]
    last = sphere[3]
    x = box[0] - cell[CENTER]
    y = box[1] - cell[CENTER + 1]
    z = box[2] - cell[CENTER + 2]
    nx = cell[NORMAL]
    ny = cell[NORMAL + 1]
    nz = cell[NORMAL + 2]
    plane_distance = abs(x * nx + y * ny + z * nz)
    distance_bound = abs(x) + abs(y) + abs(z)
    reach_bound = radius + slack + cell[RADIUS] + 1e-6 * distance_bound
    # This coarse comparison avoids the square root.
    if plane_distance > reach_bound + (distance_bound + reach_bound) * cell[MAX_SINE]:
        return False
    distance = np.sqrt(x * x + y * y + z * z)
    margin = slack + cell[RADIUS] + 1e-6 * distance
    radius = radius + margin
    if distance - radius > reach or cell[LAST_TIME] < first or cell[FIRST_TIME] > last:
        return False
    side = 0.0
    for k in range(3, 12, 3):
        side += abs(box[k] * nx + box[k + 1] * ny + box[k + 2] * nz)
    if plane_distance - (distance + radius) * cell[MAX_SINE] > side + margin:
        return False
    if distance > radius:
        sine = radius / distance
        cosine = np.sqrt(1 - sine * sine)
        # The sum of the two half angles is at most 180 degrees.
        if cell[SINE] * cosine + cell[COSINE] * sine >= 0:
            edge = distance * (cell[COSINE] * cosine - cell[SINE] * sine)
            return (
                x * cell[AXIS] + y * cell[AXIS + 1] + z * cell[AXIS + 2] >= edge - 1e-6 * distance
            )
    return True


# The loops write to preallocated arrays, because numba takes 8 s to compile slices and copies.
@compiled(types.int64(_f64_2, _f64_2, _SAMPLES, types.float64, _i64_2))
def _pair_cells(wide_cells, cells, samples, reach, pairs):  # type: ignore[no-untyped-def]
    """Write the (cell, body) pairs in which a ray may hit the body, and return their number."""
    sample_of_cell, boxes, spheres = samples
    count = 0
    # Pointers are used because reference counting of array views takes longer than the comparisons.
    cell = cells.ctypes.data
    wide_cell = wide_cells.ctypes.data
    box = boxes.ctypes.data
    for b in range(len(spheres)):
        sphere = float64s(spheres.ctypes.data + 32 * b)
        body_boxes = box + 96 * boxes.shape[1] * b
        for w in range(len(wide_cells)):
            begin = w * CELLS_PER_WIDE_CELL
            end = min((w + 1) * CELLS_PER_WIDE_CELL, len(cells))
            first = sample_of_cell[begin, 0]
            if sample_of_cell[end - 1, 1] - first <= 1:  # The slack covers one time step.
                sampled_box = float64s(body_boxes + 96 * first)
                if not _may_hit(float64s(wide_cell + 120 * w), sampled_box, sphere, reach):
                    continue
            for c in range(begin, end):
                first = sample_of_cell[c, 0]
                if sample_of_cell[c, 1] - first <= 1:
                    sampled_box = float64s(body_boxes + 96 * first)
                    if not _may_hit(float64s(cell + 120 * c), sampled_box, sphere, reach):
                        continue
                pairs[0, count] = c
                pairs[1, count] = b
                count += 1
    return count


def pair_cells_with_bodies(
    wide_cells: Floats, cells: Floats, samples: BodySamples, reach: float
) -> tuple[Indices, Indices]:
    """Find the (cell, body) pairs in which a ray may hit the body, sorted by body, then by cell.

    Parameters
    ----------
    wide_cells, cells
        float64 (w, 15) and (c, 15), from `make_cells`: cells of `CELL_RAYS * CELLS_PER_WIDE_CELL`
        rays and cells of `CELL_RAYS` rays. Most wide cells exclude all of their cells at once.
    samples
        The bodies.
    reach
        Maximum distance at which a ray ends, in meters.

    Returns
    -------
    cell, body
        int64 (k,): indices of cells and of bodies in `samples`.
    """
    pairs = np.empty((2, len(cells) * len(samples.spheres)), np.int64)
    count = _pair_cells(wide_cells, cells, samples, reach, pairs)
    return pairs[0, :count], pairs[1, :count]


@inlined
def pose_rotation(poses, p):  # type: ignore[no-untyped-def]
    """Return the rows of the rotation matrix in column `p` of a pose table."""
    return (
        (poses[3, p], poses[4, p], poses[5, p]),
        (poses[6, p], poses[7, p], poses[8, p]),
        (poses[9, p], poses[10, p], poses[11, p]),
    )


@inlined
def to_body_axes(rotation, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate a vector from scene to body axes by the transpose of `rotation`."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    return (x * a + y * d) + z * g, (x * b + y * e) + z * h, (x * c + y * f) + z * i


@inlined
def box_corners(box):  # type: ignore[no-untyped-def]
    """Return a box's lower and upper corner, given a pointer to six numbers."""
    return (box[0], box[1], box[2]), (box[3], box[4], box[5])


@inlined
def _clip_axis(slab, o, d, interval):  # type: ignore[no-untyped-def]
    """Clip an interval of a ray to the part between two planes perpendicular to an axis."""
    enters, leaves = interval
    inverse = 1 / (d if abs(d) >= _TINY else _TINY)
    lower = (slab[0] - o) * inverse
    upper = (slab[1] - o) * inverse
    return max(enters, min(lower, upper)), min(leaves, max(lower, upper))


@inlined
def intersects_box(corners, pad, reach, origin, direction):  # type: ignore[no-untyped-def]
    """Return whether a ray reaches a box, enlarged by `pad`, before the distance `reach`.

    The ray and the corners of the box are in the frame of the body, in meters.
    """
    (a, b, c), (d, e, f) = corners
    x, y, z = origin
    pad += 2e-6 * (abs(x) + abs(y) + abs(z))
    interval = _clip_axis((a - pad, d + pad), x, direction[0], (-np.inf, np.inf))
    interval = _clip_axis((b - pad, e + pad), y, direction[1], interval)
    enters, leaves = _clip_axis((c - pad, f + pad), z, direction[2], interval)
    return (enters <= leaves) & (leaves >= 0) & (enters * (1 - 1e-6) <= reach)


@inlined
def _bounding_sphere(corners, pose, pad):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Return a bounding sphere for a box at a pose: its center in the scene, and its radius.

    The sphere encloses the box with the margins of `intersects_box` for a ray that starts at the
    center of the sphere. `_find_rays_near_sphere` adds the part of the margin that grows with the
    distance.
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


@noinline
def _find_rays_near_sphere(rays, n, x, y, z, radius, near):  # type: ignore[no-untyped-def]
    """Write the indices of a cell's rays that intersect a sphere, and return their number.

    `rays` is the address of the first ray of the cell in a table (6, n). The output `near` is the
    address of int64 (`CELL_RAYS`,) and receives 0 or 1 for each ray. The center and the radius are
    in meters.
    """
    ray = float64s(rays)
    is_near = int64s(near)
    near_count = np.int64(0)
    for k in range(CELL_RAYS):
        u = x - ray[k]
        v = y - ray[n + k]
        w = z - ray[2 * n + k]
        dx = ray[3 * n + k]
        dy = ray[4 * n + k]
        dz = ray[5 * n + k]
        along = u * dx + v * dy + w * dz
        squared = u * u + v * v + w * w
        reach = radius + 8e-6 * (abs(u) + abs(v) + abs(w))
        outside = squared - reach * reach  # positive if the ray starts outside
        length = dx * dx + dy * dy + dz * dz
        is_near[k] = np.int64((outside <= 0) | ((along >= 0) & (outside * length <= along * along)))
        near_count += is_near[k]
    return near_count


@inlined
def _ray_intersects_box(rays, n, k, reach, pose, corners, pad):  # type: ignore[no-untyped-def]
    """Return whether ray `k` intersects a posed box. `rays` is the address of a table."""
    ray = float64s(rays)
    (px, py, pz), rotation = pose
    origin = to_body_axes(rotation, ray[k] - px, ray[n + k] - py, ray[2 * n + k] - pz)
    direction = to_body_axes(rotation, ray[3 * n + k], ray[4 * n + k], ray[5 * n + k])
    return intersects_box(corners, pad, reach, origin, direction)


@compiled(types.int64(_f64_2, _f64_1, _PAIRS, _f64_2, _f64_2, _i64_1, _i64_2))
def _pair_rays(rays, reaches, pairs, poses, boxes, near, ray_pairs):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Write the rays that intersect boxes to `ray_pairs`, and return how many columns were written.

    Each column contains the index of a ray and the index of a pair of a cell and a body. `near` is
    scratch memory for one cell. The other arguments are as in `rays_through_boxes`.
    """
    cell, pose_of_pair, shape, pads = pairs
    written = 0
    count = rays.shape[1]
    for pair in range(len(cell)):
        begin = cell[pair] * CELL_RAYS
        end = min((cell[pair] + 1) * CELL_RAYS, len(reaches))
        corners = box_corners(float64s(boxes.ctypes.data + 48 * shape[pair]))
        p = pose_of_pair[pair]
        first = min(begin, count - CELL_RAYS)
        pose = (poses[0, p], poses[1, p], poses[2, p]), pose_rotation(poses, p)
        ray = rays.ctypes.data + 8 * first
        (x, y, z), radius = _bounding_sphere(corners, pose, pads[pair])
        if not _find_rays_near_sphere(
            ray, count, x=x, y=y, z=z, radius=radius, near=near.ctypes.data
        ):
            continue
        for k in range(begin, end):
            if near[k - first] and _ray_intersects_box(
                ray, count, k - first, reach=reaches[k], pose=pose, corners=corners, pad=pads[pair]
            ):
                ray_pairs[0, written] = k
                ray_pairs[1, written] = pair
                written += 1
    return written


def rays_through_boxes(
    rays: Floats, reaches: Floats, pairs: CellBodyPairs, poses: Floats, boxes: Floats
) -> tuple[Indices, Indices]:
    """Find the rays in given cells that intersect the bounding boxes of given bodies.

    Parameters
    ----------
    rays
        float64 (6, n): origins in meters and directions.
    reaches
        float64 (n,): distance at which each ray ends, in meters.
    pairs
        Pairs of a cell and a body.
    poses
        float64 (12, p): positions in meters, and rotation matrices from the body frames, row by
        row.
    boxes
        float64 (s, 6): lower and upper corner of the box of each shape, in meters.

    Returns
    -------
    ray, pair
        int64 (k,): indices of rays and pairs, sorted by pair and then by ray.
    """
    cell = np.ascontiguousarray(pairs.cell)
    pairs = pairs._replace(cell=cell, shape=np.ascontiguousarray(pairs.shape))
    ray_pairs = np.empty((2, len(cell) * CELL_RAYS), np.int64)
    if len(reaches) < CELL_RAYS:  # The loop over a cell always processes `CELL_RAYS` rays.
        rays = np.concatenate([rays, np.zeros((6, CELL_RAYS - len(reaches)))], axis=1)
        # Padding rays end at NaN, so they do not intersect any box.
        reaches = np.concatenate([reaches, np.full(CELL_RAYS - len(reaches), np.nan)])
    near = np.empty(CELL_RAYS, np.int64)
    count = _pair_rays(rays, reaches, pairs, poses, boxes, near=near, ray_pairs=ray_pairs)
    return ray_pairs[0, :count], ray_pairs[1, :count]
