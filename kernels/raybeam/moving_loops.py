"""Loops of moving.py, which compare rays with bodies."""

from __future__ import annotations

import numpy as np

from .arrays import Floats, Indices, Ints
from .compiled import compiled, inlined, stage
from .embree_memory import float64s, int64s

# rays, and cells of a wide one
CELL = 64
WIDE = 16
PADS_M = 1e-3  # around a box, and 2e-6 of how far away it is: far more than rounding
# Columns of cells: axis and half angle of the cone, ball around the origins, first and last time,
# normal of the plane that the rays lie near, and the sine of the greatest angle to it.
AXIS = 0
COSINE = 3
SINE = 4
MIDDLE = 5
SPREAD = 8
BEGIN = 9
END = 10
NORMAL = 11
OFF = 14
_TINY = 1e-300


@compiled("f8[:, ::1](f8[:, ::1], f8[::1], i8)")
def cells_of(rays, times, size):  # type: ignore[no-untyped-def]
    """Cells of so many rays (6, n) at times (n,): (c, 15)."""
    count = -(-len(times) // size)
    out = np.empty((count, 15))
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
        far = 0.0
        off = 0.0
        for k in range(begin, end):
            side = nx * rays[3, k] + ny * rays[4, k] + nz * rays[5, k]
            off = max(off, abs(side))
            along = ax * rays[3, k] + ay * rays[4, k] + az * rays[5, k]
            cosine = min(cosine, along)
            x = rays[0, k] - px
            y = rays[1, k] - py
            z = rays[2, k] - pz
            far = max(far, x * x + y * y + z * z)
        cosine = max(cosine, -1.0)
        out[c, 0] = ax
        out[c, 1] = ay
        out[c, 2] = az
        out[c, 3] = cosine
        out[c, 4] = np.sqrt(1 - cosine * cosine)
        out[c, 5] = px
        out[c, 6] = py
        out[c, 7] = pz
        out[c, 8] = np.sqrt(far)
        out[c, 9] = first
        out[c, 10] = last
        out[c, 11] = nx
        out[c, 12] = ny
        out[c, 13] = nz
        out[c, 14] = off
    return out


@inlined
def _may_meet(cell, look, size, reach):  # type: ignore[no-untyped-def]
    """Whether rays of a cell may meet a body."""
    radius = size[0]
    slack = size[1]
    first = size[2]
    last = size[3]
    x = look[0] - cell[5]
    y = look[1] - cell[6]
    z = look[2] - cell[7]
    nx = cell[11]
    ny = cell[12]
    nz = cell[13]
    off = abs(x * nx + y * ny + z * nz)
    wide = abs(x) + abs(y) + abs(z)
    most = radius + slack + cell[8] + 1e-6 * wide
    if off > most + (wide + most) * cell[14]:  # which needs no root
        return False
    far = np.sqrt(x * x + y * y + z * z)
    more = slack + cell[8] + 1e-6 * far
    size = radius + more
    if far - size > reach or cell[10] < first or cell[9] > last:
        return False
    side = 0.0
    for k in range(3, 12, 3):
        side += abs(look[k] * nx + look[k + 1] * ny + look[k + 2] * nz)
    if off - (far + size) * cell[14] > side + more:
        return False
    if far > size:
        sine = size / far
        cosine = np.sqrt(1 - sine * sine)
        if cell[4] * cosine + cell[3] * sine >= 0:  # within a half turn
            edge = far * (cell[3] * cosine - cell[4] * sine)
            return x * cell[0] + y * cell[1] + z * cell[2] >= edge - 1e-6 * far
    return True


# Loops write to arrays that are long enough: numba takes 8 s to compile slices and copies.
@compiled("i8(f8[:, ::1], f8[:, ::1], i8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8, i8[:, ::1])")
def _meet(wide, cells, number, looks, sizes, reach, out):  # type: ignore[no-untyped-def]
    found = 0
    # Pointers: views of arrays would be counted, which takes longer than the comparisons.
    cell = cells.ctypes.data
    broad = wide.ctypes.data
    look = looks.ctypes.data
    for b in range(len(sizes)):
        size = float64s(sizes.ctypes.data + 32 * b)
        own = look + 96 * looks.shape[1] * b
        for w in range(len(wide)):
            begin = w * WIDE
            end = min((w + 1) * WIDE, len(cells))
            first = number[begin, 0]
            if number[end - 1, 1] - first <= 1:  # which sizes allow for
                at = float64s(own + 96 * first)
                if not _may_meet(float64s(broad + 120 * w), at, size, reach):
                    continue
            for c in range(begin, end):
                first = number[c, 0]
                if number[c, 1] - first <= 1:
                    at = float64s(own + 96 * first)
                    if not _may_meet(float64s(cell + 120 * c), at, size, reach):
                        continue
                out[0, found] = c
                out[1, found] = b
                found += 1
    return found


def meet(
    wide: Floats, cells: Floats, number: Ints, looks: Floats, sizes: Floats, reach: float
) -> tuple[Indices, Indices]:
    """Cells whose rays may meet bodies, and these; by body, then by cell.

    Parameters
    ----------
    wide, cells
        Cells `WIDE` times as wide, of which many need no closer look, and cells.
    number
        int64 (c, 2): looks at the bodies when a cell begins and ends.
    looks
        (b, looks, 12): middles of the bodies' boxes, and halves of their sides as vectors.
    sizes
        (b, 4): radii of the balls around them, how much a look may be wrong, first and last time
        when they are there.
    reach
        Rays end before.
    """
    pairs = np.empty((2, len(cells) * len(sizes)), np.int64)
    found = _meet(wide, cells, number, looks, sizes, reach, pairs)
    return pairs[0, :found], pairs[1, :found]


@inlined
def turn_of(poses, p):  # type: ignore[no-untyped-def]
    """Rotation of a pose, by rows."""
    return (
        (poses[3, p], poses[4, p], poses[5, p]),
        (poses[6, p], poses[7, p], poses[8, p]),
        (poses[9, p], poses[10, p], poses[11, p]),
    )


@inlined
def taken(turn, x, y, z):  # type: ignore[no-untyped-def]
    """Take a vector to the axes of a pose."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    return (x * a + y * d) + z * g, (x * b + y * e) + z * h, (x * c + y * f) + z * i


@inlined
def sides_of(box):  # type: ignore[no-untyped-def]
    """Low and high corner of a box at a pointer."""
    return (box[0], box[1], box[2]), (box[3], box[4], box[5])


@inlined
def _between(low, high, o, d, enters, leaves):  # type: ignore[no-untyped-def]
    inverse = 1 / (d if abs(d) >= _TINY else _TINY)
    low = (low - o) * inverse
    high = (high - o) * inverse
    return max(enters, min(low, high)), min(leaves, max(low, high))


@inlined
def passes(sides, pad, end, x, y, z, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Whether a ray passes through a box before its end."""
    (a, b, c), (d, e, f) = sides
    pad += 2e-6 * (abs(x) + abs(y) + abs(z))
    enters, leaves = _between(a - pad, d + pad, x, dx, -np.inf, np.inf)
    enters, leaves = _between(b - pad, e + pad, y, dy, enters, leaves)
    enters, leaves = _between(c - pad, f + pad, z, dz, enters, leaves)
    return (enters <= leaves) & (leaves >= 0) & (enters * (1 - 1e-6) <= end)


@stage
def _passing(rays, n, ends, place, turn, sides, pad, out):  # type: ignore[no-untyped-def]
    """Write whether the rays of a cell pass through a box at a place.

    `rays` is their address in (6, n), `ends` and `out` are those of float64 and int64 (`CELL`,).
    """
    ray = float64s(rays)
    end = float64s(ends)
    found = int64s(out)
    px, py, pz = place
    for k in range(CELL):
        x, y, z = taken(turn, ray[k] - px, ray[n + k] - py, ray[2 * n + k] - pz)
        u, v, w = taken(turn, ray[3 * n + k], ray[4 * n + k], ray[5 * n + k])
        found[k] = np.int64(passes(sides, pad, end[k], x, y, z, u, v, w))


@compiled(
    "i8(f8[:, ::1], f8[::1], i8[::1], i8[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[::1], i8[::1], "
    "i8[:, ::1])"
)
def _through(rays, ends, cell, number, poses, boxes, shape, pads, passed, out):  # type: ignore[no-untyped-def]
    found = 0
    count = rays.shape[1]
    for pair in range(len(cell)):
        begin = cell[pair] * CELL
        end = min((cell[pair] + 1) * CELL, len(ends))
        sides = sides_of(float64s(boxes.ctypes.data + 48 * shape[pair]))
        pose = number[pair]
        first = min(begin, count - CELL)
        place = (poses[0, pose], poses[1, pose], poses[2, pose])
        turn = turn_of(poses, pose)
        ray = rays.ctypes.data + 8 * first
        own = ends.ctypes.data + 8 * first
        _passing(ray, count, own, place, turn, sides, pads[pair], passed.ctypes.data)
        for k in range(begin, end):
            out[0, found] = k
            out[1, found] = pair
            found += passed[k - first]
    return found


def through(
    rays: Floats, ends: Floats, cell: Indices, number: Ints, poses: Floats, boxes: Floats,
    shape: Ints, pads: Floats,
) -> tuple[Indices, Indices]:  # fmt: skip
    """Rays of cells (m,) that pass through boxes, and their numbers of cell and box.

    Boxes (s, 6), `shape` of which (m,), have the poses (12, p) of a `number` (m,) and are larger by
    `pads` (m,); rays (6, n) end at `ends`.
    """
    cell = np.ascontiguousarray(cell)
    shape = np.ascontiguousarray(shape)
    pairs = np.empty((2, len(cell) * CELL), np.int64)
    if len(ends) < CELL:  # the loop over a cell has a constant length
        rays = np.concatenate([rays, np.zeros((6, CELL - len(ends)))], axis=1)
        ends = np.concatenate([ends, np.full(CELL - len(ends), np.nan)])  # nothing is before
    passed = np.empty(CELL, np.int64)
    found = _through(rays, ends, cell, number, poses, boxes, shape, pads, passed, pairs)
    return pairs[0, :found], pairs[1, :found]
