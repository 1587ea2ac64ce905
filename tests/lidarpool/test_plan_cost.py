"""The cost of paths, against the exact distances in double precision."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpool.plan.cost import PathCost
from lidarpool.plan.geometry import path_length, segment_distances


@pytest.mark.parametrize(("discs", "particles"), [(0, 3), (3, 40), (300, 40), (70, 3000)])
def test_a_path_costs_its_length_and_more_for_each_disc_that_it_enters(discs, particles):
    """Also of more discs, or more particles, than are computed at a time."""
    draw = np.random.default_rng(discs)
    centres = draw.uniform(-0.4, 0.4, (discs, 2))
    radii = draw.uniform(0.01, 0.2, discs) / max(1, discs) ** 0.5
    paths = PathCost(centres, radii, 3, particles)
    paths.waypoints[:] = draw.uniform(-0.5, 0.5, paths.waypoints.shape)
    costs = paths.evaluate().astype(np.float64)
    entered = 0
    for number in range(0, particles, max(1, particles // 40)):
        corners = paths.waypoints[..., number].astype(np.float64)
        path = np.vstack([(-0.5, 0), corners, (0.5, 0)])
        nearest = segment_distances(path[:-1], path[1:], centres).min(axis=0)
        penalty = (8 * np.maximum(radii**2 - nearest**2, 0) / radii).sum()
        if abs(penalty) < 1e-3 and discs:
            continue  # it touches discs at most
        price = (penalty > 0) * paths.entry_price
        assert costs[number] == pytest.approx(path_length(path) + penalty + price, rel=1e-4)
        entered += penalty > 0
    assert entered > 10 or not discs
