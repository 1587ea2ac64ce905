"""The scene's triangles as they are displayed: coarser where they are many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene import Scene
from ..view.intensity import checked_counts, hit_density

MOST_TRIANGLES = 100_000  # 48 bytes each, whenever their colours have changed

Floats = NDArray[np.float64]


class DisplaySurface:
    """A scene, or a coarser one of nearly its shape, and the hits on it.

    Vertices in the same cell of a grid become one (Rossignac and Borrel, 1993). Hits on a
    triangle go to its corners and from these to the coarse triangles around, by area.

    Parameters
    ----------
    scene
        The scene.
    most
        Triangles that there may be.
    """

    def __init__(self, scene: Scene, most: int = MOST_TRIANGLES) -> None:
        self._scene = scene
        # For each vertex of the scene that of the coarse one; None where they are the same.
        self._vertex: NDArray[np.int64] | None = None
        self.coarse = scene
        cell = _first_cell(scene, most)
        while len(self.coarse.faces) > most:
            self.coarse, self._vertex = _clustered(scene, cell)
            cell *= 1.5
        self.corners = self.coarse.vertices[self.coarse.faces].astype(np.float32)  # (f, 3, 3)

    def density(self, hit_counts: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """Hits per square metre at each coarse triangle, and whether it was hit itself; both (f,).

        Parameters
        ----------
        hit_counts
            (f,) hits of each triangle of the scene.
        """
        hits = checked_counts(self._scene, hit_counts)
        if self._vertex is not None:
            hits = self._moved(hits)
        return hit_density(self.coarse, hits), hits > 0

    def _moved(self, hits: Floats) -> Floats:
        """Hits on the scene's triangles as hits on the coarse ones; the total stays the same."""
        assert self._vertex is not None
        count = len(self.coarse.vertices)
        at = np.zeros(count)
        for corner in self._scene.faces.T:
            at += np.bincount(self._vertex[corner], weights=hits / 3, minlength=count)
        area = _areas(self.coarse)
        room = np.zeros(count)
        for corner in self.coarse.faces.T:
            room += np.bincount(corner, weights=area, minlength=count)
        dense = np.divide(at, room, out=np.zeros(count), where=room > 0)
        return np.asarray(area * dense[self.coarse.faces].sum(axis=1))


def _areas(scene: Scene) -> Floats:
    a, b, c = (scene.vertices[scene.faces[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _first_cell(scene: Scene, most: int) -> float:
    """Size of cells, in metres, that a surface of this area fills about `most` / 2 of."""
    return float(np.sqrt(2 * _areas(scene).sum() / most)) or 1.0


def _clustered(scene: Scene, cell: float) -> tuple[Scene, NDArray[np.int64]]:
    """Give the coarse scene, and for each vertex the coarse one that it went into."""
    low = scene.vertices.min(axis=0)
    places = np.floor((scene.vertices - low) / cell).astype(np.int64)
    across = places.max(axis=0) + 1
    keys = (places[:, 0] * across[1] + places[:, 1]) * across[2] + places[:, 2]
    _, vertex = np.unique(keys, return_inverse=True)
    count = int(vertex.max()) + 1
    size = np.bincount(vertex, minlength=count)
    middles = np.stack([np.bincount(vertex, v, count) / size for v in scene.vertices.T], axis=1)
    faces = vertex[scene.faces]
    a, b, c = faces.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    if not len(kept):  # all within one cell: something must be shown
        kept = np.zeros(1, np.int64)
    _, first = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True)
    kept = kept[np.sort(first)]
    coarse = Scene(
        middles,
        faces[kept].astype(np.int32),
        scene.face_object[kept],
        scene.names,
        scene.origin,
    )
    return coarse, vertex
