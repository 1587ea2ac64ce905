"""Data structures for the results of ray casting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Bools, Floats, Ints, Ints32, UInts32

# The columns `ray`, `distance`, `triangle` and `instance` of `ScanReturns`.
HitColumns = tuple[UInts32, Floats, Ints32, Ints32]

# Indices of the nonzero counters of a tally, in ascending order, and their numbers of hits.
TallyCounts = tuple[Ints, Ints]


@dataclass(frozen=True)
class Hits:
    """Closest hit of each ray, with one row per ray, including rays that miss.

    Attributes
    ----------
    distance
        float64 (n,): distance from the origin of the ray in meters, independent of the length of
        its direction; inf for a miss.
    triangle
        int32 (n,): index of the triangle in the `faces` of its mesh; -1 for a miss. Ties are
        resolved in favor of the lowest instance index, and then of the lowest triangle index.
    u, v
        float64 (n,): barycentric weights of the second and third vertex of the triangle. The weight
        of the first vertex is ``1 - u - v``. 0 for a miss.
    instance
        int32 (n,): index of the instance; 0 for a mesh without instances, -1 for a miss.
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
        """Mask of the rays that hit a triangle. Shape (n,)."""
        return self.triangle >= 0


@dataclass(frozen=True)
class ScanReturns:
    """Result of a scan: the stored hits in ray order, and the counts of all hits.

    Attributes
    ----------
    ray
        uint32 (k,): index of the ray, where 0 is the first ray of the window. The indices are in
        ascending order.
    distance
        float64 (k,): as in `Hits`, in meters.
    triangle
        int32 (k,): as in `Hits`.
    hit_counts
        int64 (g,): number of hits in each group, including hits that are not stored.
    tally
        int64 (face_count,): number of hits on each triangle, summed over its instances and
        including hits that are not stored. The rows are the triangles of all meshes, in the order
        in which instances first use the meshes. None if the tally was not requested.
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


def join_hits(parts: list[HitColumns]) -> HitColumns:
    """Concatenate hits in the given order. A single part is returned without a copy."""
    if len(parts) == 1:
        return parts[0]
    no_ints = np.zeros(0, np.int32)
    parts = [(np.zeros(0, np.uint32), np.zeros(0), no_ints, no_ints), *parts]
    ray, distance, triangle, instance = map(np.concatenate, zip(*parts, strict=True))
    return ray, distance, triangle, instance
