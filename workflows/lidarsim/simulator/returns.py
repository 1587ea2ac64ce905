"""What comes back of pulses, and the keys of random numbers."""

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
from ..scene.colours import GREY, packed

T = TypeVar("T")

NO_SURFACE = -1  # triangle and object of what is no surface
SURFACE = CAUSES.index("surface")


def selected(columns: Iterable[Any], rows: Any) -> Iterator[Any]:
    """Yield some rows of each column; None for one that is not there."""
    for column in columns:
        if isinstance(column, np.ndarray) and column.flags.f_contiguous:  # twice as fast
            yield column.T.take(rows, axis=-1).T
        else:
            yield None if column is None else column[rows]


# Columns of whatever comes back.
OF_RETURNS = "ray", "distance", "triangle", "energy", "colour", "cause"


class PulseReturns(NamedTuple):
    """What comes back of pulses, in the order of rays and distances: arrays (n,).

    Columns that no step of a survey makes are None. Before hits become returns, a ray is a sub-ray.
    What is no surface has the triangle `NO_SURFACE`.
    """

    ray: Integers
    distance: Floats  # metres, without noise
    triangle: Ints32
    # Received, see `Surfaces.energy`; None if it is that of the rays as reported.
    energy: Floats | None = None
    # Packed, see `Surfaces.colours`; None if they are those of the rays' ends, or not needed.
    colour: UInts32 | None = None
    cause: Bytes | None = None  # why they are there; None if all are surfaces
    # Radial, m/s, if a column has it; NaN if unknown.
    velocity: Floats | None = None
    # Full width at half maximum in the waveform, ns, and height; None if returns are made without.
    width: Floats | None = None
    amplitude: Floats | None = None
    waveform: Records | None = None  # recorded, but for the location
    number: Bytes | None = None  # among the reported returns of its pulse, from 1
    returns: Bytes | None = None  # how many these are
    reported: Floats | None = None  # distance with noise

    @classmethod
    def none(cls) -> PulseReturns:
        """Make none."""
        return cls(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int32))

    @classmethod
    def one_each(cls, ray: Integers, distance: Floats, triangle: Ints32) -> PulseReturns:
        """Make the only return of each ray, without noise."""
        one = np.ones(len(ray), np.uint8)
        return cls(ray, distance, triangle, number=one, returns=one, reported=distance)

    def take(self, rows: Bools | Indices) -> PulseReturns:
        """Select some of them."""
        if rows.dtype == np.bool_:  # of each column it would be counted again
            rows = np.flatnonzero(rows)
        return PulseReturns(*selected(self, rows))

    @property
    def height(self) -> Floats:
        """Heights of echoes; without waveforms their energies."""
        return made(self.energy if self.amplitude is None else self.amplitude)


# Normals of the surfaces of hits, as they are seen in mirrors, and directions of their rays:
# (n, 3) each.
Planes = tuple[Floats, Floats]


def made(column: T | None) -> T:
    """Return a column that an earlier step has made."""
    assert column is not None
    return column


# Values of a column where some have it, and others do not.
_LACKING: dict[str, Any] = {"cause": np.uint8(SURFACE), "velocity": np.nan, "width": 0.0}


def joined(parts: list[PulseReturns]) -> PulseReturns:
    """Concatenate hits. Other columns than `_LACKING` are in all parts, or in none."""
    if len(parts) == 1:
        return parts[0]
    return PulseReturns._make(_column(name, parts) for name in PulseReturns._fields)


def _column(name: str, parts: list[PulseReturns]) -> AnyArray | None:
    """Concatenate a column; None if all parts lack it."""
    columns = [getattr(part, name) for part in parts]
    if all(column is None for column in columns):
        return None
    return np.concatenate(
        [
            np.full(len(part.ray), _LACKING[name]) if column is None else column
            for part, column in zip(parts, columns, strict=True)
        ]
    )


def unreal(
    returns: PulseReturns, ray: Ints, distance: Floats, energy: Floats, cause: int
) -> PulseReturns:
    """Make returns that are from no surface, with the columns that others have."""
    count = len(ray)
    return PulseReturns(
        ray,
        distance,
        np.full(count, NO_SURFACE, np.int32),
        energy,
        None if returns.colour is None else np.full(count, packed(GREY[0])[0]),
        np.full(count, cause, np.uint8),
        amplitude=None if returns.amplitude is None else energy,
    )


def merged(returns: PulseReturns, more: PulseReturns) -> PulseReturns:
    """Add returns to others; the result is in the order of rays and distances."""
    if not len(more.ray):
        return returns
    hits = joined([returns, more])
    return hits.take(np.lexsort((hits.distance, hits.ray)))


@dataclass(frozen=True)
class Keys:
    """Keys of the random numbers of rays."""

    scan: int  # number of the first scan
    begins: Ints  # rays at which scans begin

    def of(self, ray: Integers) -> tuple[Ints, Ints]:
        """Return the scans of rays, and their numbers within them."""
        number = np.searchsorted(self.begins, ray, side="right") - 1
        return self.scan + number, ray - self.begins[number]


def numbers(ray: Integers) -> Ints:
    """Count the entries of each ray, which are consecutive, from 0: (n,)."""
    return np.arange(len(ray)) - np.repeat(*runs(ray))


def runs(ray: Integers) -> tuple[Ints, Ints]:
    """Find starts and lengths of runs of equal numbers."""
    begins = np.flatnonzero(np.diff(ray, prepend=-1))
    return begins, np.diff(begins, append=len(ray))
