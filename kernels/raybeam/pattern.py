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

_MAX_STEP = 1 << 10  # more than the beams of any lidar


class Pattern:
    """Rays that are cast repeatedly, for example a revolution of a lidar.

    Rays are checked and normalised once; a backend may keep a copy on its device.

    Parameters
    ----------
    directions
        (n, 3), any length but zero, in the sensor's axes.
    origins
        (n, 3), metres, in the sensor's axes: start of each ray relative to the sensor's position;
        (3,) for all rays; None if all start at that position.
    sub_rays
        Sub-rays of each direction, in sequence: these become the rays, computed during a cast.
        None for a single ray of each direction.
    offsets
        (n, 2): angles across and up, radians, added to the angles of the sub-rays of each
        direction.

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
        self.max_origin = 0.0  # upper bound of the coordinates of origins, metres
        rows = self._directions.shape[1]
        if origins is not None:
            self._origins = np.empty((3, rows))
            self._origins[...] = check_origins(origins, rows).T
            self._origins.flags.writeable = False
            self.max_origin = float(np.abs(self._origins).max(initial=0))
        self.sub_rays = sub_rays
        self.offsets: Floats | None = None  # (2, n)
        if sub_rays is not None and offsets is not None:
            self.offsets = np.ascontiguousarray(np.asarray(offsets, np.float64).T)

    def divided(
        self, sub_rays: SubRays, offsets: Floats | None = None, rows: Ints | None = None
    ) -> Pattern:
        """Return a copy with sub-rays, of all beams or of the rows (m,), without another check.

        After its last row the pattern repeats. `offsets` (m, 2) are angles across and up of each
        beam, radians, added to the angles of its sub-rays.
        """
        _ = self.step  # computed here for all copies: takes as long as 10,000 rays
        pattern = copy(self)
        if rows is not None:
            pattern._directions = self._directions.take(rows, axis=1, mode="wrap")
            if self._origins is not None:
                pattern._origins = self._origins.take(rows, axis=1, mode="wrap")
        pattern.sub_rays = sub_rays
        pattern.offsets = None if offsets is None else np.ascontiguousarray(offsets.T)
        return pattern

    def __len__(self) -> int:
        return self._directions.shape[1] * self.subrays_per_beam

    def __repr__(self) -> str:
        beams = self._directions.shape[1]
        origins = "" if self._origins is None else ", origins"
        sub_rays = "" if self.sub_rays is None else f", {self.subrays_per_beam} sub-rays each"
        return f"Pattern({beams} directions{origins}{sub_rays})"

    @property
    def subrays_per_beam(self) -> int:
        """Number of rays of each direction."""
        return 1 if self.sub_rays is None else len(self.sub_rays)

    @property
    def directions(self) -> Floats:
        """Unit vectors (n, 3) of the beams, read-only; the transposed array is contiguous."""
        return self._directions.T

    @property
    def origins(self) -> Floats | None:
        """Origins of the beams (n, 3), metres, read-only, transposed contiguous; or None."""
        return None if self._origins is None else self._origins.T

    @cached_property
    def step(self) -> int:
        """Rows from a ray to its neighbour along a ring: the step of least difference."""
        rows = self._directions.shape[1]
        steps = np.arange(1, min(rows // 32, _MAX_STEP) + 1)
        if not len(steps):
            return 1
        samples = np.arange(32) * (rows // 32)
        compared = (
            samples[:, None] + np.array([[1], [8], [15]])[:, :, None] * steps
        )  # (3, 32, steps)
        cosines = np.zeros(compared.shape)
        for axis in self._directions:
            cosines += axis[samples][:, None] * axis[compared % rows]
        return int(steps[np.argmax(cosines.min(axis=0).mean(axis=0))])

    def shares_origin(self, poses: Poses) -> bool:
        """Return whether all rays start at a single position."""
        own_origins = self._origins is not None or (
            self.sub_rays and self.sub_rays.starts is not None
        )
        return len(poses) == 1 and poses.motion is None and not own_origins
