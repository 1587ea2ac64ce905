"""Rays in a sensor's axes, cast from one pose after another."""

from __future__ import annotations

from copy import copy
from functools import cache, cached_property
from importlib.util import find_spec
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Ints
from .poses import Motion, Poses, check_poses
from .rays import check_origins, unit_directions
from .sub_rays import SubRays, spread

_MOST_STEP = 1 << 10  # beams of a lidar, by far
_BLOCK = 1 << 14  # rays that are made at a time: their arrays stay in a core's cache


class Pattern:
    """Rays that are cast many times, for example one revolution of a lidar.

    They are checked and normalised once; a backend may keep its own copy on its device.

    Parameters
    ----------
    directions
        (n, 3), any length but zero, in the sensor's axes.
    origins
        (n, 3), metres, in the sensor's axes: start of each ray relative to the sensor's position;
        (3,) for all rays; None if all start at that position.
    sub_rays
        Sub-rays of each direction, one after the other: these are the rays, made when they are
        cast. None for one ray of each direction.
    offsets
        (n, 2): angles across and up, radians, that are added to those of the sub-rays of each.

    Raises
    ------
    ValueError
        For a wrong shape, or a direction that is zero or not finite, or an origin that is not
        finite.

    Examples
    --------
    >>> pattern = Pattern([[2, 0, 0], [0, 1, 0]], origins=[[0.1, 0, 0], [0, 0.1, 0]])
    >>> origins, directions = pattern.rays([0, 1, 2], positions=[0, 0, 5])
    >>> origins.tolist()
    [[0.1, 0.0, 5.0], [0.0, 0.1, 5.0], [0.1, 0.0, 5.0]]
    >>> directions.tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """

    def __init__(
        self,
        directions: ArrayLike,
        origins: ArrayLike | None = None,
        sub_rays: SubRays | None = None,
        offsets: ArrayLike | None = None,
    ) -> None:
        self._directions = unit_directions(directions).T
        self._directions.flags.writeable = False
        self._origins: Floats | None = None
        rows = self._directions.shape[1]
        if origins is not None:
            self._origins = np.empty((3, rows))
            self._origins[...] = check_origins(origins, rows).T
            self._origins.flags.writeable = False
        self.sub_rays = sub_rays
        self.offsets: Floats | None = None  # (2, n)
        if sub_rays is not None and offsets is not None:
            self.offsets = np.ascontiguousarray(np.asarray(offsets, np.float64).T)

    def divided(
        self, sub_rays: SubRays, offsets: Floats | None = None, rows: Ints | None = None
    ) -> Pattern:
        """Return the beams, or those of some rows (m,), with sub-rays; they are not checked again.

        After its last row the pattern repeats.
        `offsets` (m, 2) are as of `Pattern`.
        """
        _ = self.step  # which the copies keep: it takes as long as 10,000 rays
        made = copy(self)
        if rows is not None:
            made._directions = self._directions.take(rows, axis=1, mode="wrap")
            if self._origins is not None:
                made._origins = self._origins.take(rows, axis=1, mode="wrap")
        made.sub_rays = sub_rays
        made.offsets = None if offsets is None else np.ascontiguousarray(offsets.T)
        return made

    def __len__(self) -> int:
        return self._directions.shape[1] * self.each

    def __repr__(self) -> str:
        many = "" if self.sub_rays is None else f", {self.each} sub-rays each"
        beams = self._directions.shape[1]
        return f"Pattern({beams} directions{'' if self._origins is None else ', origins'}{many})"

    @property
    def each(self) -> int:
        """Rays of each direction."""
        return 1 if self.sub_rays is None else len(self.sub_rays)

    @property
    def directions(self) -> Floats:
        """Unit vectors (n, 3), of beams, read-only; transposed, they are contiguous."""
        return self._directions.T

    @property
    def origins(self) -> Floats | None:
        """Starts of beams (n, 3), metres, read-only and contiguous as `directions`; or None."""
        return None if self._origins is None else self._origins.T

    @cached_property
    def step(self) -> int:
        """Rows from a ray to its neighbour along a ring: the step at which rays differ least."""
        rows = self._directions.shape[1]
        steps = np.arange(1, min(rows // 32, _MOST_STEP) + 1)
        if not len(steps):
            return 1
        samples = np.arange(32) * (rows // 32)
        apart = samples[:, None] + np.array([[1], [8], [15]])[:, :, None] * steps  # (3, 32, steps)
        cosines = np.zeros(apart.shape)
        for axis in self._directions:
            cosines += axis[samples][:, None] * axis[apart % rows]
        return int(steps[np.argmax(cosines.min(axis=0).mean(axis=0))])

    def rays(
        self,
        numbers: ArrayLike,
        positions: ArrayLike | Poses,
        rotations: ArrayLike | None = None,
        *,
        start: int = 0,
        rays_per_pose: int | None = None,
        motion: Motion | None = None,
    ) -> tuple[Floats, Floats]:
        """Origins and directions, in the mesh's axes, of some of the rays that a scan casts.

        They have the same bits as the rays that `RayCaster.scan` casts, in any batch.

        Parameters
        ----------
        numbers
            (m,) whole numbers: rays numbered as in `ScanReturns`, from 0 at the window's start.
        positions, rotations, rays_per_pose, motion
            Those given to `RayCaster.scan`.
        start
            Start of the window.

        Returns
        -------
        origins
            float64 (m, 3), or (1, 3) when all are the same, metres.
        directions
            float64 (m, 3), unit vectors.

        Raises
        ------
        ValueError
            If poses are invalid, or a ray has no pose or no row in the pattern.
        """
        ray = np.asarray(numbers).astype(np.int64, casting="same_kind")
        first = index(start)
        most = int(ray.max()) + 1 if len(ray) else 0
        if first < 0 or (len(ray) and (int(ray.min()) < 0 or not len(self))):
            raise ValueError(
                f"There are no rays {ray.min() if len(ray) else 0} to {most} after row {start} of "
                f"a pattern with {len(self)} rows: numbers and rows start at 0."
            )
        poses = check_poses(positions, rotations, rays_per_pose, most, motion)
        return self.made(first, ray, poses)

    def made(self, first: int, ray: Ints, poses: Poses) -> tuple[Floats, Floats]:
        """Make checked rays, in compiled loops if numba is installed; see `plain_rays`."""
        if not (_compiles() and len(ray)):
            return plain_rays(self, first, ray, poses)
        from . import embree_rays  # not before: numba takes half a second to import

        origins, directions = embree_rays.made(self, first, ray, poses)
        return (poses.positions if origins is None else origins.T), directions.T

    def starts_at_once(self, poses: Poses) -> bool:
        """Whether all rays start at one position."""
        aside = self._origins is not None or (self.sub_rays and self.sub_rays.starts is not None)
        return len(poses) == 1 and poses.motion is None and not aside


def plain_rays(pattern: Pattern, first: int, ray: Ints, poses: Poses) -> tuple[Floats, Floats]:
    """Make checked rays; see `Pattern.rays`, of which `first` is the start.

    Vectors are rotated to the mesh's axes, then translated: ``((x a + y b) + z c) + p``; if the
    lidar moves within a pose, ``v + t (w x v)`` and ``p + t u`` follow each step.
    """
    sub_rays, one = pattern.sub_rays, pattern.starts_at_once(poses)
    places, directions = np.empty((2, 3, len(ray)))
    room = np.empty((18, min(len(ray), _BLOCK)))
    for start in range(0, len(ray), _BLOCK):
        block = slice(start, start + _BLOCK)
        some = ray[block]
        row, these = first + some, poses.of(some, room[:, : len(some)])
        row -= row // len(pattern) * len(pattern)  # takes half as long as the remainder
        beam = row // pattern.each
        ahead, begun = _columns(pattern.directions.T, beam), None
        if sub_rays is not None:
            own = None if pattern.offsets is None else pattern.offsets[:, beam]
            ahead, begun = spread(sub_rays, ahead, row - beam * len(sub_rays), own)
        directions[:, block] = these.turned(ahead)
        if one:
            continue
        at = these.positions
        if pattern.origins is not None:
            here = _columns(pattern.origins.T, beam)
            begun = here if begun is None else here + begun
        if begun is not None:
            at = these.turned(begun) + at
        places[:, block] = these.moved(at)
    return (poses.positions if one else places.T), directions.T


@cache
def _compiles() -> bool:
    return find_spec("numba") is not None


def _columns(table: Floats, row: Ints) -> Floats:
    return np.stack([numbers.take(row) for numbers in table])
