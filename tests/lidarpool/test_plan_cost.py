import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.plan.cost import PathCost
from lidarpool.plan.geometry import clearance, path_length

START, TARGET = (-0.5, 0.0), (0.5, 0.0)

disc = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.01, 0.4))


def discs_of(triples):
    """Centres and radii of the discs that hold neither end."""
    kept = [
        (x, y, r)
        for x, y, r in triples
        if min(math.dist((x, y), START), math.dist((x, y), TARGET)) > r + 1e-4
    ]
    array = np.array(kept).reshape(-1, 3)
    return array[:, :2], array[:, 2]


def paths_of(cost):
    """Whole paths, float64: (particles, k + 2, 2)."""
    corners = np.moveaxis(cost.waypoints, -1, 0).astype(np.float64)
    ends = np.broadcast_to(np.array([[START], [TARGET]]), (2, len(corners), 2))
    return np.concatenate([ends[0][:, None], corners, ends[1][:, None]], axis=1)


@given(
    discs=st.lists(disc, max_size=6), waypoints=st.integers(1, 5), seed=st.integers(0, 2**32 - 1)
)
def test_free_paths_cost_their_length_and_others_more_than_any_detour(discs, waypoints, seed):
    centres, radii = discs_of(discs)
    cost = PathCost(centres, radii, waypoints, particles=40)
    cost.waypoints[:] = np.random.default_rng(seed).uniform(-0.6, 0.6, cost.waypoints.shape)
    found = cost.evaluate()
    for path, price in zip(paths_of(cost), found, strict=True):
        room, length = clearance(path, centres, radii), path_length(path)
        if room > 1e-4:
            assert price == pytest.approx(length, rel=1e-5)
        if room < 0:
            # at least 8 for each unit of depth, besides the fixed price
            assert price > (length + cost.entry_price - 8 * room) * (1 - 1e-5)
        if price < cost.entry_price:
            assert room >= 0, "what is cheap passes the exact check"
