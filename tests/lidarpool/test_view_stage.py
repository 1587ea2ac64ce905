import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.render.stage import make_axis, nice_step


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
