"""Nearest neighbor search with Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints

from .open3d_module import load_open3d


class NeighborSearch:
    """Search for neighbors among the points of a reference cloud.

    Parameters
    ----------
    reference
        Points of the reference cloud in meters, shape (m, 3).
    radius
        Radius of `within` in meters, or None if only nearest neighbors are required.
    """

    def __init__(self, reference: Floats, radius: float | None = None) -> None:
        self._core = load_open3d().core
        # Squared distances between coordinates far from zero would lose precision.
        self._origin = reference.mean(axis=0)
        self._radius = radius
        self._tree: Any = self._core.nns.NearestNeighborSearch(self._tensor(reference))
        self._tree.knn_index()
        if radius is not None:
            self._tree.hybrid_index(radius)

    def _tensor(self, points: Floats) -> Any:
        return self._core.Tensor(np.ascontiguousarray(points - self._origin))

    def nearest(self, points: Floats, count: int = 1) -> tuple[Floats, Ints]:
        """Find the nearest reference points of each point, in order of their distances.

        Returns
        -------
        The distances in meters and the indices of the reference points, each of shape (n, count).
        """
        index, square = self._tree.knn_search(self._tensor(points), count)
        return np.sqrt(square.numpy()), index.numpy()

    def within(self, points: Floats, max_count: int) -> tuple[Ints, Ints]:
        """Find the nearest reference points within the radius of the search.

        Returns
        -------
        The indices of the reference points, of shape (n, max_count) and padded with negative
        values, and the numbers of neighbors, of shape (n,).
        """
        index, _, counts = self._tree.hybrid_search(self._tensor(points), self._radius, max_count)
        return index.numpy(), counts.numpy()


def nearest_neighbors(points: Floats, reference: Floats) -> tuple[Floats, Ints]:
    """Find the nearest point in a reference cloud for each of the given points.

    Parameters
    ----------
    points
        Query points in meters, shape (n, 3).
    reference
        Points of the reference cloud in meters, shape (m, 3).

    Returns
    -------
    The distances in meters and the indices of the nearest reference points, each of shape (n,).
    """
    distance, index = NeighborSearch(reference).nearest(points)
    return distance[:, 0], index[:, 0]
