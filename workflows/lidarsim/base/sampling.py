"""An evenly spaced sample."""

from __future__ import annotations

import numpy as np

from .arrays import Ints


def even_indices(count: int, most: int) -> Ints:
    """Choose at most `most` numbers below `count`, in order, one from each of equal parts.

    All are chosen if they are no more; else the choice within each part is random, and the same
    each time: of points ordered by scan and ray, every n-th could be of few rings or directions.
    """
    parts = min(count, most)
    edges = np.arange(parts + 1, dtype=np.int64) * count // max(parts, 1)
    return np.random.default_rng(0).integers(edges[:-1], edges[1:])
