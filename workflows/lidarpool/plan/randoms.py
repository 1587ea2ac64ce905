"""Cheap random numbers that are the same on every machine."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

_PLACES = 1021  # starts of windows in a table, before they repeat


class Randoms:
    """Single-precision random numbers from a seed.

    NumPy guarantees the raw output of its bit generators, but not that of its `Generator`
    (NEP 19), so the last step is done here.

    Parameters
    ----------
    seed
        Below 2**64.
    """

    def __init__(self, seed: int) -> None:
        self._bits = np.random.SFC64(seed)

    def uniform(self, count: int) -> NDArray[np.float32]:
        """Numbers uniform in [0, 1), multiples of 2**-24: (count,)."""
        high = self._bits.random_raw(count) >> np.uint64(40)
        return high.astype(np.float32) * np.float32(2**-24)

    def normal(self, count: int) -> NDArray[np.float32]:
        """Numbers of mean 0 and variance 1, nearly normal: (count,).

        Each is the sum of four uniform ones (Irwin-Hall), the four quarters of a raw number,
        so none is beyond 3.5. The exact distribution would need logarithms, which are not the
        same on every machine.
        """
        raw = self._bits.random_raw(count)
        total = np.zeros(count, np.uint64)
        for quarter in range(4):
            total += (raw >> np.uint64(16 * quarter)) & np.uint64(0xFFFF)
        # Four whole numbers below 2**16 have mean 2 (2**16 - 1) and variance near 2**32 / 3.
        centred = total.astype(np.float32) - np.float32(2 * (2**16 - 1))
        return centred * np.float32(math.sqrt(3) / 2**16)

    def below(self, end: int, count: int) -> list[int]:
        """Draw whole numbers from 0 to end - 1, for an `end` far below 2**64."""
        return (self._bits.random_raw(count) % np.uint64(end)).tolist()


class Windows:
    """A table of numbers, read through windows at random places.

    New random numbers for each move of a swarm would cost as much as all its other arithmetic.
    So they are drawn once, and a draw is a view of the table from a random start. Draws
    overlap, but a number serves another particle and coordinate in each. After a thousand
    draws the starts repeat.

    Parameters
    ----------
    table
        The numbers.
    count
        Numbers in a window, fewer than in the table.
    randoms
        Source of the starts.
    """

    def __init__(self, table: NDArray[np.float32], count: int, randoms: Randoms) -> None:
        self._table = table
        self._count = count
        self._starts = itertools.cycle(randoms.below(len(table) - count + 1, _PLACES))

    def draw(self) -> NDArray[np.float32]:
        """Numbers, (count,): a view, not to be written to."""
        start = next(self._starts)
        return self._table[start : start + self._count]
