"""Scenes for pictures and plans: all triangles, with instances simplified if they are many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import AnyArray, Floats, Indices, Ints, Ints32
from .colors import Colors, join_colors
from .face_materials import ObjectMaterials
from .scene import Scene
from .scene_instances import Instances, MeshPart
from .scene_mesh import stacked, triangle_areas

DRAWN_TRIANGLES = 2_000_000  # limit for all instances; parts of more triangles are simplified
MIN_PART_TRIANGLES = 32  # least number for a simplified part
CUT_TRIANGLES = 50_000  # pieces of a part with a mask
CUT_STEPS = 128  # pieces along the edge of a triangle
_MAX_POSITIONS = 200  # distances are measured to so many positions


@dataclass(frozen=True, eq=False)
class SimplifiedScene:
    """A scene without instances, whose triangles know their hit counters.

    Attributes
    ----------
    scene
        The scene; the original scene if that has no instances.
    counter
        intp (f,): hit counter of each triangle (`Scene.counters`).
    is_original
        Whether `scene` is the original scene.
    """

    scene: Scene
    counter: Indices
    is_original: bool = False

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        max_triangles: int = DRAWN_TRIANGLES,
        near_positions: Sequence[Floats] = (),
    ) -> SimplifiedScene:
        """Copy all instances to their positions, with at most about `max_triangles` in total.

        Instances close to `near_positions`, (k, 3) each, local, keep more triangles.
        """
        if (shared := scene.instances) is None:
            return cls(scene, np.arange(len(scene.faces)), is_original=True)
        shares = _triangle_shares(shared, max_triangles, near_positions)
        copies = _CopiedInstances(scene)
        for index, share in sorted(set(zip(shared.part.tolist(), shares.tolist(), strict=True))):
            part = _drawn_part(shared.mesh_parts[index], share)
            for row in np.flatnonzero((shared.part == index) & (shares == share)):
                copies.add(part, shared, int(row))
        return cls(copies.scene(), np.concatenate(copies.counters))

    def triangle_hit_counts(self, counts: AnyArray) -> AnyArray:
        """Return the hits of each triangle, and of the actors' triangles, from hit counters."""
        if self.is_original:
            return counts
        area = triangle_areas(self.scene.vertices[self.scene.faces]) + np.finfo(np.float64).tiny
        share = area / np.bincount(self.counter, area, len(counts))[self.counter]
        actor_triangles = sum(len(actor.mesh.faces) for actor in self.scene.actors)
        return np.append(counts[self.counter] * share, counts[len(counts) - actor_triangles :])


class _DrawnPart(NamedTuple):
    """A part of instances, perhaps simplified, for drawings."""

    vertices: Floats  # (v, 3)
    faces: Ints32  # (f, 3)
    colors: Colors | None  # a plain color for each face
    materials: Ints32 | None  # (f,): row of the names of the object's materials; None for the first


class _CopiedInstances:
    """Triangles of a scene, and copies of its instances' triangles."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._meshes = [(scene.vertices, scene.faces)]
        self._owners = [scene.face_object]
        self._colors = [scene.colors]
        self._materials = [None if scene.materials is None else scene.materials.index]
        self.counters = [np.arange(len(scene.faces))]
        assert scene.instances is not None
        self._mirrored = np.linalg.det(scene.instances.transforms[:, :, :3]) < 0

    def add(self, part: _DrawnPart, shared: Instances, row: int) -> None:
        """Copy a part to the instance `row`."""
        matrix = shared.transforms[row]
        count = len(part.faces)
        corners = part.faces[:, ::-1] if self._mirrored[row] else part.faces
        self._meshes.append((part.vertices @ matrix[:, :3].T + matrix[:, 3], corners))
        self._owners.append(np.full(count, shared.owner[row]))
        self._colors.append(part.colors)
        self._materials.append(part.materials)
        self.counters.append(np.full(count, len(self._scene.faces) + row))

    def scene(self) -> Scene:
        """Return the scene of all triangles, with the actors, without instances."""
        vertices, faces = stacked(self._meshes)
        return Scene(
            vertices,
            faces,
            np.concatenate(self._owners).astype(np.int32),
            self._scene.names,
            self._scene.origin,
            self._scene.actors,
            colors=join_colors(self._colors, map(len, self._owners)),
            materials=self._object_materials(),
        )

    def _object_materials(self) -> ObjectMaterials | None:
        """Return the materials of all triangles."""
        if self._scene.materials is None:
            return None
        rows = [
            np.zeros(len(owners), np.int32) if materials is None else materials
            for owners, materials in zip(self._owners, self._materials, strict=True)
        ]
        return ObjectMaterials(self._scene.materials.names, np.concatenate(rows))


def _drawn_part(part: MeshPart, share: float) -> _DrawnPart:
    """Return a part with a share of its triangles, and the mean color of each triangle."""
    vertices = part.vertices
    faces = part.faces
    rows = np.arange(len(part.faces))
    count = max(MIN_PART_TRIANGLES, int(len(faces) * share))
    if count < len(faces):
        vertices, faces, rows = _simplified_part(part, count)
    colors = part.colors and Colors.of_faces(part.colors.take(rows).means())
    materials = part.materials and part.materials.take(rows)
    return _DrawnPart(vertices, faces, colors, None if materials is None else materials.index)


def cut_masks(scene: Scene) -> Scene:
    """Return a scene for pictures, with small opaque triangles in place of masked triangles.

    The hit counters stay the same.
    """
    shared = scene.instances
    masked = sum(part.mask is not None for part in shared.mesh_parts) if shared else 0
    if shared is None or not masked:
        return scene
    instance_counts = np.bincount(shared.part, minlength=len(shared.mesh_parts))
    parts = tuple(
        _cut_part(part, min(CUT_TRIANGLES, DRAWN_TRIANGLES / (masked * count)))
        for part, count in zip(shared.mesh_parts, instance_counts.tolist(), strict=True)
    )
    return replace(scene, instances=replace(shared, mesh_parts=parts))


def _cut_part(part: MeshPart, max_pieces: float) -> MeshPart:
    """Divide a part with a mask into about `max_pieces`, and return the opaque pieces.

    The mask is sampled at a random point of each piece: the share of opaque pieces is right,
    however fine the mask.
    """
    if part.mask is None or part.uv is None:
        return part
    steps = int(np.clip((max_pieces / len(part.faces)) ** 0.5, 1, CUT_STEPS))
    corners = _piece_corners(steps)
    weights = np.random.default_rng(0).dirichlet(np.ones(3), (len(part.faces), len(corners)))
    uv = part.uv.astype(np.float64)
    u, v = np.einsum("fpc,pck,fkx->xfp", weights, corners, uv, optimize=True)
    height, width = part.mask.shape
    row = (v % 1 * height).astype(int)
    column = (u % 1 * width).astype(int)
    opaque = part.mask[np.minimum(row, height - 1), np.minimum(column, width - 1)]
    opaque[0, 0] |= not opaque.any()  # no part is empty
    face, piece = np.nonzero(opaque)
    vertices = (corners[piece] @ part.vertices[part.faces[face]]).reshape(-1, 3)
    colors = part.colors and part.colors.divided(face, corners[piece])
    return MeshPart(
        vertices,
        np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
        colors=colors,
        materials=part.materials and part.materials.take(face),
    )


def _piece_corners(steps: int) -> Floats:
    """Return barycentric corners (steps², 3, 3) of the pieces of a triangle, `steps` an edge."""
    i, j = (n.ravel() for n in np.mgrid[:steps, :steps])
    # Pieces beyond the diagonal are rotated by 180 degrees, into the gaps between the others.
    first = np.stack([[i, j], [i + 1, j], [i, j + 1]], axis=-1).transpose(1, 2, 0)
    pieces = np.where((i + j < steps)[:, None, None], first, steps - first)
    return np.asarray(
        np.concatenate([pieces, steps - pieces.sum(axis=2, keepdims=True)], axis=2) / steps
    )


def _triangle_shares(
    shared: Instances, max_triangles: int, near_positions: Sequence[Floats]
) -> Floats:
    """Return the share of its triangles that each instance keeps in a drawing, (n,).

    Half of the triangles are shared evenly, the other half by the square of the distance to the
    nearest position: then all triangles have about the same size in a picture from there.
    """
    even_share = min(1.0, max_triangles / shared.triangles)
    positions = np.concatenate([np.empty((0, 3)), *near_positions])
    if even_share == 1 or not len(positions):
        return np.full(len(shared), even_share)
    middles = shared.bounds.mean(axis=1)
    distance = np.full(len(shared), np.inf)
    for position in positions[:: len(positions) // _MAX_POSITIONS + 1]:
        np.minimum(distance, np.linalg.norm(middles - position, axis=1), out=distance)
    distance += 1e-3
    full_distance = distance.max()  # up to this distance instances keep all triangles
    while True:
        # In steps of four, since each step makes another mesh.
        near_share = 4.0 ** np.floor(np.log2(np.minimum(full_distance / distance, 1)))
        shares = np.maximum(near_share, even_share / 2)
        if shares @ shared.sizes <= max_triangles:
            return shares
        full_distance *= 0.9


class _SimplifiedPart(NamedTuple):
    """A part of fewer triangles."""

    vertices: Floats  # (v, 3)
    faces: Ints32  # (k, 3)
    face_indices: Indices  # (k,), the original face of each face


def _simplified_part(part: MeshPart, max_triangles: int) -> _SimplifiedPart:
    """Return a part with at most `max_triangles`, which looks like the original.

    If a part has many small pieces, such as the leaves of a tree, merging vertices would leave
    little. There the largest triangles stay, as of trunk and boughs, and a random choice of the
    others, enlarged to stand for all small triangles (Cook et al., 2007); long triangles are
    enlarged less, since they would stick out.
    """
    # A single surface has half as many vertices as faces.
    has_pieces = len(np.unique(part.vertices, axis=0)) > len(part.faces)
    merged = _merge_vertices(part.vertices, part.faces, max_triangles)
    if not has_pieces and len(merged.face_indices) >= max_triangles // 4:
        return _SimplifiedPart(
            merged.vertices, merged.faces[merged.face_indices], merged.face_indices
        )
    corners = part.vertices[part.faces]
    order = np.argsort(-triangle_areas(corners), kind="stable")
    large, small = np.split(order, [max_triangles // 4])
    sampled = np.random.default_rng(0).choice(small, max_triangles - len(large), replace=False)
    edges = corners[sampled] - np.roll(corners[sampled], 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    scale = np.ones(max_triangles)
    scale[len(large) :] = (len(small) / len(sampled)) ** 0.5 * np.minimum(
        1, np.median(longest) / longest
    )
    rows = np.append(large, sampled)
    middle = corners[rows].mean(axis=1, keepdims=True)
    enlarged = middle + (corners[rows] - middle) * np.maximum(1, scale)[:, None, None]
    faces = np.arange(3 * max_triangles, dtype=np.int32).reshape(-1, 3)
    return _SimplifiedPart(enlarged.reshape(-1, 3), faces, rows)


def simplified(scene: Scene, max_triangles: int) -> tuple[Scene, Ints]:
    """Return a scene of at most `max_triangles`, and the substitute (f,) of each original triangle.

    The substitute is the triangle of the new scene that stands for the original triangle, or -1
    for small objects that vanish.
    """
    merged = _merge_vertices(scene.vertices, scene.faces, max_triangles)
    owners = scene.face_object[merged.face_indices]
    colors = scene.colors and scene.colors.take(merged.face_indices)
    faces = merged.faces[merged.face_indices]
    coarse = Scene(merged.vertices, faces, owners, scene.names, scene.origin, colors=colors)
    return coarse, merged.substitutes


class _MergedMesh(NamedTuple):
    """A mesh whose vertices in the same cell of a grid are merged."""

    vertices: Floats  # (v, 3)
    faces: Ints32  # (f, 3), all faces, with the new vertices
    face_indices: Indices  # (k,), faces to keep: with an area, and each only once
    substitutes: (
        Ints  # (f,), index into `face_indices` of the face that stands for each face; -1 for none
    )


def _merge_vertices(points: Floats, corners: Ints32, max_triangles: int) -> _MergedMesh:
    """Merge vertices in the same cell of a grid (Rossignac and Borrel, 1993).

    Cells are as small as `max_triangles`, the number of faces to keep, allows.
    """
    area = float(triangle_areas(points[corners]).sum())
    cell = (2 * area / max_triangles) ** 0.5
    while True:
        merged, counts = _cells(points, cell)
        faces = merged[corners].astype(np.int32)
        collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
        full = np.flatnonzero(~collapsed)
        keys = _row_numbers(np.sort(faces[full], axis=1))
        _, distinct, group = np.unique(keys, return_index=True, return_inverse=True)
        if len(distinct) <= max_triangles:
            break
        cell *= 1.3
    vertices = np.stack([np.bincount(merged, axis) / counts for axis in points.T], axis=1)
    rows = full[distinct]
    substitutes = np.full(len(faces), -1, np.int64)
    substitutes[full] = group
    face_at_vertex = _face_at_vertex(faces[rows], len(vertices))
    substitutes[collapsed] = face_at_vertex[faces[collapsed]].max(axis=1)
    return _MergedMesh(vertices, faces, rows, substitutes)


def _face_at_vertex(faces: Ints32, vertex_count: int) -> Ints:
    """Return a face at each vertex (v,), -1 at vertices without faces."""
    face_at_vertex = np.full(vertex_count, -1, np.int64)
    face_at_vertex[faces.ravel()] = np.repeat(np.arange(len(faces)), 3)
    return face_at_vertex


def _cells(points: Floats, cell: float) -> tuple[Ints, Ints]:
    """Return the number (n,) of each point's cell in a grid, and the points of each cell (c,)."""
    columns = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, merged, counts = np.unique(_row_numbers(columns), return_inverse=True, return_counts=True)
    return merged, counts


def _row_numbers(rows: AnyArray) -> Ints:
    """Return numbers (n,) in the order of rows (n, 3) of natural numbers, as faster sort keys."""
    row_numbers = np.zeros(len(rows), np.int64)
    for column in rows.T.astype(np.int64):
        leading = _compact(row_numbers)
        trailing = _compact(column)
        row_numbers = leading * (int(trailing.max(initial=0)) + 1) + trailing
    return row_numbers


def _compact(numbers: Ints) -> Ints:
    """Return numbers in the same order below 2³¹, so that a product of two fits 64 bits."""
    if numbers.max(initial=0) >= 1 << 31:
        return np.unique(numbers, return_inverse=True)[1]
    return numbers
