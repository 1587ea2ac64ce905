"""Correlation of ranks."""

from __future__ import annotations

import numpy as np

from ..base.arrays import AnyArray, Floats


def rank_correlation(a: AnyArray, b: AnyArray) -> float | None:
    """Spearman's rank correlation, ties with their mean rank; None if one is constant or empty.

    Examples
    --------
    >>> rank_correlation(np.array([1.0, 2.0, 5.0, 9.0]), np.array([4.0, 3.0, 2.0, 1.0]))
    -1.0
    """
    if not len(a):
        return None
    ranks: list[Floats] = []
    for values in (a, b):
        _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
        ends = np.cumsum(counts)
        rank = (ends - (counts - 1) / 2)[inverse]
        ranks.append(rank - rank.mean())
    size = np.sqrt((ranks[0] @ ranks[0]) * (ranks[1] @ ranks[1]))
    return float(ranks[0] @ ranks[1] / size) if size else None
