import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.render.stage import Stage, make_axis, nice_step


@given(st.floats(1e-6, 1e9))
def test_a_nice_step_is_1_2_or_5_and_just_large_enough(length):
    step = nice_step(length)
    mantissa = step / 10 ** math.floor(math.log10(step) + 1e-9)
    assert min(abs(mantissa - digit) for digit in (1, 2, 5)) < 1e-6
    assert length * (1 - 1e-6) <= step <= 2.5 * length * (1 + 1e-6)


@given(
    low=st.floats(-1e4, 1e4), width=st.floats(0.01, 1e4), origin=st.integers(-6_000_000, 6_000_000)
)
def test_labels_and_offset_give_the_world_coordinate(low, width, origin):
    step = nice_step(width / 6)
    one = make_axis("x", low, low + width, step, float(origin))
    slack = 1e-2 * step
    said = re.fullmatch(r"x(?: ([−+]) ([\d\u2009]+))? \(m\)", one.title)
    offset = float((said[2] or "0").replace("\u2009", "")) * (-1 if said[1] == "+" else 1)
    assert ((one.ticks >= low - slack) & (one.ticks <= low + width + slack)).all()
    for tick, label in zip(one.ticks, one.labels, strict=True):
        assert float(label.replace("−", "-")) + offset == pytest.approx(
            tick + origin, abs=1e-5 + 1e-9 * abs(origin)
        )
        assert len(label) <= 8


def test_far_coordinates_are_labelled_from_a_round_number():
    one = make_axis("x", -50.0, 50.0, 20.0, 500_010.0)
    assert one.labels[0] == "60" and one.title == "x − 499\u2009900 (m)"
    near = make_axis("y", -50.0, 50.0, 20.0, 0.0)
    assert near.labels == ("−40", "−20", "0", "20", "40") and near.title == "y (m)"


@pytest.mark.parametrize(
    "bounds",
    [
        [[0, 0, 0], [0, 0, 0]],
        [[1e5, 1e5, 3], [1e5, 1e5, 3]],
        [[0, 0, 5], [10, 10, 5]],
        [[0, 0, 0], [10_000, 0, 0]],
        [[0, 0, 0], [0, 0, 300]],
        [[0, 0, 0], [0.1, 0.05, 0.02]],
        [[-8e3, -8e3, -100], [8e3, 8e3, 2000]],
    ],
)
def test_any_box_has_a_ground_that_a_camera_can_see(bounds):
    bounds = np.array(bounds, dtype=float)
    stage = Stage.around(bounds, np.zeros(3))
    assert (stage.ground[0] < bounds[0, :2]).all() and (stage.ground[1] > bounds[1, :2]).all()
    assert stage.level < bounds[0, 2]
