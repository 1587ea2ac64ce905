"""A scene's triangles for rendering: closest hits and smooth normals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarsim.base.arrays import AnyFloats, Floats, Integers, Ints
from lidarsim.scene.scene import Scene
from raybeam import RayCaster

# Faces that meet at a flatter angle than this are shaded as one smooth surface.
CREASE_COSINE = np.cos(np.radians(35))
_DEPTH_LEVELS = 5  # levels for objects that are neighbors
_MIN_SQUARE = 0.1  # squared length of the mean normal at corners that move no farther


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, their ray caster, and their normals."""

    scene: Scene
    caster: RayCaster
    face_normals: Floats  # (f, 3) unit length; zero for degenerate triangles
    vertex_normals: Floats  # (v, 3) unit length, weighted by area; zero if faces cancel out

    @classmethod
    def from_scene(cls, scene: Scene, backend: str = "auto") -> Surface:
        """Prepare a scene for rendering."""
        a, b, c = (scene.vertices[scene.faces[:, k]] for k in range(3))
        doubled = np.cross(b - a, c - a)
        at_vertices = np.zeros_like(scene.vertices)
        for corner in scene.faces.T:
            for k in range(3):
                at_vertices[:, k] += np.bincount(corner, doubled[:, k], len(at_vertices))
        caster = RayCaster(scene.vertices, scene.faces, backend=backend)
        return cls(scene, caster, unit(doubled), unit(at_vertices))

    def normals(self, triangle: Ints, u: Floats, v: Floats, towards: Floats) -> Floats:
        """Return shading normals (n, 3) at hits, on the side of the ray.

        Interpolated from the corners (Phong 1975), except across creases, where the face's normal
        replaces a corner's. `towards` (n, 3) are the directions of the rays.
        """
        flat = self.face_normals[triangle]
        corners = self.scene.faces[triangle]
        smooth = np.zeros_like(flat)
        for corner, weight in enumerate((1 - u - v, u, v)):
            normal = self.vertex_normals[corners[:, corner]]
            creased = dot(normal, flat) < CREASE_COSINE
            smooth += weight[:, None] * np.where(creased[:, None], flat, normal)
        smooth = unit(smooth)
        smooth[dot(flat, towards) > 0] *= -1
        return smooth


def separate_objects(scene: Scene, objects: Integers, step: float) -> Scene:
    """Move surfaces inwards a little, so that objects in contact do not show through.

    Each vertex moves against the mean of the normals around it, weighted by angle (Thürmer and
    Wüthrich, 1998), so that the sides of a box all move by `step` meters, or up to three times as
    far: neighbors in the list of objects (f,) differ, as walls that cross have sides in one plane.
    """
    vertices = scene.vertices
    a, b, c = (vertices[scene.faces[:, k]] for k in range(3))
    normals = unit(np.cross(b - a, c - a))
    corner_index = _shared_corners(scene, objects)
    count = int(corner_index.max(initial=-1)) + 1
    mean = np.zeros((count, 3))
    total_angle = np.full(count, 1e-30)
    inwards = np.zeros(count)
    corners = zip((a, b, c), (b, c, a), (c, a, b), corner_index[scene.faces].T, strict=True)
    for position, next_position, previous_position, corner in corners:
        angle = np.arccos(
            np.clip(dot(unit(next_position - position), unit(previous_position - position)), -1, 1)
        )
        total_angle += np.bincount(corner, angle, count)
        for k in range(3):
            mean[:, k] += np.bincount(corner, angle * normals[:, k], count)
        inwards[corner] = step * (1 + objects % _DEPTH_LEVELS / 2)
    mean /= total_angle[:, None]
    inwards /= np.maximum(dot(mean, mean), _MIN_SQUARE)
    return replace(scene, vertices=vertices - (inwards[:, None] * mean)[corner_index])


def _shared_corners(scene: Scene, objects: Integers) -> Ints:
    """Return a number (v,) for each vertex, shared by vertices of an object at the same position.

    Files such as .stl have three vertices for each triangle, which must not come apart.
    """
    key = np.zeros(len(scene.vertices), np.uint64)
    key[scene.faces] = objects[:, None]
    for bits in (scene.vertices + 0.0).view(np.uint64).T:  # a hash; 0.0 makes -0.0 positive
        key = (key ^ bits) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    return np.unique(key, return_inverse=True)[1]


def dot(a: AnyFloats, b: AnyFloats) -> AnyFloats:
    """Return the scalar products (...,) of vectors (..., 3)."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def spiral(count: int, lowest: float = 0.0, highest: float = 1.0) -> Floats:
    """Spread unit vectors (count, 3) over the sphere between two heights: a golden spiral."""
    n = np.arange(count)
    azimuth = 2 * np.pi * 0.6180339887 * n
    height = lowest + (highest - lowest) * (n + 0.5) / count
    level = np.sqrt(1 - height * height)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)


def unit(vectors: Floats) -> Floats:
    """Scale vectors (n, 3) to length 1, except zero vectors."""
    length = np.sqrt(dot(vectors, vectors))[:, None]
    return vectors / np.where(length > 0, length, 1.0)
