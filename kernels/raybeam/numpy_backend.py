"""Ray casting in NumPy: the reference, which runs wherever Python does.

Many rays traverse a wide tree together. The unit of work is a pair of a ray and a node. A block of
pairs is tested against the children's boxes in float32; pairs of a ray and an inner child make new
blocks, pairs with a leaf are tested against its triangles. Blocks are processed last in, first out;
in a block that is too large, the pairs nearest to their rays' starts go first. So memory is bounded
for any scene, and early hits discard later pairs behind them. Ordering the children of every node
would test a sixth fewer boxes, but in many small blocks, which takes twice as long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from . import triangle as exact
from .backend import Backend, Found
from .mesh import TINY, LocalMesh
from .rays import Rays
from .tree import LEAF_BITS, PAD, build_tree

Float = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.intp]

_WIDTH = 8
_LEAF_SIZE = 4
_BLOCK = 1 << 15  # pairs: a step's arrays take about 6 MiB; smaller ones need more calls
_ACROSS = 4.0  # local units: more than the diagonal of any scene
_SLACK = 2.0**-20  # margin of distance limits in float32: far more than their rounding


@dataclass
class _Best:
    """Closest hits so far: local distance, row of `faces`, weights; one entry a ray."""

    t: Float
    triangle: NDArray[np.int32]
    u: Float
    v: Float


@dataclass(frozen=True)
class _Bundle:
    """Rays ready for traversal, in local coordinates.

    Attributes
    ----------
    entry
        float64 (n,): where the ray enters the scene's box, 0 if it starts inside. The float32
        part starts there, so that its rounding errors do not grow with the distance to the
        scene.
    scaled_origin, inverse
        float32 (3, n): ``origin / direction`` and ``1 / direction``.
    near
        intp (3, n): 1 where the ray meets the upper plane of a box first, else 0.
    limit
        float32 (n,): hits farther than this from `entry` do not count; shrinks.
    sheared
        The rays for the exact test.
    """

    entry: Float
    scaled_origin: Single
    inverse: Single
    near: Index
    limit: Single
    sheared: exact.ShearedRays


@dataclass(frozen=True)
class _Pairs:
    """Rays that are to visit nodes, and where each enters the node's box; (m,) each."""

    ray: Index
    node: Index
    enter: Single

    def only(self, rows: Index) -> _Pairs:
        """Select pairs; as many rows as there are pairs select all of them."""
        if len(rows) == len(self.ray):
            return self
        return _Pairs(self.ray.take(rows), self.node.take(rows), self.enter.take(rows))


class NumpyBackend(Backend):
    """Bounding volume hierarchy, traversed by many rays at a time on one thread."""

    name: ClassVar[str] = "numpy"
    chunk: ClassVar[int] = 1 << 16

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        return ""

    def __init__(
        self, mesh: LocalMesh, threads: int | None = None, device: int | None = None
    ) -> None:
        super().__init__(mesh, threads, device)
        tree = build_tree(mesh.corners, _WIDTH, _LEAF_SIZE)
        self._nodes = len(tree.child)
        # planes[axis]: lower planes of all nodes, then upper ones: row node + side * nodes
        self._planes = [
            np.concatenate([tree.low[:, axis], tree.high[:, axis]]) for axis in range(3)
        ]
        self._child = tree.child.astype(np.intp)
        self._corners = np.ascontiguousarray(mesh.corners[tree.order])
        self._face = mesh.index[tree.order]

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        origins = np.broadcast_to(self._mesh.to_local(rays.origins), rays.directions.shape)
        t_min, t_max = rays.t_min * self._mesh.scale, rays.t_max * self._mesh.scale
        entry, leave = self._mesh.clip(origins, rays.directions)
        row = np.flatnonzero((entry <= leave) & (entry <= t_max + PAD) & (leave >= t_min - PAD))
        t, triangle = np.full(len(row), t_max), np.full(len(row), -1, np.int32)
        best = _Best(t, triangle, np.zeros(len(row)), np.zeros(len(row)))
        self._walk(_bundle(origins[row], rays.directions[row], entry[row], t_max), best, t_min)
        hit = best.triangle >= 0
        return Found(row[hit], best.t[hit], best.triangle[hit], best.u[hit], best.v[hit])

    def _walk(self, rays: _Bundle, best: _Best, t_min: float) -> None:
        n = len(rays.entry)
        blocks = [_Pairs(np.arange(n), np.zeros(n, np.intp), np.zeros(n, np.float32))]
        while blocks:
            pairs = blocks.pop()
            if len(pairs.ray) > _BLOCK:
                order = np.argpartition(pairs.enter, _BLOCK)
                blocks.append(pairs.only(order[_BLOCK:]))
                pairs = pairs.only(order[:_BLOCK])
            # Hits in front of some boxes may have been found since the block was made.
            pairs = pairs.only(np.flatnonzero(pairs.enter <= rays.limit.take(pairs.ray)))
            enter, meets = self._meets(rays, pairs.ray, pairs.node)
            met = np.flatnonzero(meets)
            ray = pairs.ray.take(met // _WIDTH)
            child = self._child.take(pairs.node, axis=0).reshape(-1).take(met)
            leaf = np.flatnonzero(child < 0)
            self._test(rays, best, t_min, ray.take(leaf), ~child.take(leaf))
            inner = np.flatnonzero(child >= 0)
            if len(inner):
                blocks.append(_Pairs(ray, child, enter.take(met)).only(inner))

    def _meets(self, rays: _Bundle, ray: Index, node: Index) -> tuple[Single, NDArray[np.bool_]]:
        """Where rays enter children's boxes, and whether before they leave: (m * width,) each."""
        enter = np.zeros((len(ray), _WIDTH), np.float32)
        leave = np.empty_like(enter)
        leave[:] = rays.limit.take(ray)[:, None]
        for axis, planes in enumerate(self._planes):
            side = rays.near[axis].take(ray)
            inverse = rays.inverse[axis].take(ray)[:, None]
            shift = rays.scaled_origin[axis].take(ray)[:, None]
            near = planes.take(node + side * self._nodes, axis=0)
            near *= inverse
            near -= shift
            np.maximum(enter, near, out=enter)
            far = planes.take(node + (1 - side) * self._nodes, axis=0)
            far *= inverse
            far -= shift
            np.minimum(leave, far, out=leave)
        return enter.reshape(-1), (enter <= leave).reshape(-1)

    def _test(self, rays: _Bundle, best: _Best, t_min: float, ray: Index, leaf: Index) -> None:
        """Test rays against the triangles of leaves and keep what is closer."""
        if not len(ray):
            return
        count = (leaf & ((1 << LEAF_BITS) - 1)) + 1
        first = leaf >> LEAF_BITS
        ray = np.repeat(ray, count)
        step = np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
        place = np.repeat(first, count) + step
        a, b, c, det, t = exact.intersect(rays.sheared, ray, self._corners, place)
        ok = np.flatnonzero(exact.inside(a, b, c, det) & (t >= t_min) & (t <= best.t.take(ray)))
        if not len(ok):
            return
        ray, face, t = ray[ok], self._face[place[ok]], t[ok]
        order = np.lexsort((face, t, ray))
        order = order[np.diff(ray[order], prepend=-1) != 0]  # the closest of each ray
        ray, face, t = ray[order], face[order], t[order]
        old = best.triangle[ray]
        # At equal distance the lowest row wins; a ray without a hit has t_max, which counts too.
        better = (t < best.t[ray]) | (old < 0) | (face < old)
        ray, ok = ray[better], ok[order][better]
        best.t[ray], best.triangle[ray] = t[better], face[better]
        best.u[ray], best.v[ray] = b[ok] / det[ok], c[ok] / det[ok]
        rays.limit[ray] = _limit(best.t[ray], rays.entry[ray])


def _bundle(origins: Float, directions: Float, entry: Float, t_max: float) -> _Bundle:
    # If the ray is too far away for float64 to place the start, it stays near the scene.
    start = np.clip(origins + entry[:, None] * directions, -2, 2).T.astype(np.float32)
    along = directions.T.astype(np.float32)
    along = np.where(np.abs(along) < TINY, np.copysign(np.float32(TINY), along), along)
    inverse = np.float32(1) / along
    return _Bundle(
        entry,
        start * inverse,
        inverse,
        (along < 0).astype(np.intp),
        _limit(np.full(len(entry), t_max), entry),
        exact.shear(origins, directions),
    )


def _limit(t: Float, entry: Float) -> Single:
    """Distances from `entry` in float32, never less than the exact ones."""
    left = (t - entry) * (1 + _SLACK) + _SLACK
    return np.clip(left, -_ACROSS, _ACROSS).astype(np.float32)
