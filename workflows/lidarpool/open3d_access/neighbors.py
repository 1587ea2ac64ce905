"""Nearest neighbor search with Open3D."""

from __future__ import annotations

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints

from .open3d_module import load_open3d


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
    core = load_open3d().core
    # Squared distances between coordinates far from zero would lose precision.
    origin = reference.mean(axis=0)
    tree = core.nns.NearestNeighborSearch(core.Tensor(reference - origin))
    tree.knn_index()
    index, square = tree.knn_search(core.Tensor(points - origin), 1)
    return np.sqrt(square.numpy()[:, 0]), index.numpy()[:, 0]
