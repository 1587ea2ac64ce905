"""Results of casting rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Bools, Floats, Ints, Ints32, UInts32

# Ray, distance, triangle and instance of hits, as in `ScanReturns`.
Part = tuple[UInts32, Floats, Ints32, Ints32]

# Numbers of the counters of a tally that are not 0, ascending, and their hits.
Counted = tuple[Ints, Ints]


@dataclass(frozen=True)
class Hits:
    """The closest hit of every ray, misses included.

    Attributes
    ----------
    distance
        float64 (n,): meters from the ray's origin, whatever the length of its direction; inf for
        a miss.
    triangle
        int32 (n,): row of the `faces` of the mesh that is hit; -1 for a miss. Of triangles at
        exactly the same distance, the lowest instance is reported, and in it the lowest row.
    u, v
        float64 (n,): barycentric weights of the triangle's second and third corner; the first
        corner's is ``1 - u - v``. 0 for a miss.
    instance
        int32 (n,): number of the instance that is hit; 0 for a plain mesh, -1 for a miss.
    """

    distance: Floats
    triangle: Ints32
    u: Floats
    v: Floats
    instance: Ints32

    def __len__(self) -> int:
        return len(self.distance)

    @property
    def hit(self) -> Bools:
        """Mask (n,) of the rays that hit a triangle."""
        return self.triangle >= 0


@dataclass(frozen=True)
class ScanReturns:
    """Result of a scan: the kept hits, in ray order, and counts of all hits.

    Attributes
    ----------
    ray
        uint32 (k,): number of the ray, ascending, from 0 at the window's start.
    distance
        float64 (k,): as in `Hits`, meters.
    triangle
        int32 (k,): as in `Hits`.
    hit_counts
        int64 (g,): number of hits of each group, kept or not.
    tally
        int64 (face_count,): hits of each triangle, kept or not, whichever instance shows it: the
        rows of all meshes in sequence, in their order of first use by instances. None if not
        requested.
    instance
        int32 (k,): as in `Hits`.
    """

    ray: UInts32
    distance: Floats
    triangle: Ints32
    hit_counts: Ints
    tally: Ints | None
    instance: Ints32

    def __len__(self) -> int:
        return len(self.ray)


def join_hits(parts: list[Part]) -> Part:
    """Join the hits of parts, in order, without a copy of a single part."""
    if len(parts) == 1:
        return parts[0]
    no_ints = np.zeros(0, np.int32)
    parts = [(np.zeros(0, np.uint32), np.zeros(0), no_ints, no_ints), *parts]
    ray, distance, triangle, instance = map(np.concatenate, zip(*parts, strict=True))
    return ray, distance, triangle, instance
