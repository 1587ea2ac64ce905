"""Loops of deforming.py, which cast rays on meshes whose vertices move."""

from __future__ import annotations

import numpy as np

from .compiled import compiled, inlined, stage
from .embree_memory import float32s, float64s
from .moving_loops import taken, turn_of
from .tree import LEAF_BITS
from .triangle_loops import areas, shear, within

WIDTH = 8  # children of a node
_STACK = 512  # nodes that wait: far more than a tree of 2**28 triangles has on one way down
_BOX = 4 * 6 * WIDTH  # bytes of the boxes of a node
_TINY = 1e-300


@compiled("void(f8[:, :, ::1], i8[:, ::1], i4[::1], i4[:, ::1], f8, f4[:, :, :, ::1])")
def fit(vertices, faces, order, child, pad, boxes):  # type: ignore[no-untyped-def]
    """Write the boxes of all nodes between frames: low x, y, z, high x, y, z of each child."""
    for i in range(len(boxes)):
        for node in range(len(child) - 1, -1, -1):  # children come after their parents
            for c in range(WIDTH):
                code = np.int64(child[node, c])
                first = ~code >> LEAF_BITS
                count = (~code & ((1 << LEAF_BITS) - 1)) + 1
                for axis in range(3):
                    low = np.inf
                    high = -np.inf
                    if code > 0:
                        for k in range(WIDTH):
                            low = min(low, np.float64(boxes[i, code, axis, k]))
                            high = max(high, np.float64(boxes[i, code, 3 + axis, k]))
                    elif code < 0:
                        for place in range(first, first + count):
                            for corner in range(3):
                                vertex = faces[order[place], corner]
                                one = vertices[i, vertex, axis]
                                two = vertices[i + 1, vertex, axis]
                                low = min(low, min(one, two) - pad)
                                high = max(high, max(one, two) + pad)
                    boxes[i, node, axis, c] = low
                    boxes[i, node, 3 + axis, c] = high


@stage
def _enter(box, x, y, z, u, v, w, end, enters):  # type: ignore[no-untyped-def]
    """Write where a ray enters the boxes of a node, inf if after it leaves them or ends.

    `box` and `enters` are addresses; u, v, w are the inverse of the ray's direction.
    """
    side = float32s(box)
    out = float64s(enters)
    for c in range(WIDTH):
        a = (side[c] - x) * u
        d = (side[3 * WIDTH + c] - x) * u
        b = (side[WIDTH + c] - y) * v
        e = (side[4 * WIDTH + c] - y) * v
        f = (side[2 * WIDTH + c] - z) * w
        g = (side[5 * WIDTH + c] - z) * w
        begin = max(max(min(a, d), min(b, e)), max(min(f, g), 0.0))
        stop = min(min(max(a, d), max(b, e)), min(max(f, g), end))
        out[c] = begin if begin <= stop else np.inf


@inlined
def _inverse(d):  # type: ignore[no-untyped-def]
    return 1 / (d if abs(d) >= _TINY else _TINY)


@inlined
def _corner(vertices, frame, share, vertex, axis):  # type: ignore[no-untyped-def]
    """Corner at a share of the way to the next frame, with the axis last."""
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    rest = 1 - share
    return (
        rest * vertices[frame, vertex, x] + share * vertices[frame + 1, vertex, x],
        rest * vertices[frame, vertex, y] + share * vertices[frame + 1, vertex, y],
        rest * vertices[frame, vertex, axis] + share * vertices[frame + 1, vertex, axis],
    )


@compiled(
    "void(f8[:, ::1], i8[::1], i8[::1], i8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, :, ::1], "
    "i8[:, ::1], i4[::1], i4[:, ::1], f4[:, :, :, ::1], f8[::1], i8[::1], i4[::1], i4[::1])"
)
def strike(  # type: ignore[no-untyped-def]
    rays, row, body, number, poses, frames, limits, vertices, faces, order, child, boxes,
    distance, bodies, instance, triangle,
):  # fmt: skip
    """Cast the rays of a `Crossing` on a mesh that deforms, and note in a `Nearest` what they hit.

    The tree is one of tree.py, whose `boxes` are those of `fit`.
    """
    stack = np.empty(_STACK, np.int64)
    waits = np.empty(_STACK)
    enters = np.empty(WIDTH)
    t_min = limits[0]
    t_max = limits[1]
    last = np.int64(len(vertices) - 2)
    for n in range(len(row)):
        k = row[n]
        p = number[n]
        turn = turn_of(poses, p)
        x = rays[0, k] - poses[0, p]
        y = rays[1, k] - poses[1, p]
        z = rays[2, k] - poses[2, p]
        x, y, z = taken(turn, x, y, z)
        u, v, w = taken(turn, rays[3, k], rays[4, k], rays[5, k])
        i = _inverse(u)
        j = _inverse(v)
        h = _inverse(w)
        axis, a, b, c, d, e, f = shear(x, y, z, u, v, w)
        ray = a, b, c, d, e, f
        frame = np.int64(max(frames[n], 0.0))
        frame = frame if frame < last else last
        share = min(max(frames[n] - frame, 0.0), 1.0)
        at = boxes.ctypes.data + _BOX * len(child) * frame
        best = min(distance[k], t_max)
        found = np.int64(-1)
        top = 1
        stack[0] = 0
        waits[0] = 0.0
        while top:
            top -= 1
            node = stack[top]
            if waits[top] > best:
                continue
            _enter(at + _BOX * node, x, y, z, i, j, h, best, enters.ctypes.data)
            below = top
            for slot in range(WIDTH):
                code = np.int64(child[node, slot])
                enter = enters[slot]
                if code == 0 or enter > best:
                    continue
                if code > 0:  # the nearest comes last
                    place = top
                    while place > below and waits[place - 1] < enter:
                        stack[place] = stack[place - 1]
                        waits[place] = waits[place - 1]
                        place -= 1
                    stack[place] = code
                    waits[place] = enter
                    top += 1
                    continue
                first = ~code >> LEAF_BITS
                for place in range(first, first + (~code & ((1 << LEAF_BITS) - 1)) + 1):
                    own = np.int64(order[place])
                    corners = (
                        _corner(vertices, frame, share, faces[own, 0], axis),
                        _corner(vertices, frame, share, faces[own, 1], axis),
                        _corner(vertices, frame, share, faces[own, 2], axis),
                    )
                    a, b, c, det, t = areas(corners, ray)
                    if det == 0 or not within(a, b, c) or not t_min <= t <= best:
                        continue
                    if t < best or found < 0 or own < found:
                        best = t
                        found = own
        if found >= 0 and (best < distance[k] or (best == distance[k] and body[n] < bodies[k])):
            distance[k] = best
            bodies[k] = body[n]
            instance[k] = 0
            triangle[k] = found
