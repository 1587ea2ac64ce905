"""Points as they are displayed: few enough to send to a browser, several times a second.

What there is to colour them by follows from the columns of their cloud.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..columns.table import AXES, TABLE, Column

POSITION = ".position"  # field of the rows: metres from the page's origin; no column is called so
HEIGHT = Column("height", "float32", "m", "height above zero", coordinates="world")
RANGE = TABLE["range"]  # where it is not a column, the distance from the sensor's pose

# Multiples of the golden section, modulo 1, as fractions of 2**64: any first n of them are
# spread evenly (Knuth, The Art of Computer Programming 3, 6.4), and numbers whose multiple is
# small keep no fixed distance, as every n-th would, which could always meet the same channel.
_GOLDEN = np.uint64(11_400_714_819_323_198_485)
_BLOCK = 1 << 20  # points that are looked at together


def quantities(table: Iterable[Column], with_range: bool = True) -> tuple[Column, ...]:
    """List what points can be coloured by: height, range, and the columns of their cloud.

    Parameters
    ----------
    table
        The columns of the cloud; those of positions are left out.
    with_range
        Whether the range can be derived where it is not a column.
    """
    columns = tuple(column for column in table if column not in AXES)
    names = {column.name for column in columns}
    derived = (HEIGHT, RANGE) if with_range else (HEIGHT,)
    return (*(column for column in derived if column.name not in names), *columns)


def row_type(columns: Sequence[Column]) -> np.dtype[np.void]:
    """Type of the rows of displayed points: `POSITION`, and these columns by name."""
    fields = [(column.name, np.dtype(column.dtype)) for column in columns]
    return np.dtype([(POSITION, "<f4", (3,)), *fields])


def display_rows(
    columns: Sequence[Column],
    positions: NDArray[np.floating],
    origin: NDArray[np.float64],
    values: Mapping[str, NDArray[Any]],
    sensors: NDArray[np.floating],
) -> NDArray[np.void]:
    """Put rows together of what is known of some points.

    Parameters
    ----------
    columns
        The quantities that the rows are to have.
    positions
        (n, 3) metres, world coordinates.
    origin
        World position of the page's origin, (3,).
    values
        {column: (n,)}: the columns of their cloud.
    sensors
        (n, 3): where the sensor was, world coordinates; NaN where that is not known.
    """
    rows = np.empty(len(positions), row_type(columns))
    rows[POSITION] = positions - origin
    for column in columns:
        if column.name in values:
            rows[column.name] = values[column.name]
        elif column is HEIGHT:
            rows[column.name] = positions[:, 2]
        else:
            rows[column.name] = np.linalg.norm(positions - sensors, axis=1)
    return rows


class PointSample:
    """An even choice of points that come bit by bit, never more than so many.

    Whenever there is no room, half of the points kept so far are dropped, and from then on half
    as many are taken. The choice depends on the order of the points alone.

    Parameters
    ----------
    capacity
        Most points that are kept; at least 1.
    dtype
        Type of their rows.

    Examples
    --------
    >>> sample = PointSample(100, np.dtype("f4"))
    >>> taken = sample.choose(1000)
    >>> sample.put(np.zeros(len(taken), "f4"))
    >>> len(sample.rows), sample.seen
    (62, 1000)
    """

    def __init__(self, capacity: int, dtype: np.dtype[Any]) -> None:
        if capacity < 1:
            raise ValueError(f"The capacity is {capacity}; it must be at least 1.")
        self.capacity = capacity
        self.seen = 0  # points that there were
        self._kept = 0
        self._rows = np.empty(capacity, dtype)
        self._places = np.empty(capacity, np.uint64)  # of the rows, in the golden sequence
        self._chosen = np.empty(0, np.uint64)  # places of those that `put` is to bring
        self._halvings = 0

    def choose(self, count: int, held: int | None = None) -> NDArray[np.int64]:
        """Say which of the next `count` points are wanted; `put` must bring them next.

        Parameters
        ----------
        count
            How many come next.
        held
            How many of these are at hand, to stand for the others too: the answer is numbers
            below it. All are, by default.
        """
        held = count if held is None else held
        while count >> self._halvings > 2 * self.capacity:
            self._halve()
        while True:
            wanted, places = self._wanted(count)
            if self._kept + len(wanted) <= self.capacity:
                break
            self._halve()
        self.seen += count
        if held < count:
            some = wanted * held // count if held else wanted[:0]
            order = np.lexsort((places[: len(some)], some))
            wanted, first = np.unique(some[order], return_index=True)
            places = places[order[first]]  # of several the one that stays for longest
        self._chosen = places
        return wanted

    def put(self, rows: NDArray[Any]) -> None:
        """Enter the rows that were chosen."""
        if len(rows) != len(self._chosen):
            raise ValueError(f"{len(rows)} rows were put where {len(self._chosen)} were chosen.")
        place = slice(self._kept, self._kept + len(rows))
        self._rows[place], self._places[place] = rows, self._chosen
        self._kept += len(rows)
        self._chosen = self._chosen[:0]

    @property
    def rows(self) -> NDArray[Any]:
        """The points kept now, in the order in which they came; a copy."""
        return self._rows[: self._kept].copy()

    def _wanted(self, count: int) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
        """Numbers of the next points that are taken as things are, and their places."""
        found = [np.empty(0, np.int64)], [np.empty(0, np.uint64)]
        for first in range(0, count, _BLOCK):
            stop = min(first + _BLOCK, count)
            places = np.arange(self.seen + first, self.seen + stop, dtype=np.uint64) * _GOLDEN
            taken = np.flatnonzero(self._taken(places))
            found[0].append(first + taken)
            found[1].append(places[taken])
        return np.concatenate(found[0]), np.concatenate(found[1])

    def _taken(self, places: NDArray[np.uint64]) -> NDArray[np.bool_]:
        if not self._halvings:
            return np.ones(len(places), np.bool_)
        return np.asarray(places >> np.uint64(64 - self._halvings) == 0)

    def _halve(self) -> None:
        self._halvings += 1
        stay = np.flatnonzero(self._taken(self._places[: self._kept]))
        self._rows[: len(stay)] = self._rows[stay]
        self._places[: len(stay)] = self._places[stay]
        self._kept = len(stay)
