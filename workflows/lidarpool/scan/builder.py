"""Takes the points of scans in any order and knows where each scan's lie."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from poolpart import Ledger

from .merged import StoredCloud
from .messages import Part
from .point_store import PointStore, TemporaryStore


class CloudBuilder:
    """Takes parts as they come and drops scans that it has already.

    The points go to a store on disk. What stays in memory is a few numbers for each scan.

    Parameters
    ----------
    scan_count
        Scans of the survey.
    store
        Where the points go; by default a temporary file.
    """

    def __init__(self, scan_count: int, store: PointStore | None = None) -> None:
        self.ledger = Ledger(scan_count)
        self.point_count = 0
        self._store = TemporaryStore() if store is None else store
        self._offsets = np.zeros(scan_count, np.int64)  # in the store, of each scan's points
        self._counts = np.zeros(scan_count, np.int64)  # points of each scan
        self._lowest = np.full(3, np.iinfo(np.int32).max, np.int64)  # cells, see POINT
        self._highest = -self._lowest
        # Called with the points (POINT) of scans that were new, once they are kept.
        self.on_points: Callable[[NDArray[np.void]], None] | None = None

    def add(self, part: Part) -> list[int]:
        """Enter a part; returns the scans that were new.

        Raises
        ------
        LidarpoolError
            If the store is full; then none of the part was entered.
        """
        seen: set[int] = set()
        is_new = []
        for scan in part.scans:
            is_new.append(scan not in self.ledger and scan not in seen)
            seen.add(scan)
        new = [scan for scan, fresh in zip(part.scans, is_new, strict=True) if fresh]
        counts = [count for count, fresh in zip(part.counts, is_new, strict=True) if fresh]
        if new:
            points = part.points
            if len(new) < len(part.scans):
                points = points[np.repeat(is_new, part.counts)]
            # First on disk, then in the ledger: what could not be kept was not delivered.
            self._enter(new, counts, self._store.append(new, counts, points), points)
        for scan in part.scans:
            self.ledger.accept(scan)
        if new and self.on_points:
            self.on_points(points)
        return new

    def restore(
        self, scans: NDArray[np.uint32], counts: NDArray[np.uint32], offset: int, points: np.ndarray
    ) -> None:
        """Enter scans whose points (POINT) an earlier run has put into the store at `offset`.

        Raises
        ------
        IndexError
            If there is no such scan.
        """
        self.ledger.restore(scans.tolist())
        self._enter(scans, counts, offset, points)

    def merge(self, precision_m: float, origin: NDArray[np.float64]) -> StoredCloud:
        """Return the whole cloud in (scan, ray) order; it stays where it is until it is read.

        Parameters
        ----------
        precision_m
            Size of the cells that the points were rounded to.
        origin
            World position of the scene's local origin, (3,), metres.
        """
        cells = np.stack([self._lowest, self._highest]) if self.point_count else None
        return StoredCloud(self._store, self._offsets, self._counts, cells, precision_m, origin)

    def stored_points(self) -> Iterator[NDArray[np.void]]:
        """Read the points (POINT) so far in (scan, ray) order, a part at a time."""
        yield from self.merge(1.0, np.zeros(3)).stored_points()

    def _enter(
        self,
        scans: list[int] | NDArray[np.uint32],
        counts: list[int] | NDArray[np.uint32],
        offset: int,
        points: np.ndarray,
    ) -> None:
        ends = np.cumsum(counts, dtype=np.int64)
        self._offsets[scans] = offset + (ends - counts) * points.itemsize
        self._counts[scans] = counts
        self.point_count += len(points)
        if len(points):
            cells = points["cell"]
            np.minimum(self._lowest, cells.min(axis=0), out=self._lowest)
            np.maximum(self._highest, cells.max(axis=0), out=self._highest)
