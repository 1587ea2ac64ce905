"""Evenly spaced samples."""

from __future__ import annotations

import numpy as np

from .arrays import Ints


def even_indices(count: int, max_count: int) -> Ints:
    """Return at most `max_count` indices below `count`, ascending, of equal parts.

    All indices are returned if `count` is at most `max_count`; else the choice within each part is
    random, and the same each time: of points ordered by scan and ray, every n-th could be of few
    rings or directions.
    """
    parts = min(count, max_count)
    edges = np.arange(parts + 1, dtype=np.int64) * count // max(parts, 1)
    return np.random.default_rng(0).integers(edges[:-1], edges[1:])
