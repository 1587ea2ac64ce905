import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.plan.geometry import clearance, segment_distances

coordinate = st.floats(-50, 50)
point = st.tuples(coordinate, coordinate)


@given(first=point, last=point, centre=point)
def test_distance_is_below_and_close_to_that_of_any_sample(first, last, centre):
    share = np.linspace(0, 1, 401)[:, None]
    samples = np.array(first) * (1 - share) + np.array(last) * share
    sampled = np.hypot(*(samples - centre).T).min()
    found = segment_distances(np.array([first]), np.array([last]), np.array([centre]))[0, 0]
    spacing = math.dist(first, last) / 400
    assert found <= sampled + 1e-9
    assert found >= sampled - spacing / 2 - 1e-9


def test_a_disc_between_samples_is_not_missed():
    """A disc of a thousandth of the segment's length, that no coarse sampling would meet."""
    path = np.array([[0.0, 0], [1000.0, 0]])
    assert clearance(path, np.array([[333.3, 0.4]]), np.array([0.5])) == pytest.approx(-0.1)


def test_clearance_signs():
    path, centre = np.array([[0.0, 0], [10.0, 0]]), np.array([[5.0, 2.0]])
    assert clearance(path, centre, np.array([1.5])) == pytest.approx(0.5)
    assert clearance(path, centre, np.array([3.0])) == pytest.approx(-1)
    assert clearance(path, np.empty((0, 2)), np.empty(0)) == math.inf
