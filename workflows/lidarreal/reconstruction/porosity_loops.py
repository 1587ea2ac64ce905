"""Compiled loop that counts the rays that end on surfels or pass through them."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Floats
from raybeam.compiled import compiled


class RaySums(NamedTuple):
    """Sums over the rays that cross each of m surfels."""

    ending: Floats  # (m,), rays that end on the surfel
    passing: Floats  # (m,), rays that pass through it
    offset_m: Floats  # (m,), recorded minus simulated ranges of the ending rays
    squared_m2: Floats  # (m,), squares of these differences


@compiled()
def add_rays(crossings, gap_fraction, dark, on_surfel_m, sums):  # noqa: C901 - a compiled loop
    """Add the rays of a sweep to the sums of the surfels that they cross.

    A ray may end on the surfels that are less than `on_surfel_m` from its return and not dark. The
    probabilities follow from the gap fractions (m,) of the surfels. If `gap_fraction` is empty, the
    ray ends on the first of these surfels.
    """
    rays, layers = crossings.surfel.shape
    ending = np.zeros(layers)
    for ray in range(rays):
        range_m = crossings.range_m[ray]
        reaching = 1.0
        total = 0.0
        for layer in range(layers):
            surfel = crossings.surfel[ray, layer]
            ending[layer] = 0.0
            if surfel < 0:
                continue
            distance_m = crossings.distance_m[ray, layer]
            is_near = abs(range_m - distance_m) < on_surfel_m and not dark[surfel]
            if not len(gap_fraction):
                if is_near and total == 0.0:
                    ending[layer] = 1.0
            else:
                if is_near:
                    ending[layer] = reaching * (1.0 - gap_fraction[surfel])
                reaching *= gap_fraction[surfel]
            total += ending[layer]
        later = 1.0  # probability that the ray ends on a later surfel
        for layer in range(layers):
            surfel = crossings.surfel[ray, layer]
            if surfel < 0:
                continue
            beyond_m = range_m - crossings.distance_m[ray, layer]
            if total > 0.0:
                share = ending[layer] / total
                later -= share
                sums.ending[surfel] += share
                sums.passing[surfel] += max(later, 0.0)
                sums.offset_m[surfel] += share * beyond_m
                sums.squared_m2[surfel] += share * beyond_m * beyond_m
            elif beyond_m > on_surfel_m:
                sums.passing[surfel] += 1.0
