"""Random numbers that cost next to nothing, and are the same wherever they are drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_TABLE_WINDOWS = 4  # length of a table, in windows


class Randoms:
    """Uniform single-precision numbers from a seed.

    NumPy keeps the raw output of its bit generators for ever the same, but not what its
    `Generator` makes of it (NEP 19), so the last step is done here.

    Parameters
    ----------
    seed
        Below 2**64.
    """

    def __init__(self, seed: int) -> None:
        self._bits = np.random.SFC64(seed)

    def uniform(self, count: int) -> NDArray[np.float32]:
        """Numbers in [0, 1), multiples of 2**-24: (count,)."""
        high = self._bits.random_raw(count) >> np.uint64(40)
        return high.astype(np.float32) * np.float32(2**-24)

    def below(self, end: int) -> int:
        """Draw a whole number from 0 to end - 1, for an `end` far below 2**64."""
        return int(self._bits.random_raw()) % end

    def windows(self, count: int, scale: float) -> Windows:
        """Return a source of `count` numbers at a time, uniform in [0, scale)."""
        return Windows(self, count, scale)


class Windows:
    """A table of random numbers, read through windows at random places.

    Fresh numbers for each move of a swarm would cost as much as all its other arithmetic. Here
    they are drawn once; a draw is a view of the table that starts anywhere. Draws overlap, but
    a number serves another particle, coordinate and time in each.
    """

    def __init__(self, randoms: Randoms, count: int, scale: float) -> None:
        self._count = count
        self._randoms = randoms
        self._table = randoms.uniform(_TABLE_WINDOWS * count) * np.float32(scale)
        self._starts = (_TABLE_WINDOWS - 1) * count + 1

    def draw(self) -> NDArray[np.float32]:
        """Numbers, (count,): a view, not to be written to."""
        start = self._randoms.below(self._starts)
        return self._table[start : start + self._count]
