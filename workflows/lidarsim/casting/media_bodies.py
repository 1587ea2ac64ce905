"""Closed surfaces of water, glass or leaves, which contain a medium."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..media.materials import MaterialTable
from ..numerics.arrays import Bools, Floats, Integers
from ..numerics.vectors import inverse, matvec, norm
from ..scene.scene import Scene
from .triangle_kinds import TriangleKinds


class MediaBodies:
    """Bodies of a scene that contain a medium, indexed by kind of surface."""

    def __init__(self, scene: Scene, kinds: TriangleKinds, table: MaterialTable) -> None:
        self._scene = scene
        self._kinds = kinds
        self._table = table
        self._static_objects = len(scene.names)

    @cached_property
    def solids(self) -> tuple[Bools, Bools]:
        """Masks of the surface kinds that are closed, and of those that are inside out.

        Both are arrays of shape (kinds,). A closed surface is inside out if its volume is negative.
        """
        table = self._table
        scene = self._scene
        closed = np.ones(len(table.reflectance), np.bool_)
        volume = np.zeros(len(closed))
        for kind in np.flatnonzero(table.leafy | table.refracts).tolist():
            bodies: list[tuple[Floats, Integers]] = []
            owner = int(self._kinds.material_kinds.object[kind])
            if owner >= self._static_objects:
                mesh = scene.actors[owner - self._static_objects].mesh
                bodies.append((mesh.vertices, self._kinds.select(kind, mesh.faces, mesh.materials)))
            else:
                bodies.append((scene.vertices, self._kinds.faces_of(kind)))
            if scene.instances is not None:
                for row in np.unique(scene.instances.part[scene.instances.owner == owner]):
                    part = scene.instances.mesh_parts[row]
                    faces = self._kinds.select(kind, part.faces, part.materials)
                    bodies.append((part.vertices, faces))
            for vertices, faces in bodies:
                if not len(faces):
                    continue
                closed[kind] &= _closed(vertices, faces)
                volume[kind] += _volume(vertices, faces)
        return closed, closed & (volume < 0)

    @cached_property
    def static_kinds(self) -> tuple[int, ...]:
        """Surface kinds of the closed static bodies that contain a medium, including instances."""
        table = self._table
        closed, _ = self.solids
        holds_medium = (table.leafy | table.refracts) & closed
        holds_medium &= self._kinds.material_kinds.object < self._static_objects
        return tuple(np.flatnonzero(holds_medium).tolist())

    def offset_vertices(self, by_m: float) -> Floats:
        """Return the scene's vertices, with the surfaces of media moved outward by `by_m` meters.

        Water that touches its basin, or leaves that touch other leaves, would otherwise coincide
        with the other surface, and light that hits one of the two surfaces would miss the other.
        """
        if not self.static_kinds:
            return self._scene.vertices
        vertices = self._scene.vertices.copy()
        inwards = self.solids[1]
        for kind in self.static_kinds:
            faces = self._kinds.faces_of(kind)
            if not len(faces):
                continue
            vertex_rows, corners = np.unique(faces, return_inverse=True)
            positions, vertex_position = np.unique(
                vertices[vertex_rows], axis=0, return_inverse=True
            )
            vertex_position = vertex_position.reshape(-1)
            corners = vertex_position[corners.reshape(-1)].reshape(-1, 3)
            a, b, c = positions[corners].transpose(1, 0, 2)
            normals = np.cross(b - a, c - a) * (-1 if inwards[kind] else 1)
            normals /= np.maximum(norm(normals)[:, None], 1e-300)
            # Move each vertex so that all its triangles are `by_m` farther out, in the
            # least-squares sense.
            squares = np.zeros((len(positions), 3, 3))
            sums = np.zeros((len(positions), 3))
            np.add.at(squares, corners, (normals[:, :, None] * normals[:, None])[:, None])
            np.add.at(sums, corners, normals[:, None])
            squares += 1e-3 * np.eye(3)
            step = by_m * matvec(inverse(squares), sums)
            positions += np.clip(step, -4 * by_m, 4 * by_m)
            vertices[vertex_rows] = positions[vertex_position]
        return vertices


def _closed(vertices: Floats, faces: Integers) -> bool:
    """Return whether each edge of a surface joins two consistently wound triangles."""
    vertex_rows, corners = np.unique(faces, return_inverse=True)
    # With flat shading, triangles share positions but not vertices.
    _, vertex_position = np.unique(vertices[vertex_rows], axis=0, return_inverse=True)
    corners = vertex_position.reshape(-1)[corners.reshape(-1)].reshape(-1, 3).astype(np.int64)
    starts = corners.reshape(-1)
    stops = np.roll(corners, -1, axis=1).reshape(-1)
    edges = starts != stops
    starts = starts[edges]
    stops = stops[edges]
    forward = np.sort(starts * len(vertex_rows) + stops)
    backward = np.sort(stops * len(vertex_rows) + starts)
    return bool(np.array_equal(forward, backward))


def _volume(vertices: Floats, faces: Integers) -> float:
    """Return the volume in m³ enclosed by a surface.

    It is negative if the surface is inside out.
    """
    a, b, c = (vertices[faces] - vertices[faces[0, 0]]).transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)
