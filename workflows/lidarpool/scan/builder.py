"""The merged cloud: parts in any order in, points ordered by (scan, ray) out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from poolpart import Ledger

from ..cloud import Cloud
from .messages import POINT, Part


class CloudBuilder:
    """Takes parts as they come and drops scans that it has already.

    Parameters
    ----------
    scan_count
        Scans of the survey.
    """

    def __init__(self, scan_count: int) -> None:
        self.ledger = Ledger(scan_count)
        self.point_count = 0
        self._tables: list[NDArray[np.void] | None] = [None] * scan_count

    def add(self, part: Part) -> list[int]:
        """Enter a part; returns the scans that were new."""
        new = []
        start = 0
        for scan, count in zip(part.scans, part.counts, strict=True):
            if self.ledger.accept(scan):
                new.append(scan)
                # A view of the part's table: all of a part is kept, or nearly all.
                self._tables[scan] = part.points[start : start + count]
                self.point_count += count
            start += count
        return new

    def merge(self, precision_m: float, origin: NDArray[np.float64]) -> Cloud:
        """Put the whole cloud together, positions in float64.

        Parameters
        ----------
        precision_m
            Size of the cells that the points were rounded to.
        origin
            World position of the scene's local origin, (3,), metres.
        """
        tables = [t for t in self._tables if t is not None]
        points = np.concatenate(tables) if tables else np.empty(0, POINT)
        positions = points["cell"] * precision_m + origin
        # Multiplying leaves 0.07 at 0.07000000000000001; the nearest short decimal is meant.
        digits = max(0, int(np.ceil(-np.log10(precision_m))) + 3)
        np.round(positions, digits, out=positions)
        return Cloud(
            positions=positions,
            scan=points["scan"].astype(np.int32),
            ring=points["ring"].copy(),
            object=points["object"].copy(),
        )
