"""Placements: the order of turns, mirrors, and what is no placement."""

import numpy as np
import pytest

from lidarpool.base.errors import LidarpoolError
from lidarpool.scene.transform import UP_AXES, Transform


@pytest.mark.parametrize("axis", "xyz")
def test_the_up_axis_becomes_z(axis):
    matrix = UP_AXES[axis]
    np.testing.assert_array_equal(matrix @ np.eye(3)["xyz".index(axis)], [0, 0, 1])
    assert np.linalg.det(matrix) == 1


def test_scale_then_x_then_y_then_z_then_translation():
    placed = Transform.place((10, 20, 30), (90, 0, 90), (2, 3, 4))
    # x: scaled to 2, stays under the turn about x, goes to y under the turn about z.
    np.testing.assert_allclose(placed.linear.T, [[0, 2, 0], [0, 0, 3], [4, 0, 0]], atol=1e-12)
    assert placed.offset.tolist() == [10, 20, 30]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Transform.place(scale=0), "flattens"),
        (lambda: Transform.place((0, 0, np.nan)), "finite"),
        (lambda: Transform.from_matrix(np.eye(3)), "four rows"),
        (lambda: Transform.from_matrix(np.full((4, 4), 1.0)), "last one 0 0 0 1"),
        (lambda: Transform(np.eye(2), np.zeros(3)), r"\(2, 2\)"),
    ],
)
def test_no_placements(make, message):
    with pytest.raises(LidarpoolError, match=message):
        make()
