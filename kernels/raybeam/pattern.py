"""Ray patterns that are cast from many poses."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from operator import index

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from .arrays import Floats, Ints
from .poses import Poses
from .rays import check_origins, unit_directions
from .sub_rays import SubRays

# Fractional part of the golden ratio. Its multiples modulo 1 are evenly distributed.
GOLDEN = 0.618033988749895
_MAX_STEP = 256  # largest step that is estimated
_SAMPLES = 384  # number of rows that are compared with later rows; more than `_MAX_STEP`
# Relative differences up to which squared lengths count as equal: for directions in float64, for
# directions in float32, and for directions with jitter.
_EXACT = 1e-9
_NEAR = 1e-3
_ROUGH = 0.1


class Pattern:
    """Set of rays that is cast repeatedly, such as one revolution of a lidar.

    Rays are validated and normalized once, and a backend can keep a copy on its device.

    Parameters
    ----------
    directions
        (n, 3): directions in the sensor frame, of any length greater than zero.
    origins
        (n, 3), or (3,) for all rays: start of each ray in the sensor frame, relative to the sensor
        position, in meters. None if all rays start at the sensor position.
    sub_rays
        Sub-rays of each direction, which are cast instead of the direction itself, one beam after
        the other. They are computed during the cast. None for a single ray per direction.
    offsets
        (n, 2): angles across and up, in radians, that are added to the angles of the sub-rays of
        each direction.
    step
        Number of rows between consecutive firings of a channel, that is, between neighboring rays
        in a ring. It is the number of channels if each firing contains all channels, and 1 if the
        rays are stored ring by ring. By default, it is estimated, which can fail for steps above
        256. A wrong step makes casting slower but does not affect the results.

    Raises
    ------
    ValueError
        If a shape is wrong, a direction is zero or not finite, an origin is not finite, or `step`
        is less than 1.

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
        *,
        step: int | None = None,
    ) -> None:
        if step is not None and index(step) < 1:
            raise ValueError(f"step must be at least 1, or None to estimate it, but is {step}.")
        self._step = None if step is None else index(step)
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

    def with_sub_rays(
        self, sub_rays: SubRays, offsets: Floats | None = None, beam_indices: Ints | None = None
    ) -> Pattern:
        """Return a copy with sub-rays, for all beams or for selected beams.

        `beam_indices` (m,) selects the beams, and indices beyond the last row wrap around.
        `offsets` (m, 2) contains the angles across and up, in radians, that are added to the angles
        of the sub-rays of each beam.
        """
        # Estimating takes as long as casting 5,000 rays, so do it once for all copies.
        _ = self.step
        pattern = copy(self)
        if beam_indices is not None:
            pattern._directions = self._directions.take(beam_indices, axis=1, mode="wrap")
            if self._origins is not None:
                pattern._origins = self._origins.take(beam_indices, axis=1, mode="wrap")
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
        """Number of rays per beam."""
        return 1 if self.sub_rays is None else len(self.sub_rays)

    @property
    def directions(self) -> Floats:
        """Unit vectors of the beams. Shape (n, 3).

        The array is read-only, and its transpose is contiguous.
        """
        return self._directions.T

    @property
    def origins(self) -> Floats | None:
        """Origins of the beams in meters, or None if all beams start at the sensor position.

        The array is read-only, and its transpose is contiguous.
        """
        return None if self._origins is None else self._origins.T

    @cached_property
    def step(self) -> int:
        """Number of rows between successive firings of a channel, either passed or estimated."""
        if self._step is not None:
            return self._step
        return _repetition_step(self._directions) or _closest_step(self._directions)

    def shares_origin(self, poses: Poses) -> bool:
        """Return whether all rays have the same origin."""
        own_origins = self._origins is not None or (
            self.sub_rays and self.sub_rays.starts is not None
        )
        return len(poses) == 1 and poses.motion is None and not own_origins


def _repetition_step(directions: Floats) -> int:
    """Return the number of rows after which the distances between neighbors repeat, or 0.

    `directions` (3, n) contains unit vectors. If each firing contains all rings, the distances
    repeat after one firing, because the head has rotated as a whole in between. If the rows are
    stored ring by ring, the distances within a ring are equal, so they repeat after a single row,
    but not after the length of a ring, because rings have different radii. The distances do not
    depend on the rotation axis of the head. The step cannot be found from the nearest neighbors,
    because rings may be closer to each other than firings.
    """
    rows = directions.shape[1]
    steps = min(rows // 2, _MAX_STEP)
    samples = min(rows - 1 - steps, _SAMPLES)
    if steps < 2:
        return 0
    part = directions[:, : samples + steps + 1]
    difference = np.diff(part)
    squared = (difference * difference).sum(axis=0)
    first = squared[:samples]
    deviations = np.abs(sliding_window_view(squared[1:], samples) - first)  # (steps, samples)

    def equal_shares(difference: float) -> Floats:
        """For each step, return the fraction of distances that are equal within a tolerance."""
        return np.asarray((deviations <= difference * first).mean(axis=1))

    # The strict tolerance distinguishes rings of nearly the same radius if the directions are
    # float64. If they are float32, such matches are coincidences, and a smaller step has the same
    # share of matches with the loose tolerance.
    for strict, loose in ((_EXACT, _NEAR), (_NEAR, _NEAR), (_ROUGH, _ROUGH)):
        shares = equal_shares(strict)
        share = shares.max()
        if share >= (0.5 if share == shares[0] else 0.9):  # Short rings have many ends.
            return int((equal_shares(loose) >= share).argmax()) + 1
    return 0


def _closest_step(directions: Floats) -> int:
    """Return the step whose multiples separate the rows with the most similar directions.

    `directions` (3, n) contains unit vectors, of which 32 rows are sampled.
    """
    rows = directions.shape[1]
    steps = np.arange(1, min(rows // 32, _MAX_STEP) + 1)
    if not len(steps):
        return 1
    samples = sample_rows(32, rows)
    compared = samples[:, None] + np.array([[1], [8], [15]])[:, :, None] * steps  # (3, 32, steps)
    cosines = np.zeros(compared.shape)
    for axis in directions:
        cosines += axis[samples][:, None] * axis[compared % rows]
    return int(steps[np.argmax(cosines.min(axis=0).mean(axis=0))])


def sample_rows(count: int, stop: int) -> Ints:
    """Return `count` ascending integers below `stop`, distributed evenly but not regularly.

    Rows at regular intervals may all belong to the same ring.

    Examples
    --------
    >>> sample_rows(5, 100).tolist()
    [0, 23, 47, 61, 85]
    """
    return np.sort((np.arange(count) * GOLDEN % 1 * stop).astype(np.int64))
