"""Nearest points, found by Open3D."""

from __future__ import annotations

import numpy as np

from lidarsim.base.arrays import Floats, Ints

from .open3d_module import load_open3d


def nearest(points: Floats, reference: Floats) -> tuple[Floats, Ints]:
    """Return distances (n,) to the nearest points of a reference, meters, and indices (n,)."""
    core = load_open3d().core
    origin = reference.mean(axis=0)  # far from zero, squares would lose their digits
    tree = core.nns.NearestNeighborSearch(core.Tensor(reference - origin))
    tree.knn_index()
    index, square = tree.knn_search(core.Tensor(points - origin), 1)
    return np.sqrt(square.numpy()[:, 0]), index.numpy()[:, 0]
