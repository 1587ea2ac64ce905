"""What is kept of a scan's hits, and what is counted of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .hits import Gathering, Returns, ScanReturns
from .scan import Scan


class Collector:
    """Takes the hits of a scan, chunk after chunk in ray order.

    Parameters
    ----------
    scan
        Tells what to keep and what to count.
    face_count
        Number of the mesh's triangles.

    Examples
    --------
    >>> from raybeam.scan import check_scan
    >>> from raybeam import Pattern
    >>> pattern = Pattern([[1, 0, 0]] * 10)
    >>> collector = Collector(check_scan(pattern, [0, 0, 0], keep_every=2, groups=[0, 5]), 1)
    >>> ray = np.array([1, 2, 3, 6, 7])
    >>> ray[collector.keep(ray, 0, 10)].tolist()
    [1, 3, 6]
    """

    def __init__(self, scan: Scan, face_count: int) -> None:
        self._groups, self._every = scan.groups, scan.keep_every
        self._hits = np.zeros(len(scan.groups), np.int64)
        self._tally = np.zeros(face_count, np.int64) if scan.tally else None
        self._kept = Gathering()

    def keep(
        self, ray: NDArray[np.integer[Any]], start: int, stop: int
    ) -> slice | NDArray[np.intp]:
        """Count the hits of rays `start` to `stop` and choose those to keep.

        Parameters
        ----------
        ray
            (m,): numbers of the rays that hit, ascending, counted from `start`.

        Returns
        -------
        What selects the kept ones: rows of `ray`, or all.
        """
        first = int(np.searchsorted(self._groups, start, side="right")) - 1
        last = int(np.searchsorted(self._groups, stop, side="left"))
        begins = (self._groups[first + 1 : last] - start).astype(ray.dtype)
        cuts = np.concatenate([[0], np.searchsorted(ray, begins), [len(ray)]])
        counts = np.diff(cuts)
        groups = slice(first, first + len(counts))
        before = self._hits[groups].copy()  # of the first group, in the chunks before this one
        self._hits[groups] += counts
        if self._every == 1:
            return slice(None)
        # Of each group: the row of the first one kept, and how many are.
        leave = -before % self._every
        if len(counts) == 1:
            return np.arange(leave[0], len(ray), self._every)
        number = np.maximum(-((leave - counts) // self._every), 0)
        offset = cuts[:-1] + leave - self._every * (np.cumsum(number) - number)
        rows: NDArray[np.intp] = np.repeat(offset, number)
        rows += self._every * np.arange(len(rows))
        return rows

    def tally(self, triangle: NDArray[np.int32]) -> None:
        """Count all hits of a chunk by triangle, if that was asked for."""
        if self._tally is not None:
            np.add.at(self._tally, triangle.astype(np.intp), 1)

    def add(self, kept: Returns) -> None:
        """Take kept hits; raises MemoryError when they could not be joined any more."""
        self._kept.add(kept)

    def result(self) -> ScanReturns:
        """Everything that was taken and counted."""
        kept = self._kept.returns()
        return ScanReturns(kept.ray, kept.distance, kept.triangle, self._hits, self._tally)
