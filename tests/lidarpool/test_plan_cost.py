import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.plan import shortest_path_length
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


def random_paths(cost, seed, spread=0.6):
    random = np.random.default_rng(seed)
    cost.waypoints[:] = random.uniform(-spread, spread, cost.waypoints.shape)


@given(
    discs=st.lists(disc, max_size=6), waypoints=st.integers(1, 5), seed=st.integers(0, 2**32 - 1)
)
def test_free_paths_cost_their_length_and_others_more_than_any_detour(discs, waypoints, seed):
    centres, radii = discs_of(discs)
    cost = PathCost(centres, radii, waypoints, particles=40)
    random_paths(cost, seed)
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


@given(discs=st.lists(disc, min_size=1, max_size=6))
def test_the_price_of_entry_is_above_the_shortest_detour(discs):
    centres, radii = discs_of(discs)
    cost = PathCost(centres, radii, waypoints=2, particles=1)
    shortest = shortest_path_length(START, TARGET, centres, radii)
    assert cost.entry_price > shortest or shortest == math.inf


def test_the_margin_is_wider_than_rounding_and_narrower_than_a_millimetre_in_100_m():
    """Paths that pass a disc at a millionth and at a hundred-thousandth of their length."""
    centres, radii = np.array([[0.0, 0.0]]), np.array([0.1])
    cost = PathCost(centres, radii, waypoints=2, particles=2)
    cost.waypoints[0, 0], cost.waypoints[1, 0] = -0.2, 0.2
    cost.waypoints[:, 1] = 0.1 + np.array([1e-6, 1e-5])
    near, far = (clearance(path, centres, radii) for path in paths_of(cost))
    assert 0 < near < 2e-6
    assert 9e-6 < far < 2e-5
    charged, free = cost.evaluate()
    assert charged > cost.entry_price
    assert free < 1.1
