"""Points as they are displayed: few enough to send to a browser, several times a second."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# `position` is in metres from the page's origin, `range` in metres from the sensor, NaN where
# it is not known.
DISPLAY = np.dtype(
    [
        ("position", "<f4", (3,)),
        ("scan", "<i4"),
        ("ring", "<u2"),
        ("object", "<i4"),
        ("range", "<f4"),
    ]
)

# Multiples of the golden section, modulo 1, as fractions of 2**64: any first n of them are
# spread evenly (Knuth, The Art of Computer Programming 3, 6.4), and numbers whose multiple is
# small keep no fixed distance, as every n-th would, which could always meet the same ring.
_GOLDEN = np.uint64(11_400_714_819_323_198_485)


class PointSample:
    """An even choice of points that come bit by bit, never more than so many.

    Whenever there is no room, half of the points kept so far are dropped, and from then on half
    as many are taken. The choice depends on the order of the points alone.

    Parameters
    ----------
    capacity
        Most points that are kept; at least 1.

    Examples
    --------
    >>> sample = PointSample(100)
    >>> taken = sample.choose(1000)
    >>> sample.put(np.zeros(len(taken), DISPLAY))
    >>> len(sample.rows), sample.seen
    (62, 1000)
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"The capacity is {capacity}; it must be at least 1.")
        self.capacity = capacity
        self.seen = 0  # points that there were
        self._kept = 0
        self._rows = np.empty(capacity, DISPLAY)
        self._places = np.empty(capacity, np.uint64)  # of the rows, in the golden sequence
        self._chosen = np.empty(0, np.uint64)  # places of those that `put` is to bring
        self._halvings = 0

    def choose(self, count: int) -> NDArray[np.int64]:
        """Say which of the next `count` points are wanted; `put` must bring them next."""
        places = np.arange(self.seen, self.seen + count, dtype=np.uint64) * _GOLDEN
        self.seen += count
        while True:
            wanted = (
                np.flatnonzero(places >> np.uint64(64 - self._halvings) == 0)
                if (self._halvings)
                else np.arange(count)
            )
            if self._kept + len(wanted) <= self.capacity:
                self._chosen = places[wanted]
                return wanted
            self._halve()

    def put(self, rows: NDArray[np.void]) -> None:
        """Enter the rows (DISPLAY) that were chosen."""
        if len(rows) != len(self._chosen):
            raise ValueError(f"{len(rows)} rows were put where {len(self._chosen)} were chosen.")
        place = slice(self._kept, self._kept + len(rows))
        self._rows[place], self._places[place] = rows, self._chosen
        self._kept += len(rows)
        self._chosen = self._chosen[:0]

    @property
    def rows(self) -> NDArray[np.void]:
        """The points kept now, in the order in which they came; a copy."""
        return self._rows[: self._kept].copy()

    def _halve(self) -> None:
        self._halvings += 1
        places = self._places[: self._kept]
        stay = np.flatnonzero(places >> np.uint64(64 - self._halvings) == 0)
        self._rows[: len(stay)] = self._rows[stay]
        self._places[: len(stay)] = places[stay]
        self._kept = len(stay)
