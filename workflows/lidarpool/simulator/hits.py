"""Hits of sub-rays, and the keys of their random numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

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

NO_SURFACE = -1  # triangle and object of what is no surface
SURFACE, AIR, FALSE_ALARM, CROSSTALK, BLOOMING = range(len(CAUSES))


def selected(columns: Iterable[Any], rows: Any) -> Iterator[Any]:
    """Yield some rows of each column; None for one that is not there."""
    return (None if column is None else column[rows] for column in columns)


class Hits(NamedTuple):
    """Points that light returned from, in the order of rays: arrays (n,).

    What is no surface has the triangle `NO_SURFACE`.
    """

    ray: Ints
    distance: Floats
    triangle: Ints32
    energy: Floats
    colour: UInts32 | None = None  # packed, see `Surfaces.colours`
    cause: Bytes | None = None  # None if all are surfaces
    velocity: Floats | None = None  # radial, m/s, if a column has it; NaN if unknown
    # Full width at half maximum in the waveform, ns; None if returns are made without.
    width: Floats | None = None
    waveform: Records | None = None  # of returns: recorded, see `recorded`

    def take(self, rows: Bools | Indices) -> Hits:
        """Select some of them."""
        if rows.dtype == np.bool_:  # of each column it would be counted again
            rows = np.flatnonzero(rows)
        return Hits(*selected(self, rows))


# Normals of the surfaces of hits, as they are seen in mirrors, and directions of their rays:
# (n, 3) each.
Planes = tuple[Floats, Floats]


def joined(parts: list[Hits]) -> Hits:
    """Concatenate hits; all have colours, or none.

    If some have a cause, those without are surfaces; if some have a velocity, that of those without
    is unknown; those without a width have the width 0.
    """
    if len(parts) == 1:
        return parts[0]
    *own, colours, causes, velocities, widths, waveforms = zip(*parts, strict=True)
    return Hits(*map(np.concatenate, own))._replace(
        colour=None if parts[0].colour is None else np.concatenate(colours),
        cause=_filled(parts, causes, np.uint8(SURFACE)),
        velocity=_filled(parts, velocities, np.float64(np.nan)),
        width=_filled(parts, widths, np.float64(0)),
        waveform=None if parts[0].waveform is None else np.concatenate(waveforms),
    )


def _filled(parts: list[Hits], columns: tuple[Any, ...], value: np.generic) -> AnyArray | None:
    """Concatenate a column that some parts lack, with a value for those; None if all lack it."""
    if all(column is None for column in columns):
        return None
    lacking = (np.full(len(part.ray), value) for part in parts)
    return np.concatenate(
        [full if one is None else one for one, full in zip(columns, lacking, strict=True)]
    )


@dataclass(frozen=True)
class Keys:
    """Keys of the random numbers of rays."""

    scan: int  # number of the first scan
    begins: Ints  # rays at which scans begin

    def of(self, ray: Integers) -> tuple[Ints, Ints]:
        """Return the scans of rays, and their numbers within them."""
        number = np.searchsorted(self.begins, ray, side="right") - 1
        return self.scan + number, ray - self.begins[number]


def numbers(ray: Ints) -> Ints:
    """Count the entries of each ray, which are consecutive, from 0: (n,)."""
    return np.arange(len(ray)) - np.repeat(*runs(ray))


def runs(ray: Ints) -> tuple[Ints, Ints]:
    """Find starts and lengths of runs of equal numbers."""
    begins = np.flatnonzero(np.diff(ray, prepend=-1))
    return begins, np.diff(begins, append=len(ray))
