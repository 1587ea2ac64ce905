"""Table of returns that simulation steps exchange, and the keys of random numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..columns.table import CAUSES
from ..numerics.arrays import (
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
from ..scene.colors import GRAY, pack_colors

T = TypeVar("T")

NO_SURFACE = -1  # triangle and object number of returns that do not come from a surface
SURFACE = CAUSES.index("surface")


def select_rows(columns: Iterable[Any], row_selection: Any) -> Iterator[Any]:
    """Yield the selected rows of each column, or None for a column that is None."""
    for column in columns:
        if isinstance(column, np.ndarray) and column.flags.f_contiguous:  # twice as fast
            yield column.T.take(row_selection, axis=-1).T
        else:
            yield None if column is None else column[row_selection]


# Columns that every hit and every return has.
RETURN_COLUMNS = "ray", "distance", "triangle", "energy", "color", "cause"


class PulseReturns(NamedTuple):
    """Hits or returns of pulses, sorted by ray and distance.

    The columns have n rows.

    A column is None if no step of the survey writes it. Until hits are combined into returns,
    `ray` numbers sub-rays. Returns that do not come from a surface have the triangle `NO_SURFACE`.
    """

    ray: Integers
    distance: Floats  # meters, without noise
    triangle: Ints32
    # Received energy (`SceneSurfaces.energy`); None if `BatchPoints` computes it from the
    # reported rays.
    energy: Floats | None = None
    # Packed color (`SceneSurfaces.colors`); None if no column needs it, or if `BatchPoints` looks
    # it up at the end points of the rays.
    color: UInts32 | None = None
    cause: Bytes | None = None  # indices into `CAUSES`; None if all hits are on surfaces
    velocity: Floats | None = None  # radial, m/s, if a column stores it; NaN if unknown
    # Full width at half maximum of the pulse in ns, and its height; None without waveforms.
    width: Floats | None = None
    amplitude: Floats | None = None
    # Recorded waveform (`columns.waveforms.record`), to which `BatchPoints` adds `location_ps` and
    # `toward`.
    waveform: Records | None = None
    # Row of a recorded return in `RecordedPulses`, or -1 for other returns; None if rays are cast.
    source: Ints32 | None = None
    number: Bytes | None = None  # number among the reported returns of the pulse, starting at 1
    return_counts: Bytes | None = None  # number of reported returns of the pulse
    reported: Floats | None = None  # distance with noise, meters

    @classmethod
    def empty(cls) -> PulseReturns:
        """Return a table with no rows."""
        return cls(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int32))

    @classmethod
    def single_returns(cls, ray: Integers, distance: Floats, triangle: Ints32) -> PulseReturns:
        """Return a table in which each ray has a single return without noise."""
        single = np.ones(len(ray), np.uint8)
        return cls(ray, distance, triangle, number=single, return_counts=single, reported=distance)

    def take(self, row_selection: Bools | Indices) -> PulseReturns:
        """Return the selected rows of all columns."""
        if row_selection.dtype == np.bool_:  # convert a mask once instead of once per column
            row_selection = np.flatnonzero(row_selection)
            if len(row_selection) == len(self.ray):
                return self
        return PulseReturns(*select_rows(self, row_selection))

    @property
    def height(self) -> Floats:
        """Peak heights of the returns in the waveform, or energies if there is no waveform."""
        return require_column(self.energy if self.amplitude is None else self.amplitude)


# Surface normals of hits, and directions of the sub-rays at the sensor, each of shape (n, 3).
# Normals of surfaces seen in a mirror are reflected, as the surfaces appear to the sensor.
Planes = tuple[Floats, Floats]


def require_column(column: T | None) -> T:
    """Return a column, asserting that an earlier step has written it."""
    assert column is not None
    return column


# Fill values for tables that lack a column that other tables have.
_LACKING: dict[str, Any] = {
    "color": pack_colors(GRAY[0])[0],
    "cause": np.uint8(SURFACE),
    "velocity": np.nan,
    "width": 0.0,
    "source": np.int32(-1),
}


def concatenate_returns(tables: list[PulseReturns]) -> PulseReturns:
    """Concatenate tables of hits.

    A column that only some of the tables have is filled with its value in `_LACKING`. All other
    columns must be present in all tables or in none.
    """
    if len(tables) == 1:
        return tables[0]
    return PulseReturns._make(_column(name, tables) for name in PulseReturns._fields)


def _column(name: str, tables: list[PulseReturns]) -> AnyArray | None:
    """Concatenate a column of several tables, or return None if no table has the column."""
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
    """Return a table of n returns that have the same cause and do not come from a surface.

    The columns `color`, `amplitude` and `source` are present if `template` has them.
    """
    count = len(ray)
    return PulseReturns(
        ray,
        distance,
        np.full(count, NO_SURFACE, np.int32),
        energy,
        None if template.color is None else np.full(count, pack_colors(GRAY[0])[0]),
        np.full(count, cause, np.uint8),
        amplitude=None if template.amplitude is None else energy,
        source=None if template.source is None else np.full(count, -1, np.int32),
    )


def merge_returns(returns: PulseReturns, additions: PulseReturns) -> PulseReturns:
    """Merge two tables of returns, sorted by ray and distance."""
    if not len(additions.ray):
        return returns
    hits = concatenate_returns([returns, additions])
    return hits.take(np.lexsort((hits.distance, hits.ray)))


@dataclass(frozen=True)
class Keys:
    """Scan and ray numbers from which the random numbers of rays are derived."""

    scan: int  # number of the first scan; for a frozen sensor, of the older scan that is sent again
    scan_starts: Ints  # (scans,): first ray of each scan

    def scan_and_number(self, ray: Integers) -> tuple[Ints, Ints]:
        """Return the scan of each ray, and the ray's number in its scan."""
        index = np.searchsorted(self.scan_starts, ray, side="right") - 1
        return self.scan + index, ray - self.scan_starts[index]


def number_within_ray(ray: Integers) -> Ints:
    """Return the index of each entry within its ray, starting at 0.

    The entries of a ray must be consecutive.
    """
    return np.arange(len(ray)) - np.repeat(*runs_of_rays(ray))


def runs_of_rays(ray: Integers) -> tuple[Ints, Ints]:
    """Return the start and length of each run of returns from the same ray."""
    starts = np.flatnonzero(np.diff(ray, prepend=-1))
    return starts, np.diff(starts, append=len(ray))
