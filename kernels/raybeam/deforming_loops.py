"""Compiled loops that cast rays at meshes whose vertices move (deforming.py)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from .arrays import Floats, Floats32, Ints, Ints32
from .cast_record import float32s, float64s
from .compiled import compiled, inlined, noinline
from .moving_loops import NEAREST_HITS, PAIRS, named_tuple_type, pose_rotation, to_body_axes
from .tree import LEAF_BITS
from .triangle_loops import intersect_plane, same_sign, shear_ray

WIDTH = 8  # children per node
_STACK = 512  # capacity of the stack, much more than any traversal of 2**28 triangles needs
_BOX = 4 * 6 * WIDTH  # bytes of the boxes of a node
_TINY = 1e-300


class DeformingTree(NamedTuple):
    """A deforming mesh, and a tree over its triangles with boxes for each pair of frames.

    Attributes
    ----------
    vertices
        float64 (f, v, 3): vertices at each frame, in meters. They move linearly between frames.
    faces
        int64 (t, 3): indices of the vertices of each triangle.
    order, child
        int32 (t,) and (m, `WIDTH`): triangles in leaf order, and children of each node, as in
        `tree.WideTree`. A child is the index of a node if it is positive, 0 if the slot is empty,
        or ``~(first << LEAF_BITS | count - 1)`` for a leaf with the triangles ``order[first : first
        + count]``.
    boxes
        float32 (f - 1, m, 6, `WIDTH`): boxes of the children of each node between consecutive
        frames: lower x, y, z, upper x, y, z, in meters.
    """

    vertices: Floats
    faces: Ints
    order: Ints32
    child: Ints32
    boxes: Floats32


_TREE = named_tuple_type(
    DeformingTree,
    types.float64[:, :, ::1],
    types.int64[:, ::1],
    types.int32[::1],
    types.int32[:, ::1],
    types.float32[:, :, :, ::1],
)


@compiled("void(f8[:, :, ::1], i8[:, ::1], i4[::1], i4[:, ::1], f8, f4[:, :, :, ::1])")
def fit_boxes(vertices, faces, order, child, pad, boxes):  # type: ignore[no-untyped-def]
    """Compute the boxes of all nodes of a `DeformingTree` between each frame and the next.

    The boxes are written to `boxes`. They extend beyond the triangles by `pad` meters.
    """
    for i in range(len(boxes)):
        # Children have higher indices than their parents.
        for node in range(len(child) - 1, -1, -1):
            for c in range(WIDTH):
                code = np.int64(child[node, c])
                first = ~code >> LEAF_BITS
                count = (~code & ((1 << LEAF_BITS) - 1)) + 1
                for axis in range(3):
                    lower = np.inf
                    upper = -np.inf
                    if code > 0:
                        for k in range(WIDTH):
                            lower = min(lower, np.float64(boxes[i, code, axis, k]))
                            upper = max(upper, np.float64(boxes[i, code, 3 + axis, k]))
                    elif code < 0:
                        for leaf_row in range(first, first + count):
                            for corner in range(3):
                                vertex = faces[order[leaf_row], corner]
                                start = vertices[i, vertex, axis]
                                stop = vertices[i + 1, vertex, axis]
                                lower = min(lower, min(start, stop) - pad)
                                upper = max(upper, max(start, stop) + pad)
                    boxes[i, node, axis, c] = lower
                    boxes[i, node, 3 + axis, c] = upper


@noinline
def _entry_distances(box, origin, inverse, reach, entry_distances):  # type: ignore[no-untyped-def]  # noqa: PLR0914 - a compiled loop
    """Compute the distances at which a ray enters a node's child boxes, or inf if it misses them.

    `box` is the address of the boxes, float32 (6, `WIDTH`), and `entry_distances` is the address of
    the output, float64 (`WIDTH`,). `inverse` contains the reciprocals of the direction's
    components. The ray ends at the distance `reach`.
    """
    x, y, z = origin
    u, v, w = inverse
    side = float32s(box)
    entries = float64s(entry_distances)
    for c in range(WIDTH):
        a = (side[c] - x) * u
        d = (side[3 * WIDTH + c] - x) * u
        b = (side[WIDTH + c] - y) * v
        e = (side[4 * WIDTH + c] - y) * v
        f = (side[2 * WIDTH + c] - z) * w
        g = (side[5 * WIDTH + c] - z) * w
        begin = max(max(min(a, d), min(b, e)), max(min(f, g), 0.0))
        stop = min(min(max(a, d), max(b, e)), min(max(f, g), reach))
        entries[c] = begin if begin <= stop else np.inf


@inlined
def _inverse(d):  # type: ignore[no-untyped-def]
    """Return the reciprocal of a direction component, or of a tiny number if it is 0."""
    return 1 / (d if abs(d) >= _TINY else _TINY)


@inlined
def _corner(vertices, frame, share, vertex, axis):  # type: ignore[no-untyped-def]
    """Interpolate a vertex between two frames. Its coordinate along `axis` is returned last.

    Coordinates are in meters. `share` is the fraction of the time from `frame` to the next frame,
    between 0 and 1.
    """
    x = axis + 1 if axis < 2 else 0
    y = x + 1 if x < 2 else 0
    remainder = 1 - share
    return (
        remainder * vertices[frame, vertex, x] + share * vertices[frame + 1, vertex, x],
        remainder * vertices[frame, vertex, y] + share * vertices[frame + 1, vertex, y],
        remainder * vertices[frame, vertex, axis] + share * vertices[frame + 1, vertex, axis],
    )


@compiled(types.void(PAIRS, _TREE, NEAREST_HITS))
def cast_pairs(pairs, tree, nearest):  # type: ignore[no-untyped-def]  # noqa: C901, PLR0914, PLR0915 - a compiled loop
    """Cast rays at deforming bodies, and record closer hits in `nearest`.

    Each ray hits the mesh in the shape that the mesh has at the frame number `RayBodyPairs.frame`.
    Nodes are visited from near to far. `stack_distances` contains the entry distances of the nodes
    on the stack.
    """
    rays = pairs.rays
    poses = pairs.poses
    body = pairs.body
    vertices, faces, order, child, boxes = tree
    distance, bodies, instance, triangle = nearest
    stack = np.empty(_STACK, np.int64)
    stack_distances = np.empty(_STACK)
    child_distances = np.empty(WIDTH)
    t_min, t_max = pairs.limits
    last = np.int64(len(vertices) - 2)
    for n in range(len(body)):
        k = pairs.row[n]
        p = pairs.pose[n]
        rotation = pose_rotation(poses, p)
        x = rays[0, k] - poses[0, p]
        y = rays[1, k] - poses[1, p]
        z = rays[2, k] - poses[2, p]
        x, y, z = to_body_axes(rotation, x, y, z)
        u, v, w = to_body_axes(rotation, rays[3, k], rays[4, k], rays[5, k])
        origin = x, y, z
        inverse = _inverse(u), _inverse(v), _inverse(w)
        axis, a, b, c, d, e, f = shear_ray(x, y, z, u, v, w)
        sheared_ray = a, b, c, d, e, f
        frame = np.int64(max(pairs.frame[n], 0.0))
        frame = frame if frame < last else last
        fraction = min(max(pairs.frame[n] - frame, 0.0), 1.0)
        frame_boxes = boxes.ctypes.data + _BOX * len(child) * frame
        best = min(distance[k], t_max)
        hit_triangle = np.int64(-1)
        top = 1
        stack[0] = 0
        stack_distances[0] = 0.0
        while top:
            top -= 1
            node = stack[top]
            if stack_distances[top] > best:
                continue
            _entry_distances(
                frame_boxes + _BOX * node, origin, inverse, best, child_distances.ctypes.data
            )
            bottom = top
            for slot in range(WIDTH):
                code = np.int64(child[node, slot])
                distance_to_child = child_distances[slot]
                if code == 0 or distance_to_child > best:
                    continue
                if code > 0:  # Insert the node so that the nearest one is on top.
                    position = top
                    while position > bottom and stack_distances[position - 1] < distance_to_child:
                        stack[position] = stack[position - 1]
                        stack_distances[position] = stack_distances[position - 1]
                        position -= 1
                    stack[position] = code
                    stack_distances[position] = distance_to_child
                    top += 1
                    continue
                first = ~code >> LEAF_BITS
                for leaf_row in range(first, first + (~code & ((1 << LEAF_BITS) - 1)) + 1):
                    face = np.int64(order[leaf_row])
                    corners = (
                        _corner(vertices, frame, fraction, faces[face, 0], axis),
                        _corner(vertices, frame, fraction, faces[face, 1], axis),
                        _corner(vertices, frame, fraction, faces[face, 2], axis),
                    )
                    a, b, c, det, t = intersect_plane(corners, sheared_ray)
                    if det == 0 or not same_sign(a, b, c) or not t_min <= t <= best:
                        continue
                    if t < best or hit_triangle < 0 or face < hit_triangle:
                        best = t
                        hit_triangle = face
        if hit_triangle >= 0 and (
            best < distance[k] or (best == distance[k] and body[n] < bodies[k])
        ):
            distance[k] = best
            bodies[k] = body[n]
            instance[k] = 0
            triangle[k] = hit_triangle
