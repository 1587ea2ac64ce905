"""Where the rays of a chunk are made for an engine that reads them in float32."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Workspace:
    """Arrays for a chunk of rays, made once and used for chunk after chunk.

    Fresh pages of memory for every chunk would cost a quarter of what casting it does.

    Parameters
    ----------
    size
        Most rays of a chunk.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._rows = np.empty((size, 6), np.float32)
        self._given, self._unit = np.empty((2, 3, size))
        self._product = np.empty(size)
        self._origin: NDArray[np.float64] | None = None  # where all rows start, if at one point

    def start(self, n: int, origins: NDArray[np.float64]) -> NDArray[np.float32]:
        """Write where n rays start, and return their rows as an engine reads them.

        Parameters
        ----------
        n
            Number of rays.
        origins
            (n, 3), or (1, 3) for all: then nothing is written when it is the same as last time.

        Returns
        -------
        (n, 6): origins, and the directions that `turn` wrote.
        """
        if len(origins) > 1:
            self._origin = None
            self._rows[:n, :3] = origins
        elif self._origin is None or not np.array_equal(origins, self._origin):
            self._origin = origins.copy()
            self._rows[:, :3] = origins
        return self._rows[:n]

    def turn(
        self, directions: NDArray[np.float64], rotation: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Turn directions (n, 3) and write them to the rows.

        They are turned in float64, with the operations of `raybeam.rays.rotated` and so to the
        same bits, and rounded when they are written: that costs 2 ns a ray more than turning
        them in float32, a tenth of what the cast costs, and is three times as exact.

        Returns
        -------
        (3, n) float64, valid until the next call: the turned directions, one row an axis.
        """
        n = len(directions)
        unit, product = self._unit[:, :n], self._product[:n]
        if rotation is None:
            np.copyto(unit, directions.T)
            self._rows[:n, 3:] = directions
            return unit
        given = self._given[:, :n]
        np.copyto(given, directions.T)
        for axis, (a, b, c) in enumerate(rotation):
            total = np.multiply(given[0], a, out=unit[axis])
            total += np.multiply(given[1], b, out=product)
            total += np.multiply(given[2], c, out=product)
            self._rows[:n, 3 + axis] = total
        return unit
