"""Prepare the triangles of a scene for rendering, with ray casting and smooth normals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarsim.numerics.arrays import AnyFloats, Floats, Integers, Ints
from lidarsim.scene.scene import Scene
from raybeam import RayCaster

# Faces that meet at a flatter angle than this are shaded as one smooth surface.
CREASE_COSINE = np.cos(np.radians(35))
_DEPTH_LEVELS = 5  # number of distances by which consecutive objects move
_MIN_SQUARE = 0.1  # minimum squared length of the mean normal; limits the movement of corners


@dataclass(frozen=True, eq=False)
class RenderMesh:
    """The triangles of a scene with their ray caster and their normals."""

    scene: Scene
    caster: RayCaster
    face_normals: Floats  # (f, 3) unit length; zero for degenerate triangles
    vertex_normals: Floats  # (v, 3) unit length, weighted by area; zero if faces cancel out

    @classmethod
    def from_scene(cls, scene: Scene, backend: str = "auto") -> RenderMesh:
        """Prepare a scene for rendering."""
        a, b, c = (scene.vertices[scene.faces[:, k]] for k in range(3))
        doubled = np.cross(b - a, c - a)
        at_vertices = np.zeros_like(scene.vertices)
        for corner in scene.faces.T:
            for k in range(3):
                at_vertices[:, k] += np.bincount(corner, doubled[:, k], len(at_vertices))
        caster = RayCaster(scene.vertices, scene.faces, backend=backend)
        return cls(scene, caster, normalize(doubled), normalize(at_vertices))

    def normals(self, triangle: Ints, u: Floats, v: Floats, toward: Floats) -> Floats:
        """Return the shading normals at hits, facing the side from which the ray comes.

        The normals are interpolated between the corners (Phong 1975). At creases, the normal of the
        face replaces that of the corner. `toward` (n, 3) are the directions of the rays.
        """
        flat = self.face_normals[triangle]
        corners = self.scene.faces[triangle]
        smooth = np.zeros_like(flat)
        for corner, weight in enumerate((1 - u - v, u, v)):
            normal = self.vertex_normals[corners[:, corner]]
            creased = dot(normal, flat) < CREASE_COSINE
            smooth += weight[:, None] * np.where(creased[:, None], flat, normal)
        smooth = normalize(smooth)
        smooth[dot(flat, toward) > 0] *= -1
        return smooth


def separate_objects(scene: Scene, objects: Integers, step: float) -> Scene:
    """Move surfaces inward slightly so that touching objects do not show through each other.

    Each vertex moves against the angle-weighted mean of the surrounding normals (Thürmer and
    Wüthrich, 1998), so that the sides of a box all move by the same distance. The distance varies
    from `step` to three times `step` meters between consecutive objects, because walls that cross
    may have sides in the same plane. `objects` (f,) is the object of each face.
    """
    vertices = scene.vertices
    a, b, c = (vertices[scene.faces[:, k]] for k in range(3))
    normals = normalize(np.cross(b - a, c - a))
    corner_index = _shared_corners(scene, objects)
    count = int(corner_index.max(initial=-1)) + 1
    mean = np.zeros((count, 3))
    total_angle = np.full(count, 1e-30)
    inward = np.zeros(count)
    corners = zip((a, b, c), (b, c, a), (c, a, b), corner_index[scene.faces].T, strict=True)
    for position, next_position, previous_position, corner in corners:
        angle = np.arccos(
            np.clip(
                dot(normalize(next_position - position), normalize(previous_position - position)),
                -1,
                1,
            )
        )
        total_angle += np.bincount(corner, angle, count)
        for k in range(3):
            mean[:, k] += np.bincount(corner, angle * normals[:, k], count)
        inward[corner] = step * (1 + objects % _DEPTH_LEVELS / 2)
    mean /= total_angle[:, None]
    inward /= np.maximum(dot(mean, mean), _MIN_SQUARE)
    return replace(scene, vertices=vertices - (inward[:, None] * mean)[corner_index])


def _shared_corners(scene: Scene, objects: Integers) -> Ints:
    """Return a number for each vertex.

    Vertices of an object at the same position have the same number. In files such as .stl, each
    triangle has its own vertices, and these triangles must stay connected.
    """
    key = np.zeros(len(scene.vertices), np.uint64)
    key[scene.faces] = objects[:, None]
    # Hash the coordinates. Adding 0.0 turns -0.0 into 0.0.
    for bits in (scene.vertices + 0.0).view(np.uint64).T:
        key = (key ^ bits) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    return np.unique(key, return_inverse=True)[1]


def dot(a: AnyFloats, b: AnyFloats) -> AnyFloats:
    """Return the dot products of vectors."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def golden_spiral(count: int, lowest: float = 0.0, highest: float = 1.0) -> Floats:
    """Distribute unit vectors evenly over the sphere between two values of z."""
    n = np.arange(count)
    azimuth = 2 * np.pi * 0.6180339887 * n
    height = lowest + (highest - lowest) * (n + 0.5) / count
    level = np.sqrt(1 - height * height)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)


def normalize(vectors: Floats) -> Floats:
    """Scale vectors to unit length, except zero vectors."""
    length = np.sqrt(dot(vectors, vectors))[:, None]
    return vectors / np.where(length > 0, length, 1.0)
