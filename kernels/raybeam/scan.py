"""Scans: rays of a pattern, their poses, and which hits are kept and counted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Indices, Integers, Ints, Ints32
from .hits import Part, ScanReturns, joined
from .pattern import Pattern
from .pattern_rays import checked_rays
from .poses import PoseMotion, Poses, check_poses
from .rays import Rays, check_interval

_MOST_RAYS = 1 << 32  # of a scan, so that `ScanReturns` can number them


@dataclass(frozen=True, eq=False)
class Scan:
    """Checked arguments of `RayCaster.scan`.

    Attributes
    ----------
    pattern
        Rays in the sensor's axes.
    first
        The pattern's row of ray 0; after its last row the pattern repeats.
    count
        Number of rays.
    poses
        Of all rays.
    t_min, t_max
        Hits nearer or farther than this are not reported, metres; both ends count.
    keep_every
        Keep the hits of each group whose number is a multiple of this.
    groups
        int64 (g,): numbers of the rays at which groups begin; ascending, the first is 0.
    tally
        Whether to count hits by triangle.
    room
        float64 (6, count): where origins and directions of all rays are written; (3, count) for
        directions alone, None for nowhere.
    """

    pattern: Pattern
    first: int
    count: int
    poses: Poses
    t_min: float
    t_max: float
    keep_every: int
    groups: Ints
    tally: bool
    room: Floats | None = None

    def __len__(self) -> int:
        return self.count

    def chunks(self, size: int) -> Iterator[tuple[int, int]]:
        """Half-open ranges of rays, at most `size` each, in ray order."""
        for start in range(0, self.count, size):
            yield start, min(start + size, self.count)

    def rays(self, start: int, stop: int) -> Rays:
        """Rays `start` to `stop`, with the bits of `pattern_rays`."""
        ray = np.arange(start, stop, dtype=np.int64)
        origins, directions = checked_rays(self.pattern, self.first, ray, self.poses)
        if self.room is not None:
            self.room[-3:, start:stop] = directions.T
            if len(self.room) > 3:
                self.room[:3, start:stop] = origins.T
        return Rays(origins, directions, self.t_min, self.t_max)


def check_scan(
    pattern: Pattern,
    positions: ArrayLike | Poses,
    rotations: ArrayLike | None = None,
    *,
    window: tuple[int, int] | None = None,
    rays_per_pose: int | None = None,
    t_min: float = 0.0,
    t_max: float = np.inf,
    keep_every: int = 1,
    groups: ArrayLike | None = None,
    tally: bool = False,
    motion: PoseMotion | None = None,
    room: Floats | None = None,
) -> Scan:
    """Check the arguments of `RayCaster.scan`, which describes them and the errors."""
    start, stop = (0, len(pattern)) if window is None else map(index, window)
    if not 0 <= start <= stop or (stop > start and not len(pattern)):
        raise ValueError(
            f"Rows {start} to {stop} of a pattern with {len(pattern)} are no window: "
            "expected 0 <= start <= stop."
        )
    count = stop - start
    if count > _MOST_RAYS:
        raise ValueError(
            f"{count:,} rays are more than the {_MOST_RAYS:,} that one call can number: "
            "scan smaller windows."
        )
    if index(keep_every) < 1:
        raise ValueError(f"keep_every is {keep_every}: it must be at least 1, to keep all hits.")
    return Scan(
        pattern,
        start % max(len(pattern), 1),
        count,
        check_poses(positions, rotations, rays_per_pose, count, motion),
        *check_interval(t_min, t_max),
        index(keep_every),
        np.zeros(1, np.int64) if groups is None else np.asarray(groups, np.int64),
        tally,
        room,
    )


class Groups:
    """Groups of a scan's rays: their hits are counted, and every n-th of each group is kept.

    Parameters
    ----------
    begins, every
        `groups` and `keep_every` of `Scan`.
    """

    def __init__(self, begins: Ints, every: int) -> None:
        self._begins = begins
        self.every = every
        self.hits = np.zeros(len(begins), np.int64)  # of each group, so far

    def spans(self, start: int, stop: int) -> tuple[slice, Ints]:
        """Find the groups of rays `start` to `stop`, and the first ray of all but the first.

        The rays are counted from `start`.
        """
        first = int(np.searchsorted(self._begins, start, side="right")) - 1
        last = int(np.searchsorted(self._begins, stop, side="left"))
        return slice(first, last), self._begins[first + 1 : last] - start

    def count(self, groups: slice, counts: Ints) -> tuple[Ints, Ints]:
        """Count hits of groups in a chunk; of each: the first that is kept, and how many are."""
        before = self.hits[groups].copy()  # of the first group, in the chunks before this one
        self.hits[groups] += counts
        leave = -before % self.every
        return leave, np.maximum(-((leave - counts) // self.every), 0)


class Collector(Groups):
    """Collects the hits of a scan, chunk after chunk in ray order.

    Parameters
    ----------
    scan
        Says what to keep and what to count.
    face_count
        Rows of the tally.

    Examples
    --------
    >>> pattern = Pattern([[1, 0, 0]] * 10)
    >>> collector = Collector(check_scan(pattern, [0, 0, 0], keep_every=2, groups=[0, 5]), 1)
    >>> ray = np.array([1, 2, 3, 6, 7])
    >>> ray[collector.keep(ray, 0, 10)].tolist()
    [1, 3, 6]
    """

    def __init__(self, scan: Scan, face_count: int) -> None:
        super().__init__(scan.groups, scan.keep_every)
        self._tally = np.zeros(face_count, np.int64) if scan.tally else None
        self._kept: list[Part] = []

    def keep(self, ray: Integers, start: int, stop: int) -> slice | Indices:
        """Count the hits of rays `start` to `stop` and select those to keep.

        Parameters
        ----------
        ray
            (m,): numbers of the rays that hit, ascending, counted from `start`.

        Returns
        -------
        The selection of kept hits: rows of `ray`, or all.
        """
        groups, begins = self.spans(start, stop)
        cuts = np.searchsorted(ray, begins.astype(ray.dtype))
        cuts = np.concatenate([[0], cuts, [len(ray)]])
        leave, number = self.count(groups, np.diff(cuts))
        if self.every == 1:
            return slice(None)
        if len(leave) == 1:
            return np.arange(leave[0], len(ray), self.every)
        offset = cuts[:-1] + leave - self.every * (np.cumsum(number) - number)
        rows: Indices = np.repeat(offset, number)
        rows += self.every * np.arange(len(rows))
        return rows

    def tally(self, rows: Integers) -> None:
        """Count all hits of a chunk by their rows in the tally, if requested."""
        if self._tally is not None:
            np.add.at(self._tally, rows.astype(np.intp), 1)

    def add(
        self,
        start: int,
        ray: Integers,
        distance: Floats,
        triangle: Ints32,
        instance: Ints32,
    ) -> None:
        """Add kept hits of a chunk, whose rays are counted from `start`."""
        number = ray.astype(np.uint32, copy=False)
        number = number + np.uint32(start) if start else number
        self._kept.append((number, distance, triangle, instance))

    def result(self) -> ScanReturns:
        """Return the result of all chunks."""
        ray, distance, triangle, instance = joined(self._kept)
        return ScanReturns(ray, distance, triangle, self.hits, self._tally, instance)
