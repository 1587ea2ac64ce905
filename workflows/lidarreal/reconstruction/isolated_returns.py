"""Find returns that differ from their neighbors in the ring, as most returns from the air do.

A surface returns several neighboring pulses at about the same range. Raindrops and snowflakes
return single pulses, and the ranges of returns from fog vary randomly. However, leaves and edges
also cause isolated returns, so isolation alone does not identify returns from the air. At close
range, few surfaces are rough. If most returns in a range interval are isolated, they probably come
from the air.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Ints

_NEIGHBORS = 3  # neighbors on each side that are compared
_MAX_ISOLATED = 2  # maximum number of neighbors at the same range of an isolated return
_MIN_SOLID = 4  # minimum number of such neighbors of a return from a smooth surface
# Maximum range difference of neighbors on a surface, as a constant and per distance to the
# neighboring pulse.
_TOLERANCE_M = 0.1
_SLOPE = 3.0
_MAX_STEPS = 3.0  # maximum gap between neighbors per position, in typical azimuth steps
_MIN_STEP_RAD = np.radians(0.02)  # Closer returns belong to the same pulse.
_RANGE_EDGES_M = np.array([0, 0.5, 0.7, 1, 1.4, 2, 2.8, 4, 5.6, 8, 11, 16, 22, 32])
_MIN_RETURNS = 8  # minimum number of isolated returns in an interval that contains weather
_MIN_SHARE = 0.4  # minimum share of isolated returns in such an interval
_MIN_FIRST_SHARE = 0.8  # minimum share in the first such interval
# Maximum start of the first such interval. At longer ranges, most returns may come from leaves.
MAX_START_M = 2.8


def same_range_neighbors(sweep: Sweep) -> Ints:
    """Count how many of the six nearest returns in a ring have about the same range.

    The sweep has the column `row` with the ring of each return. The result has shape (n,).
    """
    count = len(sweep)
    ring = np.asarray(sweep.columns["row"])
    azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
    order = np.lexsort((azimuth, ring))
    ring = ring[order]
    azimuth = azimuth[order]
    range_m = np.linalg.norm(sweep.points[order], axis=1)
    gaps = np.diff(azimuth)
    steps = gaps[(ring[1:] == ring[:-1]) & (gaps > _MIN_STEP_RAD)]
    step_rad = float(np.median(steps)) if len(steps) else 0.0
    tolerance_m = _TOLERANCE_M + _SLOPE * step_rad * range_m
    same = np.zeros(count, np.int64)
    for offset in range(1, min(_NEIGHBORS, count - 1) + 1):
        near = ring[offset:] == ring[:-offset]
        near &= azimuth[offset:] - azimuth[:-offset] < _MAX_STEPS * step_rad * offset
        near &= np.abs(range_m[offset:] - range_m[:-offset]) < np.minimum(
            tolerance_m[offset:], tolerance_m[:-offset]
        )
        same[offset:] += near
        same[:-offset] += near
    result = np.empty(count, np.int64)
    result[order] = same
    return result


def is_isolated(sweep: Sweep) -> Bools:
    """Mark the isolated returns of a sweep.

    The mask has shape (n,).
    """
    return np.asarray(same_range_neighbors(sweep) <= _MAX_ISOLATED)


def isolated_and_solid(sweep: Sweep) -> tuple[Bools, Bools]:
    """Mark the isolated returns of a sweep, and those on smooth surfaces.

    Both masks have shape (n,). Some returns are neither.
    """
    same = same_range_neighbors(sweep)
    return same <= _MAX_ISOLATED, same >= _MIN_SOLID


class IsolatedRanges(NamedTuple):
    """Range interval at close range in which most returns of a recording are isolated."""

    start_m: float = 0.0
    stop_m: float = 0.0  # equal to `start_m` if there is no such interval

    @classmethod
    def from_sweeps(cls, sweeps: Iterable[Sweep]) -> IsolatedRanges:
        """Find the range intervals in some sweeps of a recording.

        The sweeps have the column `row` with the ring of each return.
        """
        total = np.zeros(len(_RANGE_EDGES_M) - 1, np.int64)
        isolated = np.zeros_like(total)
        for sweep in sweeps:
            range_m = np.linalg.norm(sweep.points, axis=1)
            total += np.histogram(range_m, _RANGE_EDGES_M)[0]
            isolated += np.histogram(range_m[is_isolated(sweep)], _RANGE_EDGES_M)[0]
        found = (isolated >= _MIN_RETURNS) & (isolated >= _MIN_SHARE * total)
        is_first = found & (isolated >= _MIN_FIRST_SHARE * total)
        starts = np.flatnonzero(is_first & (_RANGE_EDGES_M[:-1] <= MAX_START_M))
        if not len(starts):
            return cls()
        length = int(np.argmin(np.append(found[starts[0] :], False)))
        return cls(float(_RANGE_EDGES_M[starts[0]]), float(_RANGE_EDGES_M[starts[0] + length]))

    @property
    def are_found(self) -> bool:
        """Whether there is such an interval, so the recording may contain weather."""
        return self.stop_m > self.start_m

    def without_isolated(self, sweep: Sweep) -> Sweep:
        """Omit the isolated returns of a sweep that are not beyond the interval."""
        if not self.are_found:
            return sweep
        near = np.linalg.norm(sweep.points, axis=1) < self.stop_m
        return sweep.select(~(near & is_isolated(sweep)))


NO_RANGES = IsolatedRanges()
