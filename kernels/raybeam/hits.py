"""What comes back from casting rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
        int64 (k,): number of the ray, ascending.
    distance
        float64 (k,): as in `Hits`, metres.
    triangle
        int32 (k,): as in `Hits`.
    """

    ray: NDArray[np.int64]
    distance: NDArray[np.float64]
    triangle: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.ray)
