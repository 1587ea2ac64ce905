"""Ray casting with NumPy alone, as the reference for the other backends.

Many rays traverse a wide tree together. The unit of work is a pair of a ray and a node. The boxes
of the node's children are tested in float32 for a block of pairs at a time. Pairs of a ray and an
inner child form new blocks, and pairs with a leaf are tested against its triangles. Blocks are
processed last in, first out. If a block is too large, the pairs whose boxes are closest to the
origins of their rays are processed first. This bounds the memory for any scene, and early hits
discard more distant pairs. Sorting the children of each node would save a sixth of the box tests,
but the blocks would be smaller, and the traversal would take twice as long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from . import triangle as exact
from .arrays import Bools, Floats, Floats32, Indices, Ints
from .backend import Backend, ClosestHits
from .instances import LocalScene
from .mesh import MAX_DIAGONAL, TINY, clip_to_box
from .opacity import join_masks
from .rays import Rays
from .tree import LEAF_BITS, PAD, WideTree, build_instance_tree, build_tree, join_trees

_WIDTH = 8
_LEAF_SIZE = 4
# Number of pairs per block. The arrays of a step take about 6 MiB, and smaller blocks need more
# calls.
_BLOCK = 1 << 15
_SHIFT = 32  # position of the instance in the keys of hits (`_Best`)
_SLACK = 2.0**-20  # margin of distance limits in float32, much more than their rounding errors


@dataclass
class _Best:
    """Closest hits so far, or candidate hits, with one row per ray.

    Attributes
    ----------
    t
        Distance in local scene coordinates.
    key
        int64: ``instance << 32 | triangle``, so that the lowest key wins ties; -1 for no hit.
    u, v
        Barycentric weights of the second and third vertex.
    """

    t: Floats
    key: Ints
    u: Floats
    v: Floats


@dataclass(frozen=True)
class _Query:
    """Rays that intersect the scene's bounding box, and their closest hits.

    Attributes
    ----------
    origins, directions
        float64 (n, 3), in local scene coordinates. The directions are unit vectors.
    t_min
        Minimum distance of a hit in local scene coordinates.
    best
        Closest hits so far, (n,).
    """

    origins: Floats
    directions: Floats
    t_min: float
    best: _Best


@dataclass(frozen=True)
class _Visit:
    """The instances at which rays are cast.

    Attributes
    ----------
    ray
        (m,): index of the ray in the query.
    key
        int64 (m,): key of triangle 0 of the instance (see `_Best`).
    length
        float64 (m,): length of the direction in mesh coordinates before it was normalized.
    """

    ray: Indices
    key: Ints
    length: Floats


@dataclass(frozen=True)
class _Packet:
    """Rays that are prepared for traversal, in local coordinates of the scene or a mesh.

    Attributes
    ----------
    entry
        float64 (n,): distance at which the ray enters the bounding box; 0 if it starts inside. The
        float32 computations start there, so that their rounding errors do not grow with the
        distance to the box.
    scaled_origin, inverse
        float32 (3, n): ``origin / direction`` and ``1 / direction``.
    near_side
        intp (3, n): 1 if the ray intersects the upper plane of a box first, otherwise 0.
    limit
        float32 (n,): maximum distance of a hit from `entry`. It decreases during the traversal.
    sheared
        The rays prepared for the exact intersection test.
    visit
        The instances that the rays are cast at. None in a plain scene.
    """

    entry: Floats
    scaled_origin: Floats32
    inverse: Floats32
    near_side: Indices
    limit: Floats32
    sheared: exact.ShearedRays
    visit: _Visit | None = None


@dataclass(frozen=True)
class _Pairs:
    """Pairs of a ray and a node, with the distance at which the ray enters the node."""

    ray: Indices
    node: Indices
    enter: Floats32

    def select(self, row_indices: Indices) -> _Pairs:
        """Return the pairs in the given rows, which must be distinct.

        If all rows are selected, the pairs themselves are returned, regardless of the order of the
        rows.
        """
        if len(row_indices) == len(self.ray):
            return self
        return _Pairs(
            self.ray.take(row_indices), self.node.take(row_indices), self.enter.take(row_indices)
        )


class _Nodes:
    """Bounding boxes of all nodes in one or more trees."""

    def __init__(self, tree: WideTree) -> None:
        self._count = len(tree.child)
        # For each axis, the lower planes of all nodes, followed by the upper planes.
        self._planes = [
            np.concatenate([tree.lower[:, axis], tree.upper[:, axis]]) for axis in range(3)
        ]
        self._child = tree.child.astype(np.intp)

    def walk(self, rays: _Packet, root: Indices, test: Callable[[_Pairs], None]) -> None:
        """Traverse the tree from each ray's root, and call `test` for the rays that reach leaves.

        `test` receives pairs whose node encodes a leaf's first triangle and number of triangles. It
        reduces `rays.limit` if it finds closer hits.
        """
        blocks = [_Pairs(np.arange(len(root)), root, np.zeros(len(root), np.float32))]
        while blocks:
            pairs = blocks.pop()
            if len(pairs.ray) > _BLOCK:
                order = np.argpartition(pairs.enter, _BLOCK)
                blocks.append(pairs.select(order[_BLOCK:]))
                pairs = pairs.select(order[:_BLOCK])
            # Since the block was created, hits in front of some boxes may have been found.
            pairs = pairs.select(np.flatnonzero(pairs.enter <= rays.limit.take(pairs.ray)))
            enter, meets = self._intersect_children(rays, pairs.ray, pairs.node)
            met_slots = np.flatnonzero(meets)
            child = self._child.take(pairs.node, axis=0).reshape(-1).take(met_slots)
            pairs = _Pairs(pairs.ray.take(met_slots // _WIDTH), child, enter.take(met_slots))
            leaves = pairs.select(np.flatnonzero(child < 0))
            if len(leaves.ray):
                test(_Pairs(leaves.ray, ~leaves.node, leaves.enter))
            inner = np.flatnonzero(child >= 0)
            if len(inner):
                blocks.append(pairs.select(inner))

    def _intersect_children(
        self, rays: _Packet, ray: Indices, node: Indices
    ) -> tuple[Floats32, Bools]:
        """Compute entry distances for the boxes of all children, and mask the boxes that are hit.

        Both arrays have shape (m * width,).
        """
        enter = np.zeros((len(ray), _WIDTH), np.float32)
        leave = np.empty_like(enter)
        leave[:] = rays.limit.take(ray)[:, None]
        for axis, planes in enumerate(self._planes):
            side = rays.near_side[axis].take(ray)
            inverse = rays.inverse[axis].take(ray)[:, None]
            shift = rays.scaled_origin[axis].take(ray)[:, None]
            entry_distance = planes.take(node + side * self._count, axis=0)
            entry_distance *= inverse
            entry_distance -= shift
            np.maximum(enter, entry_distance, out=enter)
            exit_distance = planes.take(node + (1 - side) * self._count, axis=0)
            exit_distance *= inverse
            exit_distance -= shift
            np.minimum(leave, exit_distance, out=leave)
        return enter.reshape(-1), (enter <= leave).reshape(-1)


class NumpyBackend(Backend):
    """Backend that traverses bounding volume hierarchies with blocks of rays in a single thread."""

    name: ClassVar[str] = "numpy"
    chunk: ClassVar[int] = 1 << 16

    @classmethod
    def unavailable_reason(cls) -> str:
        """Return "", because NumPy is always available."""
        return ""

    def __init__(
        self, scene: LocalScene, threads: int | None = None, device: int | None = None
    ) -> None:
        super().__init__(scene, threads, device)
        meshes = scene.meshes
        trees = [build_tree(mesh.corners, _WIDTH, _LEAF_SIZE) for mesh in meshes]
        tree, self._roots = join_trees(trees)
        orders = [tree.order for tree in trees]
        self._masks = join_masks([mesh.opacity for mesh in meshes], orders)
        self._nodes = _Nodes(tree)
        all_corners = [mesh.corners for mesh in meshes]
        corners = all_corners[0] if len(meshes) == 1 else np.concatenate(all_corners)
        self._corners = np.ascontiguousarray(corners[tree.order])
        self._face = np.concatenate([mesh.index for mesh in meshes])[tree.order]
        self.update_scene(scene)

    def update_scene(self, scene: LocalScene) -> None:
        """Replace the scene by one with the same instances but new transforms."""
        super().update_scene(scene)
        if scene.has_matrices:
            self._top = _Nodes(build_instance_tree(scene.boxes, _WIDTH))
            # Corners (3, n) of the bounding box of each instance's mesh in mesh coordinates.
            frames = [mesh.frame for mesh in scene.meshes]
            self._lower = np.array([frame.lower for frame in frames])[scene.mesh].T
            self._upper = np.array([frame.upper for frame in frames])[scene.mesh].T

    def closest_hits(self, rays: Rays) -> ClosestHits:
        """Return the closest hits of at most `chunk` rays."""
        frame = self._scene.frame
        origins = np.broadcast_to(frame.to_local(rays.origins), rays.directions.shape)
        t_min = rays.t_min * frame.scale
        t_max = rays.t_max * frame.scale
        entry, leave = clip_to_box(frame.lower, frame.upper, origins, rays.directions)
        row = np.flatnonzero((entry <= leave) & (entry <= t_max + PAD) & (leave >= t_min - PAD))
        count = len(row)
        best = _Best(
            np.full(count, t_max), np.full(count, -1, np.int64), np.zeros(count), np.zeros(count)
        )
        query = _Query(origins[row], rays.directions[row], t_min, best)
        packet = _packet(query.origins, query.directions, entry[row], t_max)
        roots = np.zeros(count, np.intp)
        if self._scene.has_matrices:
            self._top.walk(packet, roots, lambda leaves: self._visit(query, packet, leaves))
        else:
            self._walk(query, packet, roots)
        hit = best.key >= 0
        key = best.key[hit]
        return ClosestHits(
            row[hit],
            best.t[hit],
            key.astype(np.int32),
            best.u[hit],
            best.v[hit],
            (key >> _SHIFT).astype(np.int32),
        )

    def _walk(self, query: _Query, rays: _Packet, root: Indices) -> None:
        self._nodes.walk(rays, root, lambda leaves: self._test(query, rays, leaves))

    def _visit(self, query: _Query, rays: _Packet, leaves: _Pairs) -> None:
        """Cast rays at instances in rounds, so that each ray visits its closest instance first."""
        for chosen in _rounds(leaves):
            pairs = leaves.select(chosen)
            pairs = pairs.select(np.flatnonzero(pairs.enter <= rays.limit.take(pairs.ray)))
            instance = pairs.node >> LEAF_BITS
            inner_rays = self._inner_rays(query, pairs.ray, instance)
            visit = inner_rays.visit
            assert visit is not None
            root = self._roots[self._scene.mesh[visit.key >> _SHIFT]]
            self._walk(query, inner_rays, root)
            rays.limit[visit.ray] = _limit(query.best.t[visit.ray], rays.entry[visit.ray])

    def _inner_rays(self, query: _Query, ray: Indices, instance: Indices) -> _Packet:
        """Transform rays to the mesh coordinates of instances, and omit rays that miss the mesh."""
        origins, directions, length = self._scene.to_mesh_coordinates(
            instance, query.origins[ray], query.directions[ray]
        )
        entry, leave = clip_to_box(
            self._lower[:, instance], self._upper[:, instance], origins, directions
        )
        t_max = query.best.t[ray] * length
        rows = np.flatnonzero(
            (entry <= leave) & (entry <= t_max + PAD) & (leave >= query.t_min * length - PAD)
        )
        visit = _Visit(ray[rows], instance[rows] << _SHIFT, length[rows])
        return _packet(origins[rows], directions[rows], entry[rows], t_max[rows], visit)

    def _test(self, query: _Query, rays: _Packet, leaves: _Pairs) -> None:
        """Test rays against the triangles in leaves, and record closer hits."""
        row, position = _leaf_pairs(leaves)
        hits = exact.intersect(rays.sheared, row, self._corners, position)
        t = hits.t
        ray = row
        if rays.visit is not None:
            ray = rays.visit.ray[row]
            t = t / rays.visit.length[row]
        passes = exact.is_inside(hits.a, hits.b, hits.c, hits.det)
        hit = np.flatnonzero(passes & (t >= query.t_min) & (t <= query.best.t.take(ray)))
        if self._masks is not None:
            instance = 0 if rays.visit is None else rays.visit.key[row[hit]] >> _SHIFT
            mesh = np.broadcast_to(self._scene.mesh[instance], len(hit))
            weights = (weight[hit] for weight in hits[:4])
            hit = hit[self._masks.is_opaque(mesh, position[hit], *weights)]
        if not len(hit):
            return
        row = row[hit]
        key = self._face[position[hit]].astype(np.int64)
        if rays.visit is not None:
            key += rays.visit.key[row]
        u = hits.b[hit] / hits.det[hit]
        v = hits.c[hit] / hits.det[hit]
        _write_closer(query.best, rays, row, _Best(t[hit], key, u, v))


def _leaf_pairs(leaves: _Pairs) -> tuple[Indices, Indices]:
    """Expand pairs of a ray and a leaf to pairs of a ray and a triangle position."""
    count = (leaves.node & ((1 << LEAF_BITS) - 1)) + 1
    first = leaves.node >> LEAF_BITS
    row = np.repeat(leaves.ray, count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    return row, np.repeat(first, count) + step


def _rounds(leaves: _Pairs) -> list[Indices]:
    """Divide the rows into rounds, each of which contains at most one leaf per ray.

    The first round contains the closest leaf of each ray, the second round the second closest leaf,
    and so on.
    """
    order = np.lexsort((leaves.enter, leaves.ray))
    starts = np.flatnonzero(np.diff(leaves.ray[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    rank = np.arange(len(order)) - np.repeat(starts, counts)
    order = order[np.argsort(rank, kind="stable")]
    stops = np.cumsum(np.bincount(rank))
    return np.split(order, stops[:-1])


def _write_closer(best: _Best, rays: _Packet, row: Indices, hits: _Best) -> None:
    """Record hits that are closer than those recorded so far, and shorten the rays."""
    ray = row if rays.visit is None else rays.visit.ray[row]
    order = np.lexsort((hits.key, hits.t, ray))
    order = order[np.diff(ray[order], prepend=-1) != 0]  # only the closest hit of each ray
    ray = ray[order]
    t = hits.t[order]
    key = hits.key[order]
    known_key = best.key[ray]
    # The lowest key wins ties. A ray without a hit has the distance t_max, which is inclusive.
    closer = (t < best.t[ray]) | (known_key < 0) | (key < known_key)
    row = row[order][closer]
    ray = ray[closer]
    best.t[ray] = t[closer]
    best.key[ray] = key[closer]
    best.u[ray] = hits.u[order][closer]
    best.v[ray] = hits.v[order][closer]
    reach = best.t[ray] if rays.visit is None else best.t[ray] * rays.visit.length[row]
    rays.limit[row] = _limit(reach, rays.entry[row])


def _packet(
    origins: Floats,
    directions: Floats,
    entry: Floats,
    t_max: Floats | float,
    visit: _Visit | None = None,
) -> _Packet:
    """Prepare rays for traversal, in local coordinates of the scene or a mesh."""
    # The start is clipped, because float64 cannot represent it accurately if the ray is too far
    # away.
    start = np.clip(origins + entry[:, None] * directions, -2, 2).T.astype(np.float32)
    components = directions.T.astype(np.float32)
    components = np.where(
        np.abs(components) < TINY, np.copysign(np.float32(TINY), components), components
    )
    inverse = np.float32(1) / components
    return _Packet(
        entry=entry,
        scaled_origin=start * inverse,
        inverse=inverse,
        near_side=(components < 0).astype(np.intp),
        limit=_limit(np.broadcast_to(t_max, len(entry)), entry),
        sheared=exact.shear_rays(origins, directions),
        visit=visit,
    )


def _limit(t: Floats, entry: Floats) -> Floats32:
    """Subtract `entry` from distances. Convert the result to float32, but never round it down."""
    remaining = (t - entry) * (1 + _SLACK) + _SLACK
    return np.clip(remaining, -MAX_DIAGONAL, MAX_DIAGONAL).astype(np.float32)
