"""Scenes as pictures and plans need them: all triangles, instances simplified if they are many."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .instances import Part
from .mesh import stacked, triangle_areas
from .scene import Scene

DRAWN_TRIANGLES = 2_000_000  # of instances; of more, each gets its share of fewer
PART_LEAST = 32  # triangles of a simplified part


@dataclass(frozen=True, eq=False)
class Drawn:
    """A scene without instances, and which counter of hits its triangles have.

    `scene` is the `same` if that has no instances. `counter` is intp (f,), see `Scene.counters`.
    """

    scene: Scene
    counter: NDArray[np.intp]
    same: bool = False

    @classmethod
    def of(cls, scene: Scene, most: int = DRAWN_TRIANGLES) -> Drawn:
        """Copy all instances to their places, with at most about so many triangles."""
        faces = len(scene.faces)
        if (shared := scene.instances) is None:
            return cls(scene, np.arange(faces), same=True)
        share = min(1.0, most / shared.triangles)
        meshes = [(scene.vertices, scene.faces)]
        owners, counters = [scene.face_object], [np.arange(faces)]
        mirrored = np.linalg.det(shared.transforms[:, :, :3]) < 0
        for number, part in enumerate(shared.parts):
            vertices, own = part.vertices, part.faces
            size = max(PART_LEAST, int(len(own) * share))
            if size < len(own):
                vertices, own = _fewer(part, size)
            for row in np.flatnonzero(shared.part == number):
                matrix = shared.transforms[row]
                corners = own[:, ::-1] if mirrored[row] else own
                meshes.append((vertices @ matrix[:, :3].T + matrix[:, 3], corners))
                owners.append(np.full(len(own), shared.owner[row]))
                counters.append(np.full(len(own), faces + row))
        vertices, triangles = stacked(meshes)
        owner = np.concatenate(owners).astype(np.int32)
        drawn = Scene(vertices, triangles, owner, scene.names, scene.origin, scene.actors)
        return cls(drawn, np.concatenate(counters))

    def hits(self, counts: NDArray[Any]) -> NDArray[Any]:
        """Hits of each triangle that is drawn, from counters; those of actors follow."""
        if self.same:
            return counts
        area = triangle_areas(self.scene.vertices[self.scene.faces]) + np.finfo(np.float64).tiny
        share = area / np.bincount(self.counter, area, len(counts))[self.counter]
        moving = sum(len(actor.mesh.faces) for actor in self.scene.actors)
        return np.append(counts[self.counter] * share, counts[len(counts) - moving :])


def _fewer(part: Part, most: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices and at most so many faces that stand for a part.

    What falls apart when its vertices are merged, as a tree's leaves do, is a choice of its
    triangles instead, made larger (Cook et al., 2007).
    """
    vertices, faces, kept, _ = _merged(part.vertices, part.faces, most)
    if len(kept) >= most // 4:
        return vertices, faces[kept]
    some = np.random.default_rng(0).choice(len(part.faces), most, replace=False)
    corners = part.vertices[part.faces[some]]
    middle = corners.mean(axis=1, keepdims=True)
    larger = middle + (corners - middle) * (len(part.faces) / most) ** 0.5
    return larger.reshape(-1, 3), np.arange(3 * most, dtype=np.int32).reshape(-1, 3)


def simplified(scene: Scene, most: int) -> tuple[Scene, NDArray[np.int64]]:
    """Give a scene of fewer triangles; and for each triangle of this one which stands for it.

    That is -1 where nothing is left of a small object.
    """
    vertices, faces, kept, stands = _merged(scene.vertices, scene.faces, most)
    owners = scene.face_object[kept]
    return Scene(vertices, faces[kept], owners, scene.names, scene.origin), stands


def _merged(
    points: NDArray[np.float64], corners: NDArray[np.int32], most: int
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.intp], NDArray[np.int64]]:
    """Merge vertices in the same cell of a grid (Rossignac and Borrel, 1993).

    Returns vertices, faces (f, 3), those that are kept, at most so many, and what `simplified`
    does.
    """
    area = float(triangle_areas(points[corners]).sum())
    cell, low = (2 * area / most) ** 0.5, points.min(axis=0)
    while True:
        at = np.floor((points - low) / cell).astype(np.int64)
        _, merged, counts = np.unique(at, axis=0, return_inverse=True, return_counts=True)
        faces = merged.reshape(-1)[corners].astype(np.int32)
        first, second, third = faces.T
        flat = (first == second) | (second == third) | (third == first)
        wide = np.flatnonzero(~flat)
        _, owner, same = np.unique(
            np.sort(faces[wide], axis=1), axis=0, return_index=True, return_inverse=True
        )
        if len(owner) <= most:
            break
        cell *= 1.3
    vertices = np.stack(
        [np.bincount(merged.reshape(-1), axis) / counts for axis in points.T], axis=1
    )
    kept = wide[owner]
    stands = np.full(len(faces), -1, np.int64)
    stands[wide] = same.reshape(-1)
    near = np.full(len(vertices), -1, np.int64)  # a triangle at each vertex
    near[faces[kept].ravel()] = np.repeat(np.arange(len(kept)), 3)
    small = np.flatnonzero(flat)
    stands[small] = near[faces[small]].max(axis=1)
    return vertices, faces, kept, stands
