"""Hits of sub-rays, and the keys of their random numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..columns.table import CAUSES

NO_SURFACE = -1  # triangle and object of what is no surface
SURFACE, AIR, FALSE_ALARM, CROSSTALK, BLOOMING = range(len(CAUSES))

Whole = NDArray[np.int64]
Rays = NDArray[np.integer[Any]]
Real = NDArray[np.float64]


class Hits(NamedTuple):
    """Points that light returned from, in the order of rays: arrays (n,).

    What is no surface has the triangle `NO_SURFACE`.
    """

    ray: Whole
    distance: Real
    triangle: NDArray[np.int32]
    energy: Real
    colour: NDArray[np.uint32] | None = None  # packed, see `Surfaces.colours`
    cause: NDArray[np.uint8] | None = None  # None if all are surfaces
    # Full width at half maximum in the waveform, ns; None if returns are made without.
    width: Real | None = None
    waveform: NDArray[np.void] | None = None  # of returns: recorded, see `recorded`

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Hits:
        """Select some of them."""
        colour = None if self.colour is None else self.colour[rows]
        cause = None if self.cause is None else self.cause[rows]
        width = None if self.width is None else self.width[rows]
        own = self.ray[rows], self.distance[rows], self.triangle[rows], self.energy[rows]
        waveform = None if self.waveform is None else self.waveform[rows]
        return Hits(*own, colour, cause, width, waveform)


# Normals of the surfaces of some hits, by row, as they are seen in mirrors, and directions of their
# rays: (n, 3) each.
Planes = Callable[[NDArray[np.intp]], tuple[Real, Real]]


def joined(parts: list[Hits]) -> Hits:
    """Concatenate hits; all have colours, or none.

    Those without a cause are surfaces, and those without a width have the width 0.
    """
    *own, colours, causes, widths, waveforms = zip(*parts, strict=True)
    colour = None if parts[0].colour is None else np.concatenate(colours)
    waveform = None if parts[0].waveform is None else np.concatenate(waveforms)
    cause, width = _filled(parts, causes, np.uint8), _filled(parts, widths, np.float64)
    both = Hits(*map(np.concatenate, own))
    return both._replace(colour=colour, cause=cause, width=width, waveform=waveform)


def _filled(
    parts: list[Hits], given: Sequence[NDArray[Any] | None], kind: type[np.generic]
) -> NDArray[Any] | None:
    """Concatenate what some parts have, with zeros for the others; None if none has it."""
    if all(one is None for one in given):
        return None
    some = zip(parts, given, strict=True)
    return np.concatenate(
        [np.zeros(len(part.ray), kind) if one is None else one for part, one in some]
    )


@dataclass(frozen=True)
class Keys:
    """Keys of the random numbers of rays."""

    scan: int  # number of the first scan
    begins: Whole  # rays at which scans begin

    def of(self, ray: Rays) -> tuple[Whole, Whole]:
        """Return the scans of rays, and their numbers within them."""
        number = np.searchsorted(self.begins, ray, side="right") - 1
        return self.scan + number, ray - self.begins[number]


def numbers(ray: Whole) -> Whole:
    """Count the entries of each ray, which are consecutive, from 0: (n,)."""
    return np.arange(len(ray)) - np.repeat(*runs(ray))


def runs(ray: Whole) -> tuple[Whole, Whole]:
    """Find starts and lengths of runs of equal numbers."""
    begins = np.flatnonzero(np.diff(ray, prepend=-1))
    return begins, np.diff(begins, append=len(ray))
