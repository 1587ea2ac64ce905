"""The merged cloud: points on disk, read in (scan, ray) order as many at a time as wanted."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..cloud import CHUNK_POINTS, Cloud
from .messages import POINT
from .point_store import PointStore


class StoredCloud:
    """Points in a store, ordered by scan and ray however they came; a `CloudLike`.

    Parameters
    ----------
    store
        Where they lie.
    offsets, counts
        int64 (scans,): where in the store the points of each scan begin, and how many they are.
    cells
        Lowest and highest cell of all points, (2, 3); None where there are no points.
    precision_m
        Size of the cells that the points were rounded to.
    origin
        World position of the scene's local origin, (3,), metres.
    """

    def __init__(
        self,
        store: PointStore,
        offsets: NDArray[np.int64],
        counts: NDArray[np.int64],
        cells: NDArray[np.int64] | None,
        precision_m: float,
        origin: NDArray[np.float64],
    ) -> None:
        self._store = store
        self._precision_m, self._origin = precision_m, origin
        held = np.flatnonzero(counts)
        # Number of the first point of each scan that has some, and of one past the last of all.
        self._firsts = np.concatenate([[0], np.cumsum(counts[held])])
        self._offsets = offsets[held]
        self._cells = cells

    def __len__(self) -> int:
        return int(self._firsts[-1])

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest coordinates, (2, 3), metres; zeros where there are no points."""
        return np.zeros((2, 3)) if self._cells is None else self._positions(self._cells)

    def chunks(self, points: int = CHUNK_POINTS) -> Iterator[Cloud]:
        """Read the cloud in order, so many points at a time.

        Raises
        ------
        OSError
            If the store cannot be read.
        """
        for rows in self.stored_points(points):
            yield Cloud(
                self._positions(rows["cell"]),
                rows["scan"].astype(np.int32),
                rows["ring"].copy(),
                rows["object"].copy(),
            )

    def stored_points(self, points: int = CHUNK_POINTS) -> Iterator[NDArray[np.void]]:
        """Read the points (POINT) as they are stored, in order, so many at a time.

        Raises
        ------
        OSError
            If the store cannot be read.
        """
        for first in range(0, len(self), points):
            yield self._read(first, min(first + points, len(self)))

    def load(self) -> Cloud:
        """Read the whole cloud into memory: 34 bytes a point."""
        count = len(self)
        positions = np.empty((count, 3))
        scan, ring = np.empty(count, np.int32), np.empty(count, np.uint16)
        owner = np.empty(count, np.int32)
        first = 0
        for chunk in self.chunks():
            part = slice(first, first + len(chunk))
            positions[part], scan[part] = chunk.positions, chunk.scan
            ring[part], owner[part] = chunk.ring, chunk.object
            first += len(chunk)
        return Cloud(positions, scan, ring, owner)

    def _read(self, first: int, stop: int) -> NDArray[np.void]:
        """Rows (POINT) `first` to `stop`, in order."""
        rows = np.empty(stop - first, POINT)
        buffer = rows.view(np.uint8).data
        low = int(np.searchsorted(self._firsts, first, "right")) - 1
        high = int(np.searchsorted(self._firsts, stop, "left"))
        # The pieces of the scans within, as bytes of the store; both ends may cut one.
        begins = np.maximum(self._firsts[low:high], first)
        ends = np.minimum(self._firsts[low + 1 : high + 1], stop)
        offsets = self._offsets[low:high] + (begins - self._firsts[low:high]) * POINT.itemsize
        lengths = (ends - begins) * POINT.itemsize
        # Scans that came together lie together, and are read together.
        breaks = np.flatnonzero(offsets[1:] != offsets[:-1] + lengths[:-1]) + 1
        starts = np.concatenate([[0], breaks])
        at = 0
        for offset, length in zip(
            offsets[starts].tolist(), np.add.reduceat(lengths, starts).tolist(), strict=True
        ):
            self._store.read_into(offset, buffer[at : at + length])
            at += length
        return rows

    def _positions(self, cells: NDArray[np.integer]) -> NDArray[np.float64]:
        """World coordinates, (n, 3), of points in these cells, (n, 3)."""
        positions = cells * self._precision_m + self._origin
        # Multiplying leaves 0.07 at 0.07000000000000001; the nearest short decimal is meant.
        digits = max(0, int(np.ceil(-np.log10(self._precision_m))) + 3)
        return np.round(positions, digits, out=positions)
