"""Simplified scenes for plots and plans, with triangles instead of instances.

If a scene has many instances, they are drawn with fewer triangles.
"""

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
from .scene_mesh import stack_meshes, triangle_areas

DRAWN_TRIANGLES = 2_000_000  # total limit for instances, which are simplified if they exceed it
MIN_PART_TRIANGLES = 32  # minimum for a simplified part
CUT_TRIANGLES = 50_000  # maximum number of pieces into which a masked part is divided
CUT_STEPS = 128  # maximum number of pieces along the edge of a triangle
_MAX_POSITIONS = 200  # maximum number of positions to which distances are measured


@dataclass(frozen=True, eq=False)
class SimplifiedScene:
    """A scene without instances, with the hit counter of each triangle.

    Attributes
    ----------
    scene
        The scene without instances. It is the original scene if that scene has no instances.
    counter
        Index of the hit counter of each triangle (`Scene.counters`). Shape (f,), intp.
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
        """Replace the instances of a scene with copies of their triangles.

        The copies have about `max_triangles` triangles or fewer in total. Instances close to
        `near_positions` keep more of their triangles. Each array in `near_positions` contains local
        coordinates and has shape (k, 3).
        """
        if (shared := scene.instances) is None:
            return cls(scene, np.arange(len(scene.faces)), is_original=True)
        fractions = _triangle_shares(shared, max_triangles, near_positions)
        copies = _CopiedInstances(scene)
        for index, fraction in sorted(
            set(zip(shared.part.tolist(), fractions.tolist(), strict=True))
        ):
            part = _simplify_for_drawing(shared.mesh_parts[index], fraction)
            for row in np.flatnonzero((shared.part == index) & (fractions == fraction)):
                copies.add(part, shared, int(row))
        return cls(copies.scene(), np.concatenate(copies.counters))

    def triangle_hit_counts(self, counts: AnyArray) -> AnyArray:
        """Distribute hit counts over triangles in proportion to their area.

        `counts` contains one value per hit counter. The result contains one value per triangle of
        `scene`, followed by the triangles of the actors.
        """
        if self.is_original:
            return counts
        area = triangle_areas(self.scene.vertices[self.scene.faces]) + np.finfo(np.float64).tiny
        fraction = area / np.bincount(self.counter, area, len(counts))[self.counter]
        actor_triangles = sum(len(actor.mesh.faces) for actor in self.scene.actors)
        return np.append(counts[self.counter] * fraction, counts[len(counts) - actor_triangles :])


class _DrawnPart(NamedTuple):
    """A mesh part for drawing, with fewer triangles if necessary."""

    vertices: Floats  # (v, 3)
    faces: Ints32  # (f, 3)
    colors: Colors | None  # a plain color for each face
    materials: Ints32 | None  # (f,), index into the material names of the object; None for zeros


class _CopiedInstances:
    """Collector of a scene's triangles and of copies of its instances."""

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
        """Add a copy of a part, transformed to the instance with index `row`."""
        matrix = shared.transforms[row]
        count = len(part.faces)
        corners = part.faces[:, ::-1] if self._mirrored[row] else part.faces
        self._meshes.append((part.vertices @ matrix[:, :3].T + matrix[:, 3], corners))
        self._owners.append(np.full(count, shared.owner[row]))
        self._colors.append(part.colors)
        self._materials.append(part.materials)
        self.counters.append(np.full(count, len(self._scene.faces) + row))

    def scene(self) -> Scene:
        """Return a scene with all triangles and actors, but without instances."""
        vertices, faces = stack_meshes(self._meshes)
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
        if self._scene.materials is None:
            return None
        rows = [
            np.zeros(len(owners), np.int32) if materials is None else materials
            for owners, materials in zip(self._owners, self._materials, strict=True)
        ]
        return ObjectMaterials(self._scene.materials.names, np.concatenate(rows))


def _simplify_for_drawing(part: MeshPart, share: float) -> _DrawnPart:
    """Simplify a part to the given fraction of its triangles.

    Each triangle has its mean color.
    """
    vertices = part.vertices
    faces = part.faces
    rows = np.arange(len(part.faces))
    count = max(MIN_PART_TRIANGLES, int(len(faces) * share))
    if count < len(faces):
        vertices, faces, rows = _simplify_part(part, count)
    colors = part.colors and Colors.from_face_colors(part.colors.take(rows).mean_colors())
    materials = part.materials and part.materials.take(rows)
    return _DrawnPart(vertices, faces, colors, None if materials is None else materials.index)


def cut_masks(scene: Scene) -> Scene:
    """Replace masked triangles with small opaque triangles, for drawing.

    The hit counters of the scene do not change.
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
    """Divide the triangles of a masked part into pieces and return the opaque pieces.

    There are about `max_pieces` pieces in total. The mask is sampled at one random point in each
    piece, so that the proportion of opaque pieces is correct for arbitrarily fine masks.
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
    opaque[0, 0] |= not opaque.any()  # a part must not be empty
    face, piece = np.nonzero(opaque)
    vertices = (corners[piece] @ part.vertices[part.faces[face]]).reshape(-1, 3)
    colors = part.colors and part.colors.subdivide(face, corners[piece])
    return MeshPart(
        vertices,
        np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
        colors=colors,
        materials=part.materials and part.materials.take(face),
    )


def _piece_corners(steps: int) -> Floats:
    """Return the barycentric coordinates of the corners of a triangle's pieces.

    Each edge of the triangle is divided into `steps` segments. The shape is (steps², 3, 3).
    """
    i, j = (n.ravel() for n in np.mgrid[:steps, :steps])
    # Pieces beyond the diagonal are rotated by 180 degrees to fill the gaps between the others.
    first = np.stack([[i, j], [i + 1, j], [i, j + 1]], axis=-1).transpose(1, 2, 0)
    pieces = np.where((i + j < steps)[:, None, None], first, steps - first)
    return np.asarray(
        np.concatenate([pieces, steps - pieces.sum(axis=2, keepdims=True)], axis=2) / steps
    )


def _triangle_shares(
    shared: Instances, max_triangles: int, near_positions: Sequence[Floats]
) -> Floats:
    """Return the fraction of triangles that remain when each instance is drawn.

    Half of the triangles are distributed evenly. The other half is distributed by the squared
    distance to the nearest position, so that all triangles appear about equally large from there.
    The shape is (n,).
    """
    even_fraction = min(1.0, max_triangles / shared.triangles)
    positions = np.concatenate([np.empty((0, 3)), *near_positions])
    if even_fraction == 1 or not len(positions):
        return np.full(len(shared), even_fraction)
    centers = shared.bounds.mean(axis=1)
    distance = np.full(len(shared), np.inf)
    for position in positions[:: len(positions) // _MAX_POSITIONS + 1]:
        np.minimum(distance, np.linalg.norm(centers - position, axis=1), out=distance)
    distance += 1e-3
    full_distance = distance.max()  # up to this distance, instances keep all triangles
    while True:
        # Shares are powers of four, since each distinct share requires a separate mesh.
        near_fraction = 4.0 ** np.floor(np.log2(np.minimum(full_distance / distance, 1)))
        fractions = np.maximum(near_fraction, even_fraction / 2)
        if fractions @ shared.sizes <= max_triangles:
            return fractions
        full_distance *= 0.9


class _SimplifiedPart(NamedTuple):
    vertices: Floats  # (v, 3)
    faces: Ints32  # (k, 3)
    face_indices: Indices  # (k,), index of the original face


def _simplify_part(part: MeshPart, max_triangles: int) -> _SimplifiedPart:
    """Reduce a part to at most `max_triangles` while preserving its appearance.

    Merging vertices would remove most of a part that consists of many small pieces, such as the
    leaves of a tree. In this case, the largest triangles (trunk and branches) are kept, and the
    other triangles are sampled at random and enlarged to preserve the total area (Cook et al.,
    2007). Long triangles are enlarged less because they would stick out.
    """
    # A connected surface has about half as many vertices as faces.
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


def simplify_scene(scene: Scene, max_triangles: int) -> tuple[Scene, Ints]:
    """Reduce a scene to at most `max_triangles` and map the original triangles to the new ones.

    Returns
    -------
    tuple[Scene, Ints]
        The reduced scene, and the index of the triangle that replaces each original triangle. The
        index is -1 for triangles of small objects that disappear. Shape (f,).
    """
    merged = _merge_vertices(scene.vertices, scene.faces, max_triangles)
    owners = scene.face_object[merged.face_indices]
    colors = scene.colors and scene.colors.take(merged.face_indices)
    faces = merged.faces[merged.face_indices]
    coarse = Scene(merged.vertices, faces, owners, scene.names, scene.origin, colors=colors)
    return coarse, merged.substitutes


class _MergedMesh(NamedTuple):
    """A mesh in which all vertices in the same grid cell are merged."""

    vertices: Floats  # (v, 3)
    faces: Ints32  # (f, 3), indices of the merged vertices for all original faces
    face_indices: Indices  # (k,), distinct faces that are not collapsed
    substitutes: Ints  # (f,), index into `face_indices` of the replacement of each face, or -1


def _merge_vertices(points: Floats, corners: Ints32, max_triangles: int) -> _MergedMesh:
    """Merge all vertices in the same grid cell (Rossignac and Borrel, 1993).

    The cell size is about the smallest one that leaves at most `max_triangles` faces.
    """
    area = float(triangle_areas(points[corners]).sum())
    cell = (2 * area / max_triangles) ** 0.5
    while True:
        merged, counts = _grid_cells(points, cell)
        faces = merged[corners].astype(np.int32)
        collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
        full = np.flatnonzero(~collapsed)
        keys = _sort_keys(np.sort(faces[full], axis=1))
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
    """Return the index of an adjacent face for each vertex, or -1 for isolated vertices."""
    face_at_vertex = np.full(vertex_count, -1, np.int64)
    face_at_vertex[faces.ravel()] = np.repeat(np.arange(len(faces)), 3)
    return face_at_vertex


def _grid_cells(points: Floats, cell: float) -> tuple[Ints, Ints]:
    """Return the grid cell of each point and the number of points in each cell.

    Only cells that contain points are numbered.
    """
    columns = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, merged, counts = np.unique(_sort_keys(columns), return_inverse=True, return_counts=True)
    return merged, counts


def _sort_keys(rows: AnyArray) -> Ints:
    """Return one number for each row. The numbers sort in the same order as the rows.

    The rows consist of nonnegative integers. Sorting the numbers is faster than sorting the rows.
    Rows have shape (n, 3), and the result has shape (n,).
    """
    row_numbers = np.zeros(len(rows), np.int64)
    for column in rows.T.astype(np.int64):
        leading = _compact(row_numbers)
        trailing = _compact(column)
        row_numbers = leading * (int(trailing.max(initial=0)) + 1) + trailing
    return row_numbers


def _compact(numbers: Ints) -> Ints:
    """Replace integers with values below 2³¹ that sort in the same order.

    A product of two such values fits into 64 bits.
    """
    if numbers.max(initial=0) >= 1 << 31:
        return np.unique(numbers, return_inverse=True)[1]
    return numbers
