"""Scans, which combine a pattern with poses, and the choice of hits to store."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Indices, Integers, Ints, Ints32
from .hits import HitColumns, ScanReturns, join_hits
from .pattern import Pattern
from .pattern_rays import compute_rays
from .poses import PoseMotion, Poses, check_poses
from .rays import Rays, check_interval

_MAX_RAYS = 1 << 32  # ray indices in `ScanReturns` have 32 bits


@dataclass(frozen=True, eq=False)
class Scan:
    """Validated arguments of `RayCaster.scan`.

    Attributes
    ----------
    pattern
        Rays in the sensor frame.
    first
        Row of ray 0 in the pattern, which repeats after its last row.
    count
        Number of rays.
    poses
        Poses of all rays.
    t_min, t_max
        Minimum and maximum distance of a hit in meters, both inclusive.
    keep_every
        The first hit of each group and then every n-th hit are stored.
    groups
        int64 (g,): index of the first ray of each group, in ascending order and starting at 0.
    tally
        Whether hits are counted per triangle.
    out
        float64 (6, count): output array for the origins and directions of all rays, or (3, count)
        for the directions only. None if they are not needed.
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
    out: Floats | None = None

    def __len__(self) -> int:
        return self.count

    def chunks(self, size: int) -> Iterator[tuple[int, int]]:
        """Yield consecutive ranges of at most `size` rays, each as start and stop."""
        for start in range(0, self.count, size):
            yield start, min(start + size, self.count)

    def rays(self, start: int, stop: int) -> Rays:
        """Compute rays `start` to `stop`, with the same bits as `pattern_rays`.

        If the scan has an output array, the rays are written to it.
        """
        ray = np.arange(start, stop, dtype=np.int64)
        origins, directions = compute_rays(self.pattern, self.first, ray, self.poses)
        if self.out is not None:
            self.out[-3:, start:stop] = directions.T
            if len(self.out) > 3:
                self.out[:3, start:stop] = origins.T
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
    out: Floats | None = None,
) -> Scan:
    """Validate the arguments of a scan.

    `RayCaster.scan` describes the arguments and exceptions.
    """
    start, stop = (0, len(pattern)) if window is None else map(index, window)
    if not 0 <= start <= stop or (stop > start and not len(pattern)):
        raise ValueError(
            f"window must satisfy 0 <= start <= stop, but is ({start}, {stop}) for a pattern with "
            f"{len(pattern)} rows."
        )
    count = stop - start
    if count > _MAX_RAYS:
        raise ValueError(
            f"The window has {count:,} rays, but the limit is {_MAX_RAYS:,} per call. Scan smaller "
            "windows."
        )
    if index(keep_every) < 1:
        raise ValueError(f"keep_every must be at least 1, but is {keep_every}.")
    poses = check_poses(positions, rotations, rays_per_pose, count, motion)
    t_min, t_max = check_interval(t_min, t_max)
    return Scan(
        pattern=pattern,
        first=start % max(len(pattern), 1),
        count=count,
        poses=poses,
        t_min=t_min,
        t_max=t_max,
        keep_every=index(keep_every),
        groups=np.zeros(1, np.int64) if groups is None else np.asarray(groups, np.int64),
        tally=tally,
        out=out,
    )


def host_rays(scan: Scan, start: int, stop: int) -> Floats:
    """Compute the origins (in meters) and the directions of rays `start` to `stop` in a scan.

    The result has shape (6, n).
    """
    if scan.out is not None:  # The caster has already written the rays.
        return np.ascontiguousarray(scan.out[:, start:stop])
    scan_rays = scan.rays(start, stop)
    rays = np.empty((6, stop - start))
    rays[:3] = scan_rays.origins.T
    rays[3:] = scan_rays.directions.T
    return rays


class HitGroups:
    """Counts the hits in each group of rays, and selects every n-th hit within a group.

    Parameters
    ----------
    starts
        int64 (g,): index of the first ray of each group, in ascending order and starting at 0.
    keep_every
        The first hit of each group and then every n-th hit are stored.
    """

    def __init__(self, starts: Ints, keep_every: int) -> None:
        self._starts = starts
        self.keep_every = keep_every
        self.hit_counts = np.zeros(len(starts), np.int64)  # number of hits in each group so far

    def find_groups(self, start: int, stop: int) -> tuple[slice, Ints]:
        """Find the groups to which rays `start` to `stop` belong.

        Returns
        -------
        groups
            Range of groups.
        later_starts
            int64: first ray of the second and later of these groups, relative to `start`.
        """
        first = int(np.searchsorted(self._starts, start, side="right")) - 1
        last = int(np.searchsorted(self._starts, stop, side="left"))
        return slice(first, last), self._starts[first + 1 : last] - start

    def count_hits(self, groups: slice, counts: Ints) -> tuple[Ints, Ints]:
        """Count a chunk's hits by group, and determine which hits to store.

        Parameters
        ----------
        groups
            Range of g groups.
        counts
            int64 (g,): number of hits of each group in the chunk.

        Returns
        -------
        first_kept
            int64 (g,): index of the first hit to store among the hits of each group in the chunk.
        kept_counts
            int64 (g,): number of hits to store.
        """
        # Only the first of these groups can have hits in earlier chunks.
        earlier_hits = self.hit_counts[groups].copy()
        self.hit_counts[groups] += counts
        first_kept = -earlier_hits % self.keep_every
        return first_kept, np.maximum(-((first_kept - counts) // self.keep_every), 0)


class HitCollector(HitGroups):
    """Collects the hits of a scan, chunk by chunk in ray order.

    Parameters
    ----------
    scan
        The scan, which determines the hits to store and whether hits are counted per triangle.
    face_count
        Number of rows of the tally.

    Examples
    --------
    >>> pattern = Pattern([[1, 0, 0]] * 10)
    >>> collector = HitCollector(check_scan(pattern, [0, 0, 0], keep_every=2, groups=[0, 5]), 1)
    >>> ray = np.array([1, 2, 3, 6, 7])
    >>> ray[collector.select_kept(ray, 0, 10)].tolist()
    [1, 3, 6]
    """

    def __init__(self, scan: Scan, face_count: int) -> None:
        super().__init__(scan.groups, scan.keep_every)
        self._tally = np.zeros(face_count, np.int64) if scan.tally else None
        self._parts: list[HitColumns] = []

    def select_kept(self, ray: Integers, start: int, stop: int) -> slice | Indices:
        """Count the hits of rays `start` to `stop`, and select the hits to store.

        Parameters
        ----------
        ray
            (m,): indices of the rays that hit, relative to `start`, in ascending order.

        Returns
        -------
        The rows of `ray` to store, as a slice or as indices.
        """
        groups, later_starts = self.find_groups(start, stop)
        cuts = np.searchsorted(ray, later_starts.astype(ray.dtype))
        cuts = np.concatenate([[0], cuts, [len(ray)]])
        first_kept, kept_counts = self.count_hits(groups, np.diff(cuts))
        if self.keep_every == 1:
            return slice(None)
        if len(first_kept) == 1:
            return np.arange(first_kept[0], len(ray), self.keep_every)
        offset = cuts[:-1] + first_kept - self.keep_every * (np.cumsum(kept_counts) - kept_counts)
        row_indices: Indices = np.repeat(offset, kept_counts)
        row_indices += self.keep_every * np.arange(len(row_indices))
        return row_indices

    def count_triangles(self, tally_indices: Integers) -> None:
        """Add a chunk's hits to the tally. `tally_indices` contains the tally row of each hit.

        Without a tally, the call has no effect.
        """
        if self._tally is not None:
            np.add.at(self._tally, tally_indices.astype(np.intp), 1)

    def add_hits(
        self,
        start: int,
        ray: Integers,
        distance: Floats,
        triangle: Ints32,
        instance: Ints32,
    ) -> None:
        """Add a chunk's stored hits, whose ray indices are relative to `start`."""
        ray_number = ray.astype(np.uint32, copy=False)
        ray_number = ray_number + np.uint32(start) if start else ray_number
        self._parts.append((ray_number, distance, triangle, instance))

    def result(self) -> ScanReturns:
        """Combine the results of all chunks."""
        ray, distance, triangle, instance = join_hits(self._parts)
        return ScanReturns(ray, distance, triangle, self.hit_counts, self._tally, instance)
