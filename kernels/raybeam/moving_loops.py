"""Loops of moving.py, which compare rays with bodies."""

from __future__ import annotations

import numpy as np

from .arrays import Floats, Indices, Ints
from .compiled import compiled, inlined

CELL = 64
PADS_M = 1e-3  # around a box, and 2e-6 of how far away it is: far more than rounding
# Columns of cells: axis and half angle of the cone, ball around the origins, first and last time,
# normal of the plane that the rays lie near, and the sine of the greatest angle to it.
AXIS, COSINE, SINE, MIDDLE, SPREAD, BEGIN, END, NORMAL, OFF = 0, 3, 4, 5, 8, 9, 10, 11, 14
_TINY = 1e-300


@compiled("f8[:, ::1](f8[:, ::1], f8[:, ::1], f8[::1])")
def cells_of(origins, directions, times):  # type: ignore[no-untyped-def]
    """Cells of rays (3, n) at times (n,): (c, 15)."""
    count = -(-len(times) // CELL)
    out = np.empty((count, 15))
    for c in range(count):
        begin, end = c * CELL, min((c + 1) * CELL, len(times))
        ax = ay = az = px = py = pz = 0.0
        first = last = times[begin]
        for k in range(begin, end):
            ax, ay, az = ax + directions[0, k], ay + directions[1, k], az + directions[2, k]
            px, py, pz = px + origins[0, k], py + origins[1, k], pz + origins[2, k]
            first, last = min(first, times[k]), max(last, times[k])
        length = max(np.sqrt(ax * ax + ay * ay + az * az), _TINY)
        ax, ay, az = ax / length, ay / length, az / length
        n = end - begin
        px, py, pz = px / n, py / n, pz / n
        x, y, z = directions[0, begin], directions[1, begin], directions[2, begin]
        dx, dy, dz = directions[0, end - 1], directions[1, end - 1], directions[2, end - 1]
        nx, ny, nz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), _TINY)
        nx, ny, nz = nx / length, ny / length, nz / length
        cosine, far, off = 1.0, 0.0, 0.0
        for k in range(begin, end):
            side = nx * directions[0, k] + ny * directions[1, k] + nz * directions[2, k]
            off = max(off, abs(side))
            along = ax * directions[0, k] + ay * directions[1, k] + az * directions[2, k]
            cosine = min(cosine, along)
            x, y, z = origins[0, k] - px, origins[1, k] - py, origins[2, k] - pz
            far = max(far, x * x + y * y + z * z)
        cosine = max(cosine, -1.0)
        out[c, 0], out[c, 1], out[c, 2] = ax, ay, az
        out[c, 3], out[c, 4] = cosine, np.sqrt(1 - cosine * cosine)
        out[c, 5], out[c, 6], out[c, 7], out[c, 8] = px, py, pz, np.sqrt(far)
        out[c, 9], out[c, 10] = first, last
        out[c, 11], out[c, 12], out[c, 13], out[c, 14] = nx, ny, nz, off
    return out


@inlined
def _larger(table, rows):  # type: ignore[no-untyped-def]
    more = np.empty((2 * len(table), 2), np.int64)
    more[:rows] = table[:rows]
    return more


@compiled("i8[:, ::1](f8[:, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8)")
def _meet(cells, number, looks, sizes, reach):  # type: ignore[no-untyped-def]
    out, found = np.empty((1024, 2), np.int64), 0
    for b in range(len(sizes)):
        radius, slack, first, last = sizes[b, 0], sizes[b, 1], sizes[b, 2], sizes[b, 3]
        for c in range(len(cells)):
            cell, look = cells[c], looks[b, number[c]]
            x, y, z = look[0] - cell[5], look[1] - cell[6], look[2] - cell[7]
            nx, ny, nz = cell[11], cell[12], cell[13]
            off, wide = abs(x * nx + y * ny + z * nz), abs(x) + abs(y) + abs(z)
            most = radius + slack + cell[8] + 1e-6 * wide
            if off > most + (wide + most) * cell[14]:  # which needs no root
                continue
            far = np.sqrt(x * x + y * y + z * z)
            more = slack + cell[8] + 1e-6 * far
            size = radius + more
            if far - size > reach or cell[10] < first or cell[9] > last:
                continue
            side = 0.0
            for k in range(3, 12, 3):
                side += abs(look[k] * nx + look[k + 1] * ny + look[k + 2] * nz)
            if off - (far + size) * cell[14] > side + more:
                continue
            if far > size:
                sine = size / far
                cosine = np.sqrt(1 - sine * sine)
                if cell[4] * cosine + cell[3] * sine >= 0:  # within a half turn
                    edge = far * (cell[3] * cosine - cell[4] * sine)
                    if x * cell[0] + y * cell[1] + z * cell[2] < edge - 1e-6 * far:
                        continue
            if found == len(out):
                out = _larger(out, found)
            out[found, 0], out[found, 1] = c, b
            found += 1
    return out[:found].copy()


def meet(
    cells: Floats, number: Ints, looks: Floats, sizes: Floats, reach: float
) -> tuple[Indices, Indices]:
    """Cells whose rays may meet bodies, and these; by body, then by cell.

    Parameters
    ----------
    number
        int64 (c,): look at the bodies that a cell takes.
    looks
        (b, looks, 12): middles of the bodies' boxes, and halves of their sides as vectors.
    sizes
        (b, 4): radii of the balls around them, how much a look may be wrong, first and last time
        when they are there.
    reach
        Rays end before.
    """
    pairs = _meet(cells, number, looks, sizes, reach)
    return pairs[:, 0], pairs[:, 1]


@inlined
def _taken(p, x, y, z, axis):  # type: ignore[no-untyped-def]
    """One number of a vector in the axes of a pose."""
    return (x * p[3 + axis] + y * p[6 + axis]) + z * p[9 + axis]


@inlined
def _passes(box, pad, end, x, y, z, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Whether a ray passes through a box before its end."""
    enters, leaves = -np.inf, np.inf
    pad += 2e-6 * (abs(x) + abs(y) + abs(z))
    for axis in range(3):
        o, d = (x, dx) if axis == 0 else ((y, dy) if axis == 1 else (z, dz))
        if abs(d) < _TINY:
            d = _TINY
        low, high = (box[axis] - pad - o) / d, (box[3 + axis] + pad - o) / d
        enters, leaves = max(enters, min(low, high)), min(leaves, max(low, high))
    return enters <= leaves and leaves >= 0 and enters * (1 - 1e-6) <= end


@compiled("i8[:, ::1](f8[:, ::1], f8[:, ::1], f8[::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[::1])")
def _through(origins, directions, ends, cell, poses, boxes, pads):  # type: ignore[no-untyped-def]
    out, found = np.empty((4096, 2), np.int64), 0
    near = np.empty(CELL, np.bool_)
    for pair in range(len(cell)):
        begin, end = cell[pair] * CELL, min((cell[pair] + 1) * CELL, directions.shape[1])
        p, box, pad = poses[pair], boxes[pair], pads[pair]
        # A ball around the box first.
        x, y, z = (box[0] + box[3]) / 2, (box[1] + box[4]) / 2, (box[2] + box[5]) / 2
        ball = (box[3] - x + pad) ** 2 + (box[4] - y + pad) ** 2 + (box[5] - z + pad) ** 2
        mx = p[0] + (p[3] * x + p[4] * y + p[5] * z)
        my = p[1] + (p[6] * x + p[7] * y + p[8] * z)
        mz = p[2] + (p[9] * x + p[10] * y + p[11] * z)
        for k in range(begin, end):
            x, y, z = mx - origins[0, k], my - origins[1, k], mz - origins[2, k]
            far = x * x + y * y + z * z
            along = x * directions[0, k] + y * directions[1, k] + z * directions[2, k]
            near[k - begin] = far - along * along <= ball * (1 + 1e-6) + 1e-5 * far
        if found + CELL > len(out):
            out = _larger(out, found)
        for k in range(begin, end):
            if not near[k - begin]:
                continue
            ox, oy, oz = origins[0, k] - p[0], origins[1, k] - p[1], origins[2, k] - p[2]
            dx, dy, dz = directions[0, k], directions[1, k], directions[2, k]
            x, y, z = _taken(p, ox, oy, oz, 0), _taken(p, ox, oy, oz, 1), _taken(p, ox, oy, oz, 2)
            u, v, w = _taken(p, dx, dy, dz, 0), _taken(p, dx, dy, dz, 1), _taken(p, dx, dy, dz, 2)
            if _passes(box, pad, ends[k], x, y, z, u, v, w):
                out[found, 0], out[found, 1] = k, pair
                found += 1
    return out[:found].copy()


def through(
    origins: Floats, directions: Floats, ends: Floats, cell: Indices, poses: Floats,
    boxes: Floats, pads: Floats,
) -> tuple[Indices, Indices]:  # fmt: skip
    """Rays of cells that pass through boxes, and their numbers of cell and box.

    Boxes (m, 6) have poses (m, 12) and are larger by `pads`; rays (3, n) end at `ends`.
    """
    pairs = _through(origins, directions, ends, np.ascontiguousarray(cell), poses, boxes, pads)
    return pairs[:, 0], pairs[:, 1]


@compiled(
    "i8(f8[:, ::1], f8[:, ::1], f8[::1], i8[::1], f8[:, ::1], i8[::1], f8[:, ::1], i8[::1], f8, "
    "i8[::1], f8[:, ::1], f8[:, ::1])"
)
def _local(  # type: ignore[no-untyped-def]
    origins, directions, ends, row, poses, number, boxes, pair, pad, kept, starts, ways
):
    found = 0
    for n in range(len(row)):
        k, p = row[n], poses[number[n]]
        ox, oy, oz = origins[0, k] - p[0], origins[1, k] - p[1], origins[2, k] - p[2]
        dx, dy, dz = directions[0, k], directions[1, k], directions[2, k]
        x, y, z = _taken(p, ox, oy, oz, 0), _taken(p, ox, oy, oz, 1), _taken(p, ox, oy, oz, 2)
        u, v, w = _taken(p, dx, dy, dz, 0), _taken(p, dx, dy, dz, 1), _taken(p, dx, dy, dz, 2)
        if _passes(boxes[pair[n]], pad, ends[k], x, y, z, u, v, w):
            kept[found] = n
            starts[found, 0], starts[found, 1], starts[found, 2] = x, y, z
            ways[found, 0], ways[found, 1], ways[found, 2] = u, v, w
            found += 1
    return found


def local(
    origins: Floats, directions: Floats, ends: Floats, row: Indices, poses: Floats,
    number: Indices, boxes: Floats, pair: Indices,
) -> tuple[Indices, Floats, Floats]:  # fmt: skip
    """Take rays `row` (n,) to the axes of poses `number`, to boxes `pair`, (n,) each.

    Returns the numbers of those that pass through the boxes (k,), and their origins and
    directions (k, 3).
    """
    row, number, pair = map(np.ascontiguousarray, (row, number, pair))
    kept, (starts, ways) = np.empty(len(row), np.int64), np.empty((2, len(row), 3))
    given = origins, directions, ends, row, poses, number, boxes, pair, PADS_M
    found = _local(*given, kept, starts, ways)
    return kept[:found], starts[:found], ways[:found]


@compiled("i8[::1](i8[::1], f8[::1], i8[::1], i8)")
def _nearest(row, distance, body, count):  # type: ignore[no-untyped-def]
    best, found = np.full(count, -1), 0
    for n in range(len(row)):
        at = best[row[n]]
        found += at < 0
        if at < 0 or (distance[n], body[n]) < (distance[at], body[at]):
            best[row[n]] = n
    out, k = np.empty(found, np.int64), 0
    for at in best:
        if at >= 0:
            out[k] = at
            k += 1
    return out


def nearest(row: Ints, distance: Floats, body: Ints, count: int) -> Indices:
    """Hits that are the nearest of their rays, in ray order; of equal ones the first body's."""
    found: Indices = _nearest(*map(np.ascontiguousarray, (row, distance, body)), count)
    return found
