"""Rays in a sensor's axes, cast from one pose after another."""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Ints
from .poses import Poses
from .rays import check_origins, unit_directions
from .sub_rays import SubRays

_MOST_STEP = 1 << 10  # beams of a lidar, by far


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
    >>> len(pattern), pattern.directions.tolist()
    (2, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
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

    def starts_at_once(self, poses: Poses) -> bool:
        """Whether all rays start at one position."""
        apart = self._origins is not None or (self.sub_rays and self.sub_rays.starts is not None)
        return len(poses) == 1 and poses.motion is None and not apart
