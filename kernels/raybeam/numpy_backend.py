"""Ray casting in NumPy: the reference, which runs wherever Python does.

Many rays traverse a wide tree together. The unit of work is a pair of a ray and a node. A block of
pairs is tested against the children's boxes in float32; pairs of a ray and an inner child make new
blocks, pairs with a leaf are tested against its triangles. Blocks are processed last in, first out;
in a block that is too large, the pairs nearest to their rays' starts go first. So memory is bounded
for any scene, and early hits discard later pairs behind them. Ordering the children of every node
would test a sixth fewer boxes, but in many small blocks, which takes twice as long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from . import triangle as exact
from .arrays import Bools, Floats, Floats32, Indices, Ints
from .backend import Backend, Found
from .instances import Scene
from .mesh import TINY, clip
from .opacity import join_masks
from .rays import Rays
from .tree import LEAF_BITS, PAD, WideTree, build_top, build_tree, join

_WIDTH = 8
_LEAF_SIZE = 4
_BLOCK = 1 << 15  # pairs: a step's arrays take about 6 MiB; smaller ones need more calls
_ACROSS = 4.0  # local units: more than the diagonal of any scene
_SHIFT = 32  # of the instance in keys of hits, see `_Best`
_SLACK = 2.0**-20  # margin of distance limits in float32: far more than their rounding


@dataclass
class _Best:
    """Closest hits so far; one entry a ray.

    Attributes
    ----------
    t
        Distance, local to the scene.
    key
        int64: ``instance << 32 | triangle``, so that the lowest wins at equal distance; -1: none.
    u, v
        Weights.
    """

    t: Floats
    key: Ints
    u: Floats
    v: Floats


@dataclass(frozen=True)
class _Visit:
    """Which rays are at which instances, and what their directions' lengths were: (m,) each."""

    ray: Indices
    key: Ints  # of triangle 0
    length: Floats


@dataclass(frozen=True)
class _Packet:
    """Rays ready for traversal, in the local coordinates of the scene or of a mesh.

    Attributes
    ----------
    entry
        float64 (n,): where the ray enters the box, 0 if it starts inside. The float32
        part starts there, so that its rounding errors do not grow with the distance to the
        box.
    scaled_origin, inverse
        float32 (3, n): ``origin / direction`` and ``1 / direction``.
    near
        intp (3, n): 1 where the ray meets the upper plane of a box first, else 0.
    limit
        float32 (n,): hits farther than this from `entry` do not count; shrinks.
    sheared
        The rays for the exact test.
    visit
        Where the rays come from, if they are at instances.
    """

    entry: Floats
    scaled_origin: Floats32
    inverse: Floats32
    near: Indices
    limit: Floats32
    sheared: exact.ShearedRays
    visit: _Visit | None = None


@dataclass(frozen=True)
class _Pairs:
    """Rays that are to visit nodes, and where each enters the node's box; (m,) each."""

    ray: Indices
    node: Indices
    enter: Floats32

    def only(self, rows: Indices) -> _Pairs:
        """Select pairs; as many rows as there are pairs select all of them."""
        if len(rows) == len(self.ray):
            return self
        return _Pairs(self.ray.take(rows), self.node.take(rows), self.enter.take(rows))


class _Nodes:
    """Boxes of a tree, or of several one after the other."""

    def __init__(self, tree: WideTree) -> None:
        self._count = len(tree.child)
        # planes[axis]: lower planes of all nodes, then upper ones: row node + side * nodes
        self._planes = [
            np.concatenate([tree.low[:, axis], tree.high[:, axis]]) for axis in range(3)
        ]
        self._child = tree.child.astype(np.intp)

    def walk(self, rays: _Packet, root: Indices, test: Callable[[_Pairs], None]) -> None:
        """Take each ray down from its root, and call `test` with pairs of a ray and a leaf.

        The number of such a pair's node says what the leaf holds. `test` lowers `rays.limit`.
        """
        blocks = [_Pairs(np.arange(len(root)), root, np.zeros(len(root), np.float32))]
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
            child = self._child.take(pairs.node, axis=0).reshape(-1).take(met)
            pairs = _Pairs(pairs.ray.take(met // _WIDTH), child, enter.take(met))
            leaves = pairs.only(np.flatnonzero(child < 0))
            if len(leaves.ray):
                test(_Pairs(leaves.ray, ~leaves.node, leaves.enter))
            inner = np.flatnonzero(child >= 0)
            if len(inner):
                blocks.append(pairs.only(inner))

    def _meets(self, rays: _Packet, ray: Indices, node: Indices) -> tuple[Floats32, Bools]:
        """Where rays enter children's boxes, and whether before they leave: (m * width,) each."""
        enter = np.zeros((len(ray), _WIDTH), np.float32)
        leave = np.empty_like(enter)
        leave[:] = rays.limit.take(ray)[:, None]
        for axis, planes in enumerate(self._planes):
            side = rays.near[axis].take(ray)
            inverse = rays.inverse[axis].take(ray)[:, None]
            shift = rays.scaled_origin[axis].take(ray)[:, None]
            near = planes.take(node + side * self._count, axis=0)
            near *= inverse
            near -= shift
            np.maximum(enter, near, out=enter)
            far = planes.take(node + (1 - side) * self._count, axis=0)
            far *= inverse
            far -= shift
            np.minimum(leave, far, out=leave)
        return enter.reshape(-1), (enter <= leave).reshape(-1)


class NumpyBackend(Backend):
    """Bounding volume hierarchy, traversed by many rays at a time on one thread."""

    name: ClassVar[str] = "numpy"
    chunk: ClassVar[int] = 1 << 16

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        return ""

    def __init__(self, scene: Scene, threads: int | None = None, device: int | None = None) -> None:
        super().__init__(scene, threads, device)
        meshes = scene.meshes
        trees = [build_tree(mesh.corners, _WIDTH, _LEAF_SIZE) for mesh in meshes]
        tree, self._roots = join(trees)
        orders = [tree.order for tree in trees]
        self._masks = join_masks([mesh.opacity for mesh in meshes], orders)
        self._nodes = _Nodes(tree)
        all_corners = [mesh.corners for mesh in meshes]
        corners = all_corners[0] if len(meshes) == 1 else np.concatenate(all_corners)
        self._corners = np.ascontiguousarray(corners[tree.order])
        self._face = np.concatenate([mesh.index for mesh in meshes])[tree.order]
        self.place(scene)

    def place(self, scene: Scene) -> None:
        """See `Backend.place`."""
        super().place(scene)
        if scene.nested:
            self._top = _Nodes(build_top(scene.boxes, _WIDTH))
            # Box of each instance's mesh: (3, n)
            frames = [mesh.frame for mesh in scene.meshes]
            self._low = np.array([frame.low for frame in frames])[scene.mesh].T
            self._high = np.array([frame.high for frame in frames])[scene.mesh].T

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        frame = self._scene.frame
        origins = np.broadcast_to(frame.to_local(rays.origins), rays.directions.shape)
        t_min = rays.t_min * frame.scale
        t_max = rays.t_max * frame.scale
        entry, leave = clip(frame.low, frame.high, origins, rays.directions)
        row = np.flatnonzero((entry <= leave) & (entry <= t_max + PAD) & (leave >= t_min - PAD))
        t = np.full(len(row), t_max)
        key = np.full(len(row), -1, np.int64)
        best = _Best(t, key, np.zeros(len(row)), np.zeros(len(row)))
        origins = origins[row]
        directions = rays.directions[row]
        bundle = _bundle(origins, directions, entry[row], t_max)
        if self._scene.nested:
            self._top.walk(
                bundle,
                np.zeros(len(row), np.intp),
                lambda leaves: self._visit(leaves, origins, directions, bundle, best, t_min),
            )
        else:
            self._walk(bundle, np.zeros(len(row), np.intp), best, t_min)
        hit = best.key >= 0
        key = best.key[hit]
        return Found(
            row[hit],
            best.t[hit],
            key.astype(np.int32),
            best.u[hit],
            best.v[hit],
            (key >> _SHIFT).astype(np.int32),
        )

    def _walk(self, rays: _Packet, root: Indices, best: _Best, t_min: float) -> None:
        self._nodes.walk(rays, root, lambda leaves: self._test(rays, best, t_min, leaves))

    def _visit(
        self,
        leaves: _Pairs,
        origins: Floats,
        directions: Floats,
        rays: _Packet,
        best: _Best,
        t_min: float,
    ) -> None:
        """Cast rays into the meshes of instances, round by round: for each ray the nearest."""
        order = np.lexsort((leaves.enter, leaves.ray))
        starts = np.flatnonzero(np.diff(leaves.ray[order], prepend=-1))
        counts = np.diff(starts, append=len(order))
        turn = np.arange(len(order)) - np.repeat(starts, counts)
        order = order[np.argsort(turn, kind="stable")]
        ends = np.cumsum(np.bincount(turn))
        for chosen in np.split(order, ends[:-1]):
            now = leaves.only(chosen)
            now = now.only(np.flatnonzero(now.enter <= rays.limit.take(now.ray)))
            ray = now.ray
            instance = now.node >> LEAF_BITS
            at, to, length = self._scene.enter(instance, origins[ray], directions[ray])
            low = self._low[:, instance]
            high = self._high[:, instance]
            entry, leave = clip(low, high, at, to)
            t_max = best.t[ray] * length
            met = np.flatnonzero(
                (entry <= leave) & (entry <= t_max + PAD) & (leave >= t_min * length - PAD)
            )
            ray = ray[met]
            instance = instance[met]
            visit = _Visit(ray, instance << _SHIFT, length[met])
            inside = _bundle(at[met], to[met], entry[met], t_max[met], visit)
            self._walk(inside, self._roots[self._scene.mesh[instance]], best, t_min)
            rays.limit[ray] = _limit(best.t[ray], rays.entry[ray])

    def _test(self, rays: _Packet, best: _Best, t_min: float, leaves: _Pairs) -> None:
        """Test rays against the triangles of leaves and keep what is closer."""
        count = (leaves.node & ((1 << LEAF_BITS) - 1)) + 1
        first = leaves.node >> LEAF_BITS
        row = np.repeat(leaves.ray, count)
        step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
        place = np.repeat(first, count) + step
        a, b, c, det, t = exact.intersect(rays.sheared, row, self._corners, place)
        ray = row
        if rays.visit is not None:
            ray = rays.visit.ray[row]
            t = t / rays.visit.length[row]
        ok = np.flatnonzero(exact.inside(a, b, c, det) & (t >= t_min) & (t <= best.t.take(ray)))
        if self._masks is not None:
            instance = 0 if rays.visit is None else rays.visit.key[row[ok]] >> _SHIFT
            mesh = np.broadcast_to(self._scene.mesh[instance], len(ok))
            weights = (weight[ok] for weight in (a, b, c, det))
            ok = ok[self._masks.opaque(mesh, place[ok], *weights)]
        if not len(ok):
            return
        row = row[ok]
        ray = ray[ok]
        key = self._face[place[ok]].astype(np.int64)
        t = t[ok]
        if rays.visit is not None:
            key += rays.visit.key[row]
        order = np.lexsort((key, t, ray))
        order = order[np.diff(ray[order], prepend=-1) != 0]  # the closest of each ray
        row = row[order]
        ray = ray[order]
        key = key[order]
        t = t[order]
        old = best.key[ray]
        # At equal distance the lowest key wins; a ray without a hit has t_max, which counts too.
        better = (t < best.t[ray]) | (old < 0) | (key < old)
        row = row[better]
        ray = ray[better]
        ok = ok[order][better]
        best.t[ray] = t[better]
        best.key[ray] = key[better]
        best.u[ray] = b[ok] / det[ok]
        best.v[ray] = c[ok] / det[ok]
        reach = best.t[ray] if rays.visit is None else best.t[ray] * rays.visit.length[row]
        rays.limit[row] = _limit(reach, rays.entry[row])


def _bundle(
    origins: Floats,
    directions: Floats,
    entry: Floats,
    t_max: Floats | float,
    visit: _Visit | None = None,
) -> _Packet:
    # If the ray is too far away for float64 to place the start, it stays near the scene.
    start = np.clip(origins + entry[:, None] * directions, -2, 2).T.astype(np.float32)
    along = directions.T.astype(np.float32)
    along = np.where(np.abs(along) < TINY, np.copysign(np.float32(TINY), along), along)
    inverse = np.float32(1) / along
    return _Packet(
        entry,
        start * inverse,
        inverse,
        (along < 0).astype(np.intp),
        _limit(np.broadcast_to(t_max, len(entry)), entry),
        exact.shear(origins, directions),
        visit,
    )


def _limit(t: Floats, entry: Floats) -> Floats32:
    """Distances from `entry` in float32, never less than the exact ones."""
    left = (t - entry) * (1 + _SLACK) + _SLACK
    return np.clip(left, -_ACROSS, _ACROSS).astype(np.float32)
