import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpool.render.camera import fit_camera
from lidarpool.render.labels import axis_labels
from lidarpool.render.stage import Stage, axis, nice_step, robust_bounds


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
    one = axis("x", low, low + width, nice_step(width / 6), float(origin))
    slack = 1e-2 * one.step
    assert ((one.ticks >= low - slack) & (one.ticks <= low + width + slack)).all()
    for tick, label in zip(one.ticks, one.labels, strict=True):
        assert float(label.replace("−", "-")) + one.offset == pytest.approx(
            tick + origin, abs=1e-5 + 1e-9 * abs(origin)
        )
        assert len(label) <= 8


def test_far_coordinates_are_labelled_from_a_round_number():
    one = axis("x", -50.0, 50.0, 20.0, 500_010.0)
    assert one.offset == 499_900 and one.labels[0] == "60"
    assert one.title == "x − 499\u2009900 (m)"
    near = axis("y", -50.0, 50.0, 20.0, 0.0)
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
    camera = fit_camera(stage.corners, (640, 400), (0.1, 0.1, 0.9, 0.9))
    labels, _ = axis_labels(stage, camera)
    titles = " ".join(label.text for label in labels if label.mark is None)
    assert "x" in titles and "y" in titles
    assert np.isfinite([label.place for label in labels]).all()
    assert len(labels) < 40


@settings(max_examples=30)
@given(st.floats(0.1, 10_000), st.floats(0.1, 10), st.integers(-90, 90))
def test_numbers_keep_clear_of_each_other(size, aspect, azimuth):
    stage = Stage.around(np.array([[0, 0, 0], [size, size * aspect, size / 9]]), np.zeros(3))
    camera = fit_camera(stage.corners, (1600, 1000), (0.1, 0.1, 0.8, 0.9), azimuth)
    numbers = np.array(
        [label.place for label in axis_labels(stage, camera)[0] if label.mark is not None]
    )
    gaps = np.linalg.norm(numbers[:, None] - numbers[None], axis=2) + 1e9 * np.eye(len(numbers))
    assert gaps.min() >= 20


def test_a_few_stray_points_do_not_blow_up_the_box():
    cloud = np.random.default_rng(1).uniform(0, 10, (2000, 3))
    stray = np.concatenate([cloud, [[1e6, 5, 5], [np.nan, 0, 0], [0, np.inf, 0]]])
    box = robust_bounds(stray)
    assert box[1, 0] < 20
    np.testing.assert_allclose(box[:, 1:], robust_bounds(cloud)[:, 1:])
    np.testing.assert_allclose(robust_bounds(cloud), [cloud.min(axis=0), cloud.max(axis=0)])
    assert robust_bounds(np.full((3, 3), np.nan)) is None
