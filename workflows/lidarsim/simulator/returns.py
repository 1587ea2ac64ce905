"""Returns of pulses, and the keys of random numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..base.arrays import (
    AnyArray,
    Bools,
    Bytes,
    Floats,
    Indices,
    Integers,
    Ints,
    Ints32,
    Records,
    UInts32,
)
from ..columns.table import CAUSES
from ..scene.colors import GRAY, packed

T = TypeVar("T")

NO_SURFACE = -1  # triangle and object of returns that are not from a surface
SURFACE = CAUSES.index("surface")


def selected(columns: Iterable[Any], row_selection: Any) -> Iterator[Any]:
    """Yield the selected rows of each column, or None for a column that is None."""
    for column in columns:
        if isinstance(column, np.ndarray) and column.flags.f_contiguous:  # twice as fast
            yield column.T.take(row_selection, axis=-1).T
        else:
            yield None if column is None else column[row_selection]


# Columns of every hit and return.
RETURN_COLUMNS = "ray", "distance", "triangle", "energy", "color", "cause"


class PulseReturns(NamedTuple):
    """Hits or returns of pulses, in the order of rays and distances: arrays (n,).

    Columns that no step of a survey writes are None. Before hits become returns, a ray is a
    sub-ray. Returns that are not from a surface have the triangle `NO_SURFACE`.
    """

    ray: Integers
    distance: Floats  # meters, without noise
    triangle: Ints32
    # Received (`Surfaces.energy`); None if `BatchPoints` computes it from the reported rays.
    energy: Floats | None = None
    # Packed (`Surfaces.colors`); None if it is not needed, or `BatchPoints` looks it up at the
    # ends of the rays.
    color: UInts32 | None = None
    cause: Bytes | None = None  # indices into `CAUSES`; None if all hits are on surfaces
    velocity: Floats | None = None  # radial, m/s, if a column stores it; NaN if unknown
    # Full width at half maximum in the waveform, ns, and its height; None without waveforms.
    width: Floats | None = None
    amplitude: Floats | None = None
    # Recorded (`columns.waveforms.record`); `BatchPoints` adds `location_ps` and `toward`.
    waveform: Records | None = None
    number: Bytes | None = None  # among the reported returns of its pulse, from 1
    return_counts: Bytes | None = None  # number of reported returns of its pulse
    reported: Floats | None = None  # distance with noise, meters

    @classmethod
    def empty(cls) -> PulseReturns:
        """Return a table without rows."""
        return cls(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int32))

    @classmethod
    def single_returns(cls, ray: Integers, distance: Floats, triangle: Ints32) -> PulseReturns:
        """Return a table where each ray (n,) has a single return, without noise."""
        single = np.ones(len(ray), np.uint8)
        return cls(ray, distance, triangle, number=single, return_counts=single, reported=distance)

    def take(self, row_selection: Bools | Indices) -> PulseReturns:
        """Return the selected rows of all columns."""
        if row_selection.dtype == np.bool_:  # a mask would be counted again for each column
            row_selection = np.flatnonzero(row_selection)
        return PulseReturns(*selected(self, row_selection))

    @property
    def height(self) -> Floats:
        """Heights of returns in the waveform (n,), or their energies without waveforms."""
        return required(self.energy if self.amplitude is None else self.amplitude)


# Normals of the surfaces of hits, and directions of the sub-rays at the sensor: (n, 3) each. The
# normals of surfaces that are seen in mirrors are reflected, as the surfaces appear to the sensor.
Planes = tuple[Floats, Floats]


def required(column: T | None) -> T:
    """Return a column that an earlier step has written, so never None."""
    assert column is not None
    return column


# Values of columns in the rows of tables that lack the column, where other tables have it.
_LACKING: dict[str, Any] = {"cause": np.uint8(SURFACE), "velocity": np.nan, "width": 0.0}


def joined(tables: list[PulseReturns]) -> PulseReturns:
    """Concatenate tables of hits. Columns outside `_LACKING` are in all tables, or in none."""
    if len(tables) == 1:
        return tables[0]
    return PulseReturns._make(_column(name, tables) for name in PulseReturns._fields)


def _column(name: str, tables: list[PulseReturns]) -> AnyArray | None:
    """Concatenate a column of several tables, or return None if all tables lack the column."""
    columns = [getattr(table, name) for table in tables]
    if all(column is None for column in columns):
        return None
    return np.concatenate(
        [
            np.full(len(table.ray), _LACKING[name]) if column is None else column
            for table, column in zip(tables, columns, strict=True)
        ]
    )


def returns_without_surface(
    template: PulseReturns, ray: Ints, distance: Floats, energy: Floats, cause: int
) -> PulseReturns:
    """Return a table of returns (n,) that are not from a surface, all of one cause.

    The table has the columns `color` and `amplitude` if the table `template` has these columns.
    """
    count = len(ray)
    return PulseReturns(
        ray,
        distance,
        np.full(count, NO_SURFACE, np.int32),
        energy,
        None if template.color is None else np.full(count, packed(GRAY[0])[0]),
        np.full(count, cause, np.uint8),
        amplitude=None if template.amplitude is None else energy,
    )


def merged(returns: PulseReturns, additions: PulseReturns) -> PulseReturns:
    """Merge two tables of returns, in the order of rays and distances."""
    if not len(additions.ray):
        return returns
    hits = joined([returns, additions])
    return hits.take(np.lexsort((hits.distance, hits.ray)))


@dataclass(frozen=True)
class Keys:
    """Keys of the random numbers of rays."""

    scan: int  # number of the first scan; of a frozen sensor, of the older scan that is sent again
    scan_starts: Ints  # (scans,): first ray of each scan

    def scan_and_number(self, ray: Integers) -> tuple[Ints, Ints]:
        """Return the scans of rays (n,), and the numbers of the rays in their scans: (n,) each."""
        index = np.searchsorted(self.scan_starts, ray, side="right") - 1
        return self.scan + index, ray - self.scan_starts[index]


def numbers(ray: Integers) -> Ints:
    """Return the number of each entry within its ray, from 0: (n,).

    The entries of a ray are consecutive.
    """
    return np.arange(len(ray)) - np.repeat(*runs(ray))


def runs(ray: Integers) -> tuple[Ints, Ints]:
    """Return the start and length of each run of returns from the same ray."""
    starts = np.flatnonzero(np.diff(ray, prepend=-1))
    return starts, np.diff(starts, append=len(ray))
