"""An even choice of some of many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def one_of_each_part(
    count: int, most: int, rng: np.random.Generator | None = None
) -> NDArray[np.int64]:
    """At most `most` of the numbers below `count`, in order, one from each of equal parts.

    Which of each part is left to chance: of points that are ordered by scan and ray, every n-th
    could always be of the same few rings, or look one way.

    Parameters
    ----------
    count, most
        Of how many, and how many at most; all of them where they are no more.
    rng
        What chooses; without it the choice is the same each time.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    parts = min(count, most)
    edges = np.arange(parts + 1, dtype=np.int64) * count // max(parts, 1)
    return rng.integers(edges[:-1], edges[1:])
