import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.render.camera import fit_camera

FRAME = (0.1, 0.2, 0.8, 0.9)
BOX = np.array([[x, y, z] for x in (-3, 5) for y in (1, 4) for z in (0, 2)], dtype=float)

angles = st.floats(-180, 180)
elevations = st.floats(5, 80)


@given(azimuth=angles, elevation=elevations, u=st.floats(0, 640), v=st.floats(0, 400))
def test_a_point_on_a_pixels_ray_is_seen_in_that_pixel(azimuth, elevation, u, v):
    camera = fit_camera(BOX, (640, 400), FRAME, azimuth, elevation)
    ray = camera.rays([[u, v]])
    assert np.linalg.norm(ray) == pytest.approx(1)
    pixels, distance = camera.project(camera.eye + 12.5 * ray)
    np.testing.assert_allclose(pixels, [[u, v]], atol=1e-6)
    np.testing.assert_allclose(distance, [12.5])


@given(
    azimuth=angles,
    elevation=elevations,
    size=st.floats(0.05, 20_000),
    shift=st.floats(-1e5, 1e5),
)
def test_the_fitted_points_touch_the_frame_and_stay_inside(azimuth, elevation, size, shift):
    camera = fit_camera(BOX * size + shift, (640, 400), FRAME, azimuth, elevation)
    pixels, _ = camera.project(BOX * size + shift)
    low, high = np.array([64, 80]), np.array([512, 360])
    assert (pixels >= low - 0.01).all() and (pixels <= high + 0.01).all()
    slack = np.minimum(pixels.min(axis=0) - low, high - pixels.max(axis=0))
    assert slack.min() == pytest.approx(0, abs=0.01)
    np.testing.assert_allclose(pixels.min(axis=0) - low, high - pixels.max(axis=0), atol=0.02)


def test_the_camera_stands_upright_and_is_right_handed():
    camera = fit_camera(BOX, (640, 400), FRAME, -60, 30)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    foot, top = camera.project([[0, 0, 0], [0, 0, 1]])[0]
    assert top[1] < foot[1]
    left, right = camera.project([[0, 0, 0], [1, 0, 0]])[0]
    assert right[0] > left[0], "seen from the south, x runs to the right"
