"""The tree built on the CUDA device: what build.cu's kernels do, in their order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import ploc
from .cuda_module import Kernels, options
from .layout import FLOOR, LEAF_SIZE, UNIT, Layout
from .mesh import LocalMesh
from .tree import PAD

BYTES = 400  # on the device a triangle, at the peak of a build, the finished tables included
_RADIUS = 8  # as in ploc.py: both builds give the same tree
_PAIRS = 32  # bits above which build.cu's sums hold the number of pairs


@dataclass(frozen=True)
class _Binary:
    """A binary tree on the device; see build.cu for what the arrays hold.

    Attributes
    ----------
    order, boxes, children
        As there.
    rounds
        Ranges of inner nodes that were made together.
    """

    order: Any
    boxes: Any
    children: Any
    rounds: tuple[tuple[int, int], ...]


def flags() -> tuple[str, ...]:
    """Compiler options of build.cu."""
    return options(RADIUS=_RADIUS, LEAF_SIZE=LEAF_SIZE, PAD=PAD, UNIT=UNIT, FLOOR=FLOOR)


def build(cupy: Any, device: int, mesh: LocalMesh) -> Layout:
    """Build the tables of a mesh on the current device: bit for bit those of `layout.lay_out`.

    Parameters
    ----------
    cupy
        CuPy, or what stands in for it.
    device
        Number of the current device.
    mesh
        At least one triangle.
    """
    kernels = Kernels(cupy, device, "build.cu", flags())
    corners = cupy.empty(mesh.corners.shape)
    corners.set(mesh.corners)
    tree = _cluster(cupy, kernels, corners, _order(cupy, kernels, corners))
    places = _places(cupy, kernels, tree)
    nodes, stack = _nodes(cupy, kernels, tree, places)
    n = len(corners)
    placed, records = cupy.empty((n, 9)), cupy.empty((n, 12), np.float32)
    faces = cupy.empty(n, np.int32)
    index = cupy.asarray(mesh.index)
    given = (corners, index, tree.order, places, np.int64(n))
    kernels.run("write_triangles", n, *given, placed, records, faces)
    points = corners.reshape(-1, 3)
    low, high = cupy.asnumpy(points.min(axis=0)), cupy.asnumpy(points.max(axis=0))
    frame = np.concatenate([mesh.centre, [mesh.scale], low - PAD, high + PAD])
    return Layout(nodes, records, placed, faces, cupy.asarray(frame), stack)


def _order(cp: Any, kernels: Kernels, corners: Any) -> Any:
    """Rows of the triangles along a Z-order curve, equals as they came."""
    n = len(corners)
    middles = cp.empty((3, n))
    kernels.run("find_middles", n, corners, np.int64(n), middles)
    start = [float(middles[axis].min()) for axis in range(3)]
    stop = [float(middles[axis].max()) for axis in range(3)]
    extent = max(b - a for a, b in zip(start, stop, strict=True)) or 1.0
    factor = (2**21 - 1) / extent  # GRID_BITS of build.cu
    codes = cp.empty(n, np.uint64)
    at = [np.float64(x) for x in (*start, factor)]
    kernels.run("encode", n, middles, np.int64(n), *at, codes)
    del middles
    return cp.argsort(codes, kind="stable").astype(np.int32)


def _cluster(cp: Any, kernels: Kernels, corners: Any, order: Any) -> _Binary:
    """Merge pairs of nearest neighbours until few clusters are left, and set a crown on them."""
    n = len(corners)
    boxes, children = cp.empty((2 * n - 1, 8), np.float32), cp.empty((n, 2), np.int32)
    ids, spare, partners = (cp.empty(n, np.int32) for _ in range(3))
    votes = cp.empty(n, np.int64)
    kernels.run("start_clusters", n, corners, order, np.int64(n), boxes, ids)
    rounds: list[tuple[int, int]] = []
    made, left = n, n
    while left > ploc.last(n):
        count = np.int32(left)
        kernels.run("find_partners", left, boxes, ids, count, partners)
        sums, pairs = _sums(cp, kernels, partners, votes, left)
        if 16 * pairs < left:  # long chains of ever better partners: do not merge one by one
            partners = cp.arange(n, dtype=np.int32) ^ np.int32(1)
            partners = cp.minimum(partners, np.int32(left - 1))
            sums, pairs = _sums(cp, kernels, partners, votes, left)
        made_now = (partners, sums, ids, count, np.int32(made), np.int32(n), boxes, children)
        kernels.run("merge", left, *made_now, spare)
        ids, spare = spare, ids
        rounds.append((made, made + pairs))
        made += pairs
        left -= pairs
    upper = _crown(cp, kernels, boxes, children, ids[:left], made)
    return _Binary(order, boxes, children, (*rounds, *upper))


def _crown(
    cp: Any, kernels: Kernels, boxes: Any, children: Any, ids: Any, made: int
) -> list[tuple[int, int]]:
    """Nodes above the last clusters, chosen on the host; returns their rounds."""
    # low x, y, z, cost, high x, y, z, and the number of triangles above the leaf's bit: taken as
    # bits, for as float32 such numbers are not normal and might be lost on the way
    bits = cp.asnumpy(boxes.view(np.int32)[ids])
    low, high = (np.ascontiguousarray(bits[:, k : k + 3].T).view(np.float32) for k in (0, 4))
    pairs, rounds = ploc.crown(low, high, bits[:, 7] >> 1, cp.asnumpy(ids), made)
    n = len(children)
    if len(pairs):
        # Not by `set`, which may read them when they are gone already (_sent of cuda_backend.py).
        children[made - n : made - n + len(pairs)] = cp.asarray(pairs)
    for start, stop in rounds:
        nodes = (np.int32(start), np.int32(stop - start), np.int32(n))
        kernels.run("join_children", stop - start, children, *nodes, boxes)
    return rounds


def _sums(cp: Any, kernels: Kernels, partners: Any, votes: Any, count: int) -> tuple[Any, int]:
    """Prefix sums of the clusters' votes, and the number of pairs among them."""
    kernels.run("vote", count, partners, np.int32(count), votes)
    sums = cp.cumsum(votes[:count])
    return sums, int(sums[-1]) >> _PAIRS


def _places(cp: Any, kernels: Kernels, tree: _Binary) -> Any:
    """Where each node's triangles begin when they are listed from left to right."""
    n = len(tree.order)
    places = cp.zeros(2 * n - 1, np.int32)
    for start, stop in reversed(tree.rounds):
        nodes = (np.int32(start), np.int32(stop - start), np.int32(n))
        kernels.run("place_children", stop - start, tree.boxes, tree.children, *nodes, places)
    return places


def _nodes(cp: Any, kernels: Kernels, tree: _Binary, places: Any) -> tuple[Any, int]:
    """Return the wide tree's nodes, and the most that wait on any way down."""
    n = len(tree.order)
    roots, waits = cp.empty(1, np.int32), cp.zeros(1, np.int32)
    roots.fill(2 * n - 2)
    levels: list[tuple[Any, Any, Any]] = []  # slots, inner nodes and their sums
    stack = 0
    while len(roots):
        m = len(roots)
        slots, inner = cp.empty((m, 4), np.int32), cp.empty(m, np.int32)
        level = (roots, np.int32(m), np.int32(n), slots, inner, waits)
        kernels.run("open_level", m, tree.boxes, tree.children, *level)
        ends = cp.cumsum(inner, dtype=np.int32)
        stack = max(stack, int(waits.max()))
        levels.append((slots, inner, ends))
        below = int(ends[-1])
        roots, next_waits = cp.empty(below, np.int32), cp.empty(below, np.int32)
        chosen = (slots, inner, ends, waits, np.int32(m))
        kernels.run("next_level", m, tree.boxes, *chosen, roots, next_waits)
        waits = next_waits
    nodes = cp.empty((sum(len(slots) for slots, _, _ in levels), 32), np.float32)
    start = 0
    for slots, inner, ends in levels:
        m = len(slots)
        level = (slots, inner, ends, np.int32(m), np.int32(start + m), nodes[start : start + m])
        kernels.run("write_nodes", m, tree.boxes, places, *level)
        start += m
    return nodes, stack
