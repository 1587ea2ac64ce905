"""Searches a file for points: those that a filter keeps, or those before a camera."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from ..columns.cloud import Cloud
from ..export.cloud_file import CloudFile
from .looking import Eye, Filter

VIEW_POINTS = 500_000  # of all in a browser, and as many of what is seen from near
BLOCK = 1 << 15  # rows that are read at a time
_KEPT = 0.8  # of the points, as often as they are too many
Search = Generator[float, None, tuple[Cloud, int]]


class Blocks:
    """A file in blocks of rows; remembers the bounding box of each block read.

    `origin` is the world position of the local origin, (3,). At most `most` points of the whole are
    shown, and as many of a near view.
    """

    def __init__(self, file: CloudFile, origin: NDArray[np.float64], most: int) -> None:
        self.file, self._origin, self.most = file, origin, most
        # NaN for unread blocks; 48 bytes each, 150 kB for a hundred million points.
        self._boxes = np.full((-(-len(file) // BLOCK), 2, 3), np.nan)

    def search(
        self,
        wanted: Filter,
        most: int,
        eye: Eye | None = None,
        shares: NDArray[np.float64] | None = None,
    ) -> Search:
        """Search for points, block by block; yields the share that was searched.

        Returns at most `most` of the points that pass the filter, evenly spaced and in order, and
        the number of all of them. With an eye, only those in its picture count, and this share of
        each of its parts, (t,).
        """
        random, kept, thin, found, held = np.random.default_rng(0), [], 1.0, 0, 0
        low, high = self.file.rows_of(wanted.of("scan") or self.file.scans)
        numbers = range(low // BLOCK, -(-high // BLOCK))
        empty = self.file.piece(0, 0)
        for number in numbers:
            if not self._may_be_seen(number, eye):
                continue
            yield (number - numbers.start) / len(numbers)
            start = number * BLOCK
            piece = self.file.piece(max(low, start), min(high, start + BLOCK))
            if low <= start and high >= min(start + BLOCK, len(self.file)) and len(piece):
                self._boxes[number] = piece.bounds - self._origin
                if not self._may_be_seen(number, eye):
                    continue
            rows = np.flatnonzero(wanted.keeps(piece))
            share = np.full(len(rows), thin)
            if eye is not None and shares is not None:
                tiles = eye.tiles(piece.positions[rows] - self._origin)
                share *= np.where(tiles >= 0, shares[tiles], 0.0)
            found += len(rows)
            rows = rows[random.random(len(rows)) < share]
            kept.append(piece.part(rows))
            held += len(rows)
            while held > most:
                thin *= _KEPT
                cloud = Cloud.joined(kept)
                kept = [cloud.part(np.flatnonzero(random.random(len(cloud)) < _KEPT))]
                held = len(kept[0])
        return Cloud.joined(kept or [empty]), found

    def _may_be_seen(self, number: int, eye: Eye | None) -> bool:
        box = self._boxes[number]
        return eye is None or bool(np.isnan(box[0, 0])) or eye.may_see(box)
