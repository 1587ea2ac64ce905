"""Where rays enter the box of a scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TINY = 2.0**-60  # stands for a direction component of zero, so that nothing becomes 0 * inf


def clip(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances at which rays enter (0 when they start inside) and leave a box.

    A ray meets the box where ``entry <= leave``.

    Parameters
    ----------
    low, high
        (3,): the box.
    origins
        (n, 3) or (1, 3).
    directions
        (n, 3), unit vectors.
    """
    entry = np.zeros(len(directions))
    leave = np.full(len(directions), np.inf)
    for axis in range(3):
        along = directions[:, axis]
        along = np.where(np.abs(along) < TINY, np.copysign(TINY, along), along)
        one = (low[axis] - origins[:, axis]) / along
        two = (high[axis] - origins[:, axis]) / along
        np.maximum(entry, np.minimum(one, two), out=entry)
        np.minimum(leave, np.maximum(one, two), out=leave)
    return entry, leave
