"""Selection of evenly distributed samples."""

from __future__ import annotations

import numpy as np

from .arrays import Ints


def even_indices(count: int, max_count: int) -> Ints:
    """Return at most `max_count` ascending indices that are evenly distributed below `count`.

    If `count` does not exceed `max_count`, all indices are returned. Otherwise, the range is
    divided into equal intervals, and one index is selected from each interval at random with a
    fixed seed. A constant stride would not be representative: if points are ordered by scan and
    ray, every n-th point may belong to only a few rings or directions.
    """
    parts = min(count, max_count)
    edges = np.arange(parts + 1, dtype=np.int64) * count // max(parts, 1)
    return np.random.default_rng(0).integers(edges[:-1], edges[1:])
