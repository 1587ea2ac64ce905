"""What comes back from casting rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .memory import Meter

RAY_BYTES = 28  # a ray in `Hits`
HIT_BYTES = 16  # a hit in `Returns`
MOST_RAYS = 1 << 32  # in one call, for their numbers in `Returns` to fit


@dataclass(frozen=True)
class Hits:
    """The closest hit of every ray, misses included.

    Attributes
    ----------
    distance
        float64 (n,): metres from the ray's origin along its direction taken as a unit vector,
        whatever length it was given with; inf for a miss.
    triangle
        int32 (n,): row of `faces`; -1 for a miss. Of triangles at exactly the same distance
        the lowest row is reported.
    u, v
        float64 (n,): barycentric weights of the triangle's second and third corner; the first
        corner's is ``1 - u - v``. 0 for a miss.
    """

    distance: NDArray[np.float64]
    triangle: NDArray[np.int32]
    u: NDArray[np.float64]
    v: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.distance)

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Which rays hit something: (n,)."""
        return self.triangle >= 0


@dataclass(frozen=True)
class Returns:
    """Only the rays that hit, in ray order: what a lidar reports.

    Attributes
    ----------
    ray
        uint32 (k,): number of the ray, ascending.
    distance
        float64 (k,): as in `Hits`, metres.
    triangle
        int32 (k,): as in `Hits`.
    """

    ray: NDArray[np.uint32]
    distance: NDArray[np.float64]
    triangle: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.ray)


@dataclass(frozen=True)
class ScanReturns:
    """What a scan found: the hits that are kept of it, in ray order, and counts of all hits.

    Attributes
    ----------
    ray
        uint32 (k,): number of the ray, ascending, from 0 at the window's start.
    distance
        float64 (k,): as in `Hits`, metres.
    triangle
        int32 (k,): as in `Hits`.
    hits
        int64 (g,): number of hits of each group, kept or not.
    tally
        int64 (face_count,): how many of all hits, kept or not, each triangle got; None if it
        was not asked for.
    """

    ray: NDArray[np.uint32]
    distance: NDArray[np.float64]
    triangle: NDArray[np.int32]
    hits: NDArray[np.int64]
    tally: NDArray[np.int64] | None

    def __len__(self) -> int:
        return len(self.ray)


class Gathering:
    """Hits found part after part, to be joined when all are there."""

    def __init__(self) -> None:
        self._parts: list[Returns] = []
        self._meter = Meter("Joining the hits", "cast fewer rays at a time")

    def add(self, part: Returns) -> None:
        """Take in the next hits; raises MemoryError when they could not be joined any more."""
        self._parts.append(part)
        self._meter.add(HIT_BYTES * len(part))

    def returns(self) -> Returns:
        """All hits, in the order in which they were added."""
        if len(self._parts) == 1:
            return self._parts[0]
        parts = [Returns(np.zeros(0, np.uint32), np.zeros(0), np.zeros(0, np.int32)), *self._parts]
        return Returns(
            np.concatenate([part.ray for part in parts]),
            np.concatenate([part.distance for part in parts]),
            np.concatenate([part.triangle for part in parts]),
        )
