"""Point columns of consecutive scans, which a batch returns and a part stores.

`x`, `y` and `z` are stored as cells, which are integer multiples of the precision, relative to the
scene's local origin. Positions are therefore rounded only once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..numerics.arrays import AnyArray, Floats, Floats32, Integers, Ints, Ints32, Records, UInts32
from ..numerics.elementary import decade
from .actor_rays import NO_ACTOR_RAYS
from .cloud import Cloud
from .table import AXES, SCAN, Column
from .waveforms import WAVEFORM

_BLOCK_CELLS = 1 << 13  # cells converted to positions at a time


@dataclass(frozen=True)
class PartColumns:
    """Point columns that are stored in a part."""

    first: int  # number of the first scan
    counts: Ints  # (scans,), rows per scan
    columns: Mapping[str, AnyArray]  # {name: (rows,)}, with positions as cells
    # (k,), indices of the nonzero hit counters (`Scene.counters`). All triangles of an instance
    # share one counter.
    triangles: Ints32
    hits: Ints  # (k,), number of hits for each index in `triangles`
    # Both arrays are empty in a part that is not stored.
    scan_hits: UInts32 = field(default_factory=lambda: np.zeros(0, np.uint32))  # (scans,)
    # (scans, samples, 3), end points of sampled rays in local coordinates, meters; NaN if unused
    samples: Floats32 = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    # (k,), visibility records of actors in the scans, of type `ACTOR_RAYS`
    actor_rays: Records = field(default_factory=NO_ACTOR_RAYS.copy)

    def __len__(self) -> int:
        return int(self.counts.sum())

    @property
    def stop(self) -> int:
        """Number of the last scan plus 1."""
        return self.first + len(self.counts)

    @property
    def cell_box(self) -> Ints | None:
        """Minimum and maximum positions as cells, or None if the part has no rows.

        The shape is (2, 3).
        """
        if not len(self):
            return None
        axes = [self.columns[axis.name] for axis in AXES]
        return np.array([[a.min() for a in axes], [a.max() for a in axes]], np.int64)

    def scan_column(self) -> Ints32:
        """Return the scan number of each row."""
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
        """Convert the part, or a selection of its rows, to a cloud.

        Parameters
        ----------
        table
            Columns to include in addition to the positions.
        precision_m
            Cell size in meters.
        origin
            World position of cell 0 in meters. Shape (3,).
        row_selection
            Rows to include, as integers or a slice.
        sweeps
            Function that returns the sweeps of the survey; see `Cloud`.
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
        return Cloud(cell_positions(cells, precision_m, origin), columns, tuple(table), sweeps)


def position_decimals(precision_m: float) -> int:
    """Return the number of decimals to which positions are rounded, given the cell size.

    Multiplying a cell by its size may return 0.07000000000000001 instead of 0.07, which rounding
    corrects.
    """
    return max(0, 3 - decade(precision_m))


def cell_positions(cells: AnyArray, precision_m: float, origin: Floats | float) -> Floats:
    """Convert cells of size `precision_m` to world coordinates in meters.

    The cells have shape (n, 3) if `origin` is a position of shape (3,), or shape (n,) if they are
    the cells along one axis and `origin` is a coordinate.
    """
    digits = position_decimals(precision_m)
    positions = np.empty(cells.shape)
    for start in range(0, len(cells), _BLOCK_CELLS):  # keeps intermediate values in the CPU cache
        block = slice(start, start + _BLOCK_CELLS)
        unrounded = cells[block] * precision_m
        unrounded += origin
        np.round(unrounded, digits, out=positions[block])
    return positions
