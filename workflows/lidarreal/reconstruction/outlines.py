"""Trim surfels at the outlines of objects, as the recorded rays show them.

A surfel at an edge extends beyond it, because it is as large as the gap between rays. Rays that
pass next to the object then cross the surfel on one side, and rays that end on the object on the
other side. Such a surfel is cut at the line between them, parallel to one of its sides. Near an
edge, the sides are parallel to it, because the neighbors of a surfel spread along the edge.

Hedges and fences have no such line, since rays pass through them everywhere. A cut must therefore
explain the rays better than a constant gap fraction, and nearly all rays must pass through the part
that is cut off.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Bytes, Floats, Ints, Ints32

from .porosity import Crossings
from .surfels import Surfels

CELLS = 8  # cells along each side of a surfel, in which rays are counted
_MIN_PASSING = 0.05  # minimum share of passing rays of a surfel that may be cut
_MIN_CUT_PASSING = 0.9  # minimum share of passing rays in the part that is cut off
_MIN_GAIN = 8.0  # minimum difference of the log likelihoods with and without a cut
_CUTS = 2  # maximum number of times that a surfel is cut, each time at one or both ends
_MIN_REST = 0.2  # minimum share of a trimmed side that remains if its beam width is subtracted
_TINY = 1e-9


def crossed_cells(surfels: Surfels, surfel: Ints, points: Floats) -> Bytes:
    """Return the cells of surfels that contain points on them.

    `surfel` has shape (k,), and the points have shape (k, 3).
    """
    cells = np.empty((2, len(surfel)), np.int64)
    offsets = points - surfels.centers[surfel]
    for axis, half in enumerate(surfels.half_sides):
        sides = half[surfel]
        size_m2 = np.maximum(np.einsum("ij,ij->i", sides, sides), _TINY)
        share = np.einsum("ij,ij->i", offsets, sides) / size_m2
        cells[axis] = np.floor((share + 1) * CELLS / 2)
    along, across = cells.clip(0, CELLS - 1)
    return np.asarray(along * CELLS + across, np.uint8)


class Extents(NamedTuple):
    """Extents along both sides to which m surfels are trimmed, in cells."""

    start: Floats  # (m, 2), 0 without a cut
    stop: Floats  # (m, 2), `CELLS` without a cut

    @classmethod
    def whole(cls, count: int) -> Extents:
        """Return the extents of surfels that are not trimmed."""
        return cls(np.zeros((count, 2)), np.full((count, 2), float(CELLS)))

    @classmethod
    def from_crossings(
        cls, sweeps: Sequence[Crossings], dark: Bools, on_surfel_m: float
    ) -> Extents:
        """Find the extents of surfels that explain the rays best.

        Parameters
        ----------
        sweeps
            Crossings of the rays in several sweeps. The ranges of lost pulses are infinite.
        dark
            Surfels that return no pulses, which are not trimmed. Shape (m,).
        on_surfel_m
            Maximum range difference in meters between a surfel and a return from it.
        """
        extents = cls.whole(len(dark))
        counts = _CellCounts.at_outlines(sweeps, dark, on_surfel_m)
        for _ in range(_CUTS):
            surfel = counts.surfel
            inside = extents.select(surfel).cells()
            cuts = [
                _Cut.best(counts.ends * inside, counts.passes * inside, axis) for axis in (0, 1)
            ]
            across = cuts[1].gain > cuts[0].gain
            is_cut = np.zeros(len(surfel), bool)
            for axis, better in ((0, ~across), (1, across)):
                cut = cuts[axis]
                rows = better & (cut.gain > _MIN_GAIN)
                at = surfel[rows], axis
                extents.start[at] = np.maximum(extents.start[at], cut.start[rows])
                extents.stop[at] = np.minimum(extents.stop[at], cut.stop[rows])
                is_cut |= rows
            counts = counts.select(is_cut)
        return extents

    def select(self, rows: Ints) -> Extents:
        """Select surfels by index."""
        return Extents(self.start[rows], self.stop[rows])

    def cells(self) -> Bools:
        """Mask of the cells that remain. Shape (m, `CELLS`, `CELLS`)."""
        middle = np.arange(CELLS) + 0.5
        inside = (middle > self.start[..., None]) & (middle < self.stop[..., None])
        return np.asarray(inside[:, 0, :, None] & inside[:, 1, None, :])

    def trim(self, surfels: Surfels, inset_m: Floats) -> Surfels:
        """Return the trimmed surfels, whose cuts are moved inward by `inset_m`. Shape (m,)."""
        half_m = np.maximum(np.linalg.norm(surfels.half_sides, axis=2).T, _TINY)
        inset = np.minimum(inset_m[:, None] / half_m, (1 - _MIN_REST) * self.rest)
        start = 2 * self.start / CELLS - 1 + np.where(self.start > 0, inset, 0)
        stop = 2 * self.stop / CELLS - 1 - np.where(self.stop < CELLS, inset, 0)
        return surfels.resize(start, stop)

    @property
    def rest(self) -> Floats:
        """Share of both sides that remains. Shape (m, 2)."""
        return (self.stop - self.start) / CELLS

    def crossings(self, crossings: Crossings) -> Crossings:
        """Omit the crossings in the parts that are cut off."""
        inside = crossings.present
        for axis, cell in enumerate(np.divmod(crossings.cell, CELLS)):
            inside &= cell + 0.5 > self.start[:, axis][crossings.surfel]
            inside &= cell + 0.5 < self.stop[:, axis][crossings.surfel]
        return crossings.select(inside)


class _CellCounts(NamedTuple):
    """Rays that end in the cells of c surfels, or pass through them."""

    surfel: Ints  # (c,), indices of the surfels
    ends: Floats  # (c, CELLS, CELLS)
    passes: Floats  # (c, CELLS, CELLS)

    @classmethod
    def at_outlines(
        cls, sweeps: Sequence[Crossings], dark: Bools, on_surfel_m: float
    ) -> _CellCounts:
        """Count the rays of the surfels that some rays pass and on which others end."""
        count = len(dark)
        ends, passes = np.zeros((2, count))
        for surfel, _, is_end in _outcomes(sweeps, on_surfel_m):
            ends += np.bincount(surfel[is_end], minlength=count)
            passes += np.bincount(surfel[~is_end], minlength=count)
        mixed = (ends > 0) & (passes > _MIN_PASSING * (ends + passes)) & ~dark
        chosen = np.flatnonzero(mixed)
        position = np.full(count, -1)
        position[chosen] = np.arange(len(chosen))
        size = len(chosen) * CELLS**2
        cells = np.zeros((2, size))
        for surfel, cell, is_end in _outcomes(sweeps, on_surfel_m):
            rows = position[surfel]
            index = rows * CELLS**2 + cell
            for outcome, marked in enumerate((is_end, ~is_end)):
                cells[outcome] += np.bincount(index[marked & (rows >= 0)], minlength=size)
        return cls(chosen, *cells.reshape(2, -1, CELLS, CELLS))

    def select(self, rows: Bools) -> _CellCounts:
        """Select surfels with a mask."""
        return _CellCounts(self.surfel[rows], self.ends[rows], self.passes[rows])


def _outcomes(
    sweeps: Sequence[Crossings], on_surfel_m: float
) -> Iterator[tuple[Ints32, Bytes, Bools]]:
    """Yield the surfels and cells that rays cross, and which rays end there.

    Surfels behind the return of a ray are omitted.
    """
    for one in sweeps:
        farther_m = np.full(one.surfel.shape, -np.inf)
        np.subtract(one.range_m[:, None], one.distance_m, out=farther_m, where=one.present)
        reached = farther_m > -on_surfel_m
        yield one.surfel[reached], one.cell[reached], farther_m[reached] < on_surfel_m


class _Cut(NamedTuple):
    """Best cut of c surfels across one of their sides, in cells."""

    start: Floats  # (c,), start of the part that remains
    stop: Floats  # (c,), end of the part that remains
    gain: Floats  # (c,), increase of the log likelihood, or 0 if no cut is possible

    @classmethod
    def best(cls, ends: Floats, passes: Floats, axis: int) -> _Cut:
        """Find the cut along an axis that best explains the rays in the cells.

        The cut is in the middle of any cells without rays between the two parts. `ends`
        and `passes` have shape (c, `CELLS`, `CELLS`).
        """
        counts = np.stack([ends, passes]).sum(axis=3 - axis)  # (2, c, CELLS)
        before = np.cumsum(np.pad(counts, ((0, 0), (0, 0), (1, 0))), axis=2)
        best = np.zeros(len(ends))
        first, last = np.zeros((2, len(ends), 2))
        for start in range(CELLS):
            for stop in range(start + 1, CELLS + 1):
                gain = _gain(before[..., -1], before[..., stop] - before[..., start])
                better = gain > best + _TINY
                first[better] = start, stop
                last[better | (gain > best - _TINY) & (best > 0)] = start, stop
                best = np.maximum(best, gain)
        start_cell, stop_cell = (first + last).T / 2
        return cls(start_cell, stop_cell, best)


def _gain(total: Floats, kept: Floats) -> Floats:
    """Return how much a cut increases the log likelihood, or 0 if the rays do not show an edge.

    `total` and `kept` are the numbers of ending and passing rays of c surfels and of their parts
    that remain. Both have shape (2, c).
    """
    cut = total - kept
    gain = _log_likelihood(*kept) + _log_likelihood(*cut) - _log_likelihood(*total)
    gain[cut[1] < _MIN_CUT_PASSING * cut.sum(axis=0)] = 0
    gain[kept[1] * cut[0] >= cut[1] * kept[0]] = 0  # The part that remains has more gaps.
    return gain


def _log_likelihood(ends: Floats, passes: Floats) -> Floats:
    """Return the log likelihood of ray counts for their own gap fraction."""
    rays = np.maximum(ends + passes, _TINY)
    terms = [count * np.log(np.maximum(count, _TINY) / rays) for count in (ends, passes)]
    return np.asarray(terms[0] + terms[1])
