"""Columns of the points of some consecutive scans, as a batch gives them and as a part holds them.

`x`, `y` and `z` are cells: whole multiples of the precision from the scene's local origin, so that
positions are rounded only once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.arrays import AnyArray, Floats, Floats32, Integers, Ints, Ints32, UInts32
from ..base.elementary import decade
from .cloud import Cloud
from .table import AXES, SCAN, Column
from .waveforms import WAVEFORM


@dataclass(frozen=True)
class PartColumns:
    """Content of a part."""

    first: int  # scan
    counts: Ints  # (scans,): rows of each scan
    columns: Mapping[str, AnyArray]  # {name: (rows,)}, positions as cells
    triangles: Ints32  # (k,): those that were hit
    hits: Ints  # (k,): all their hits
    # (scans,) and (scans, samples, 3): hits of each scan, and ends of some of its rays, metres,
    # local coordinates, NaN where there are fewer; empty in a part that is not stored.
    scan_hits: UInts32 = field(default_factory=lambda: np.zeros(0, np.uint32))
    samples: Floats32 = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))

    def __len__(self) -> int:
        return int(self.counts.sum())

    @property
    def stop(self) -> int:
        """One past its last scan."""
        return self.first + len(self.counts)

    @property
    def cells(self) -> Ints | None:
        """Lowest and highest cell, (2, 3); None without rows."""
        if not len(self):
            return None
        axes = [self.columns[axis.name] for axis in AXES]
        return np.array([[a.min() for a in axes], [a.max() for a in axes]], np.int64)

    def scan_column(self) -> Ints32:
        """Scan of each row."""
        scans = np.arange(self.first, self.stop, dtype=np.int32)
        return np.repeat(scans, self.counts)

    def cloud(
        self,
        table: Sequence[Column],
        precision_m: float,
        origin: Floats,
        rows: Integers | slice = slice(None),
        sweeps: Callable[[], Any] | None = None,
    ) -> Cloud:
        """Points of the part, or some of its rows, with these columns beside the positions.

        Their cells are of `precision_m`, from the world position `origin`, (3,), metres; `sweeps`
        as of `Cloud`.
        """
        cells = np.stack([self.columns[axis.name][rows] for axis in AXES], axis=1)
        columns = {
            c.name: self.scan_column()[rows] if c is SCAN else self.columns[c.name][rows]
            for c in table
        }
        if WAVEFORM in self.columns:
            columns[WAVEFORM] = self.columns[WAVEFORM][rows]
        return Cloud(positions_of(cells, precision_m, origin), columns, tuple(table), sweeps)


def positions_of(cells: Integers, precision_m: float, origin: Floats) -> Floats:
    """Return world coordinates (n, 3), metres, of points in cells (n, 3) of `precision_m`."""
    positions: Floats = cells * precision_m + origin
    # Multiplying gives 0.07000000000000001 for 0.07; take the nearest short decimal.
    digits = max(0, 3 - decade(precision_m))
    return np.round(positions, digits, out=positions)
