"""A scan that has been checked: which rays of a pattern, from which poses, what to keep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import index

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .given import as_array
from .hits import MOST_RAYS
from .pattern import Pattern, check_pattern, check_window
from .poses import Poses, check_poses
from .rays import Rays, check_interval


@dataclass(frozen=True, eq=False)
class Scan:
    """What `RayCaster.scan` is asked for. Rays are numbered from 0 at the window's start.

    Attributes
    ----------
    pattern
        Rays in the sensor's axes.
    first
        The pattern's row of ray 0; after its last row the pattern starts over.
    count
        Number of rays.
    poses
        Of all rays.
    t_min, t_max
        Hits nearer or farther than this are not reported, metres; both ends count.
    keep_every
        Of each group's hits, those are kept whose number is a multiple of this.
    groups
        int64 (g,): numbers of the rays at which groups begin; ascending, the first is 0.
    tally
        Whether hits are counted by triangle.
    """

    pattern: Pattern
    first: int
    count: int
    poses: Poses
    t_min: float
    t_max: float
    keep_every: int
    groups: NDArray[np.int64]
    tally: bool

    def __len__(self) -> int:
        return self.count

    def chunks(self, size: int) -> Iterator[tuple[int, int]]:
        """Half-open ranges of rays, at most `size` each, in ray order."""
        for start in range(0, self.count, size):
            yield start, min(start + size, self.count)

    def rays(self, start: int, stop: int) -> Rays:
        """Rays `start` to `stop`, made as `Pattern.rays` makes them."""
        ray = np.arange(start, stop, dtype=np.int64)
        return Rays(*self.pattern.made(self.first, ray, self.poses), self.t_min, self.t_max)


def check_scan(
    pattern: Pattern,
    positions: ArrayLike,
    rotations: ArrayLike | None = None,
    *,
    window: tuple[int, int] | None = None,
    rays_per_pose: int | None = None,
    t_min: float = 0.0,
    t_max: float = np.inf,
    keep_every: int = 1,
    groups: ArrayLike | None = None,
    tally: bool = False,
) -> Scan:
    """Check the arguments of `RayCaster.scan`, which tells what they are and what is raised."""
    start, stop = check_window(check_pattern(pattern), window)
    count = stop - start
    if count > MOST_RAYS:
        raise ValueError(
            f"{count:,} rays are more than the {MOST_RAYS:,} that one call can number: "
            "scan smaller windows."
        )
    return Scan(
        pattern,
        start % max(len(pattern), 1),
        count,
        check_poses(positions, rotations, rays_per_pose, count),
        *check_interval(t_min, t_max),
        _check_keep_every(keep_every),
        _check_groups(groups, count),
        bool(tally),
    )


def _check_keep_every(keep_every: int) -> int:
    try:
        every = index(keep_every)
    except TypeError as error:
        raise TypeError(f"keep_every must be a whole number, not {keep_every!r}.") from error
    if every < 1:
        raise ValueError(f"keep_every is {every}: it must be at least 1, which keeps all hits.")
    return every


def _check_groups(groups: ArrayLike | None, rays: int) -> NDArray[np.int64]:
    if groups is None:
        return np.zeros(1, np.int64)
    given = as_array("groups", groups)
    if given.ndim != 1 or not len(given) or given.dtype.kind not in "iu":
        raise ValueError(
            "groups must be numbers of the rays at which groups begin, integers of shape (g,), "
            f"not {given.dtype} {given.shape}."
        )
    begins = given.astype(np.int64)
    if begins[0] != 0 or begins[-1] > rays or (np.diff(begins) < 0).any():
        raise ValueError(
            f"groups begin at rays {begins[0]} to {begins[-1]}: expected numbers that ascend "
            f"from 0 and do not go past the window's {rays:,} rays."
        )
    return begins
