"""An evenly spaced sample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def one_of_each_part(
    count: int, most: int, rng: np.random.Generator | None = None
) -> NDArray[np.int64]:
    """Choose at most `most` numbers below `count`, in order, one from each of equal parts.

    The choice within each part is random: in points ordered by scan and ray, every n-th could
    always be of the same few rings or directions.

    Parameters
    ----------
    count, most
        Size of the population, and of the sample; all numbers if they are no more.
    rng
        Random generator; without it the choice is always the same.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    parts = min(count, most)
    edges = np.arange(parts + 1, dtype=np.int64) * count // max(parts, 1)
    return rng.integers(edges[:-1], edges[1:])
