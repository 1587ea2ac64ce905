"""Recognize returns from fog, rain, snow, dust and exhaust, so that they can be omitted.

Returns from the air are isolated in their sweep, and the rays of other sweeps pass through their
positions or have no return there. Other sweeps also have returns there, but not more than if the
isolated returns were distributed evenly over all directions that are open at this range.

Returns from edges, leaves and moving objects can have the same properties, but in clear air they
are a small part of the isolated returns at any range. Returns from the air are therefore only
recognized in range intervals in which they are a large part.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import AnyFloats, Bools, Floats, Floats32, Ints
from lidarsim.numerics.even_samples import even_indices

from ..scan_patterns.lasers import RingLasers
from .alignment import AlignedSweep, AlignedSweeps
from .free_space import locate
from .isolated_returns import MAX_START_M, isolated_and_solid

_COLUMNS = 1024  # number of image columns
_NEIGHBORHOOD = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)]
_OFFSETS = (-8, -5, -3, -2, -1, 1, 2, 3, 5, 8)  # compared sweeps relative to a sweep
# Maximum range difference of returns from one surface, as a constant and per meter of range.
_TOLERANCE_M = 0.2
_TOLERANCE_PER_M = 0.01
_NEAR_SOLID_M = 0.5  # A return this close in range to a neighboring smooth surface belongs to it.
_MAX_SUPPORT = 0.2  # maximum ratio of supporting cells to supporting and passing cells
_MIN_CELLS = 4  # minimum number of supporting and passing cells for this ratio
# maximum ratio of supporting cells to all cells that are not blocked, such as cells in the sky
_MAX_SUPPORT_IN_SKY = 0.1
_CHANCE = 1.5  # factor of the expected number of cells that support by chance
_CHANCE_SIGMAS = 2.0  # margin above this number in standard deviations
_RANGE_EDGES_M = np.append(0, np.geomspace(0.1, 60.0, 36))  # boundaries of range intervals
_MIN_SHARE = 0.5  # minimum share of isolated returns that come from the air in an interval
_STATED_RETURNS = 10_000  # returns whose ranges are kept per submap
_MIN_RETURNS = 6  # minimum number of such returns in an interval
# All returns in an interval come from the air if this share of them are isolated, and if this share
# of the isolated returns come from the air.
_PURE_SHARE = 0.9


class _Candidates(NamedTuple):
    """Isolated returns of a sweep, and the numbers of image cells of other sweeps around them."""

    rows: Ints  # (k,), indices of the returns
    range_m: Floats  # (k,)
    solid: Ints  # (k,), cells with a return from a smooth surface at the same range
    supporting: Ints  # (k,), cells with any return at the same range
    passing: Ints  # (k,), cells with returns only at longer ranges
    empty: Ints  # (k,), cells without a return

    @classmethod
    def concatenate(cls, parts: Sequence[_Candidates]) -> _Candidates:
        """Concatenate the candidates of several sweeps."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))

    def are_free(self, per_m: Floats) -> Bools:
        """Mark the candidates at whose positions other sweeps have hardly any returns.

        `per_m` is the mean number of isolated returns per meter in a cell at the range of each
        candidate. The arrays have shape (k,).
        """
        tolerance_m = _TOLERANCE_M + _TOLERANCE_PER_M * self.range_m
        cells = self.supporting + self.passing + self.empty
        chance = 2 * tolerance_m * per_m * cells
        by_chance = _CHANCE * chance + _CHANCE_SIGMAS * np.sqrt(chance)
        support = self.solid + np.maximum(self.supporting - self.solid - by_chance, 0)
        tested = self.supporting + self.passing
        free = (tested >= _MIN_CELLS) & (support <= _MAX_SUPPORT * tested)
        return np.asarray(free | (support <= _MAX_SUPPORT_IN_SKY * cells))


@dataclass(frozen=True, eq=False)
class _Images:
    """Ranges of a sweep by ring and azimuth, with an empty row above the first and below the last.

    `solid` contains only returns from smooth surfaces.
    """

    nearest_m: Floats32  # (r + 2, c), inf without a return
    farthest_m: Floats32  # (r + 2, c), -inf without a return
    solid_m: Floats32  # (r + 2, c), nearest, inf without a return
    interval: Ints  # (n,), range intervals of the returns
    isolated: Bools  # (n,)

    @classmethod
    def from_sweep(
        cls, sweep: AlignedSweep, lasers: RingLasers, isolated: Bools, solid: Bools
    ) -> _Images:
        """Create the images of a sweep, given masks of isolated and solid returns."""
        (rows, columns), _, range_m = locate(sweep.points, lasers, _COLUMNS)
        shape = (len(lasers) + 2, _COLUMNS)
        single = range_m.astype(np.float32)
        nearest = np.full(shape, np.inf, np.float32)
        farthest = np.full(shape, -np.inf, np.float32)
        smooth = np.full(shape, np.inf, np.float32)
        np.minimum.at(nearest, (rows + 1, columns), single)
        np.maximum.at(farthest, (rows + 1, columns), single)
        np.minimum.at(smooth, (rows[solid] + 1, columns[solid]), single[solid])
        return cls(nearest, farthest, smooth, _intervals(range_m), isolated)

    def are_near_solid(self, cells: tuple[Ints, Ints], range_m: Floats) -> Bools:
        """Mark returns next to a smooth surface, such as those from the edges of an object."""
        near = np.zeros(len(range_m), bool)
        for above, beside in _NEIGHBORHOOD:
            solid_m = self.solid_m[cells[0] + 1 + above, (cells[1] + beside) % _COLUMNS]
            near |= np.abs(solid_m - range_m) < _NEAR_SOLID_M
        return near

    def open_cells(self) -> Ints:
        """Return the number of cells that are not blocked before the end of each interval."""
        ends_m = np.sort(self.farthest_m[1:-1], axis=None)
        empty = int(np.isneginf(ends_m).sum())
        beyond = len(ends_m) - np.searchsorted(ends_m, _RANGE_EDGES_M[1:])
        return np.asarray(beyond + empty)


@dataclass(eq=False)
class _Counts:
    """Numbers of returns, isolated returns, and cells that are not blocked, by range interval.

    The last interval contains everything outside the boundaries.
    """

    returns: Ints = field(default_factory=lambda: np.zeros(len(_RANGE_EDGES_M), np.int64))
    isolated: Ints = field(default_factory=lambda: np.zeros(len(_RANGE_EDGES_M), np.int64))
    open_cells: Ints = field(default_factory=lambda: np.zeros(len(_RANGE_EDGES_M), np.int64))

    def add(self, images: _Images) -> None:
        """Add the returns of a sweep."""
        count = len(_RANGE_EDGES_M)
        self.returns += np.bincount(images.interval, minlength=count)
        self.isolated += np.bincount(images.interval[images.isolated], minlength=count)
        self.open_cells[:-1] += images.open_cells()


class _Found(NamedTuple):
    """Returns that come from the air."""

    candidates: Bools  # (k,), mask of the candidates
    intervals: Bools  # (intervals,), range intervals in which all returns do


def find_air_returns(sweeps: AlignedSweeps, numbers: Sequence[int]) -> dict[int, Bools]:
    """Find the returns of each sweep that come from the air.

    Return their masks, keyed by sweep number. Each mask has shape (n,). The result is empty if the
    recording has no range interval in which most returns are isolated, as in clear air.

    Parameters
    ----------
    sweeps
        Aligned sweeps.
    numbers
        Numbers of the sweeps to compare with each other, in ascending order.
    """
    if not sweeps.recorded.isolated.are_found:
        return {}
    lasers = sweeps.recorded.lasers.sort_by_elevation()
    parts = []
    intervals = []
    counts = _Counts()
    for candidates, images in _compare_sweeps(sweeps, numbers, lasers):
        parts.append(candidates)
        intervals.append(images.interval.astype(np.int8))
        counts.add(images)
    found = _from_air(_Candidates.concatenate(parts), counts)
    sizes = [len(part.rows) for part in parts]
    masks = {}
    for number, part, chosen, interval in zip(
        numbers, parts, np.split(found.candidates, np.cumsum(sizes)[:-1]), intervals, strict=True
    ):
        mask = found.intervals[interval]
        mask[part.rows[chosen]] = True
        masks[number] = mask
    return masks


def _compare_sweeps(
    sweeps: AlignedSweeps, numbers: Sequence[int], lasers: RingLasers
) -> Iterator[tuple[_Candidates, _Images]]:
    """Yield the candidates and images of each sweep.

    Only the images of sweeps that are compared with the current one are in memory.
    """
    reach = max(_OFFSETS)
    kept: dict[int, tuple[AlignedSweep, _Images]] = {}
    for index in range(len(numbers)):
        for other in range(index, min(index + reach + 1, len(numbers))):
            if other not in kept:
                recorded = sweeps.recorded.read(numbers[other])
                sweep = sweeps.align(recorded, numbers[other])
                images = _Images.from_sweep(sweep, lasers, *isolated_and_solid(recorded))
                kept[other] = sweep, images
        kept.pop(index - reach - 1, None)
        sweep, images = kept[index]
        rows = np.flatnonzero(images.isolated)
        cells, _, range_m = locate(sweep.points[rows], lasers, _COLUMNS)
        chosen = ~images.are_near_solid(cells, range_m) & (range_m < _RANGE_EDGES_M[-1])
        compared = [
            (kept[index + offset][1], sweeps.alignment.poses[numbers[index + offset]])
            for offset in _OFFSETS
            if 0 <= index + offset < len(numbers)
        ]
        counted = _count_cells(compared, lasers, sweep.world[rows[chosen]])
        yield _Candidates(rows[chosen], range_m[chosen], *counted), images


def _count_cells(
    compared: Sequence[tuple[_Images, Floats]], lasers: RingLasers, world: Floats
) -> tuple[Ints, Ints, Ints, Ints]:
    """Count the solid, supporting, passing and empty cells of other sweeps around points.

    `compared` are the images and poses of the other sweeps. The points have shape (k, 3), and are
    in world coordinates.
    """
    solid, supporting, passing, empty = np.zeros((4, len(world)), np.int64)
    for images, pose in compared:
        (row, column), elevation, range_m = locate(
            (world - pose[:3, 3]) @ pose[:3, :3], lasers, _COLUMNS
        )
        inside = (elevation <= lasers.elevation_rad[0]) & (elevation >= lasers.elevation_rad[-1])
        tolerance_m = _TOLERANCE_M + _TOLERANCE_PER_M * range_m
        for above, beside in _NEIGHBORHOOD:
            cell = row + 1 + above, (column + beside) % _COLUMNS
            known = inside & (cell[0] > 0) & (cell[0] <= len(lasers))
            nearest_m = images.nearest_m[cell]
            farthest_m = images.farthest_m[cell]
            same = np.abs(nearest_m - range_m) < tolerance_m
            same |= np.abs(farthest_m - range_m) < tolerance_m
            solid += known & (np.abs(images.solid_m[cell] - range_m) < tolerance_m)
            supporting += known & same
            passing += known & ~same & (farthest_m > range_m + tolerance_m)
            empty += known & np.isinf(nearest_m)
    return solid, np.maximum(solid, supporting), passing, empty


def _intervals(range_m: Floats) -> Ints:
    """Return the range intervals of returns, of which the last is outside the boundaries."""
    interval = np.searchsorted(_RANGE_EDGES_M, range_m, side="right") - 1
    return np.where(interval < 0, len(_RANGE_EDGES_M) - 1, interval)


def _from_air(candidates: _Candidates, counts: _Counts) -> _Found:
    """Find the returns that come from the air."""
    interval = _intervals(candidates.range_m)
    isolated = counts.isolated
    widths_m = np.append(np.diff(_RANGE_EDGES_M), np.inf)
    per_m = isolated / np.maximum(counts.open_cells, 1) / widths_m
    free = candidates.are_free(per_m[interval])
    count = np.bincount(interval[free], minlength=len(isolated))
    is_airy = count >= _MIN_SHARE * isolated
    is_enough = isolated >= _MIN_RETURNS
    # The density of returns from the air decreases with the range, so the first interval in which
    # most isolated returns come from surfaces is the end.
    stop = int(np.argmax(np.append(is_enough[:-1] & ~is_airy[:-1], True)))
    starts = np.flatnonzero(is_enough[:stop])
    if not len(starts) or _RANGE_EDGES_M[starts[0]] > MAX_START_M:
        stop = 0
    is_airy &= np.arange(len(isolated)) < stop
    is_pure = is_airy & is_enough & (count >= _PURE_SHARE * isolated)
    is_pure &= isolated >= _PURE_SHARE * counts.returns
    return _Found(free & is_airy[interval], is_pure)


class AirStatistics(NamedTuple):
    """Returns from the air in the sweeps of a submap."""

    returns: int  # number of returns from the air
    ranges_m: AnyFloats  # (k,), ranges of some of them

    @classmethod
    def from_sweeps(
        cls, sweeps: AlignedSweeps, air: Mapping[int, Bools], own: Ints
    ) -> AirStatistics:
        """Describe the returns from the air in the sweeps `own`, given masks for each sweep."""
        parts = [
            np.linalg.norm(sweeps.recorded.read_all(number).points[air[number]], axis=1)
            for number in own.tolist()
            if number in air
        ]
        ranges_m = np.concatenate([np.empty(0), *parts])
        some = even_indices(len(ranges_m), _STATED_RETURNS)
        return cls(len(ranges_m), ranges_m[some].astype(np.float32))
