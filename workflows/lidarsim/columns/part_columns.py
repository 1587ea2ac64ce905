"""Columns of the points of consecutive scans, as a batch returns and a part stores them.

`x`, `y` and `z` are cells: whole multiples of the precision from the scene's local origin, so that
positions are rounded only once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..numerics.arrays import AnyArray, Floats, Floats32, Integers, Ints, Ints32, UInts32
from ..numerics.elementary import decade
from .cloud import Cloud
from .table import AXES, SCAN, Column
from .waveforms import WAVEFORM

_BLOCK_CELLS = 1 << 13  # cells that are turned into positions at a time


@dataclass(frozen=True)
class PartColumns:
    """Content of a part."""

    first: int  # number of the first scan
    counts: Ints  # (scans,): rows of each scan
    columns: Mapping[str, AnyArray]  # {name: (rows,)}, positions as cells
    # (k,): hit counters that are not 0 (`Scene.counters`); an instance has one for all triangles
    triangles: Ints32
    hits: Ints  # (k,): number of hits of each of these counters
    # (scans,) and (scans, samples, 3): hits of each scan, and ends of sampled rays, meters, local
    # coordinates, NaN in unused rows; empty in a part that is not stored.
    scan_hits: UInts32 = field(default_factory=lambda: np.zeros(0, np.uint32))
    samples: Floats32 = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))

    def __len__(self) -> int:
        return int(self.counts.sum())

    @property
    def stop(self) -> int:
        """Number of the scan after the last scan."""
        return self.first + len(self.counts)

    @property
    def cell_box(self) -> Ints | None:
        """Lowest and highest cells, (2, 3), or None without rows."""
        if not len(self):
            return None
        axes = [self.columns[axis.name] for axis in AXES]
        return np.array([[a.min() for a in axes], [a.max() for a in axes]], np.int64)

    def scan_column(self) -> Ints32:
        """Return the scan of each row."""
        scans = np.arange(self.first, self.stop, dtype=np.int32)
        return np.repeat(scans, self.counts)

    def cloud(
        self,
        table: Sequence[Column],
        precision_m: float,
        origin: Floats,
        row_selection: Integers | slice = slice(None),
        sweeps: Callable[[], Any] | None = None,
    ) -> Cloud:
        """Return a cloud of the points of the part, or of selected rows.

        Parameters
        ----------
        table
            Columns beside the positions.
        precision_m
            Size of a cell, meters.
        origin
            (3,): world position of cell 0, meters.
        row_selection
            Rows of the points, as integers or a slice.
        sweeps
            Function that returns the sweeps of the survey (`Cloud`).
        """
        cells = np.stack([self.columns[axis.name][row_selection] for axis in AXES], axis=1)
        columns = {
            c.name: self.scan_column()[row_selection]
            if c is SCAN
            else self.columns[c.name][row_selection]
            for c in table
        }
        if WAVEFORM in self.columns:
            columns[WAVEFORM] = self.columns[WAVEFORM][row_selection]
        return Cloud(positions_of(cells, precision_m, origin), columns, tuple(table), sweeps)


def decimals_of(precision_m: float) -> int:
    """Return the number of decimals that positions in cells of `precision_m` are rounded to.

    Multiplying gives 0.07000000000000001 for 0.07; positions are the nearest short decimals.
    """
    return max(0, 3 - decade(precision_m))


def positions_of(cells: AnyArray, precision_m: float, origin: Floats | float) -> Floats:
    """Return world coordinates, meters, of points in cells of `precision_m`.

    Cells are whole numbers, (n, 3) with an origin (3,), or (n,) along an axis with a coordinate.
    """
    digits = decimals_of(precision_m)
    positions = np.empty(cells.shape)
    for start in range(0, len(cells), _BLOCK_CELLS):  # intermediate values stay in the cache
        block = slice(start, start + _BLOCK_CELLS)
        unrounded = cells[block] * precision_m
        unrounded += origin
        np.round(unrounded, digits, out=positions[block])
    return positions
