"""Meshes and rays on a grid of small integers, where exact arithmetic says what is right."""

import numpy as np
import pytest

from raybeam import RayCaster
from raybeam.triangle import intersect, is_inside, shear_rays

pytest.importorskip("hypothesis")
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

grid = st.integers(-8, 8)


def points(most):
    return hnp.arrays(np.int64, st.tuples(st.integers(1, most), st.just(3)), elements=grid)


def exact(corners, origin, direction):
    """Least of the three weights, their sum and the numerator of t, in integers: (f,) each.

    The ray hits strictly inside where the least weight is positive (weights and sum are turned
    to be positive for a hit), and passes through an edge or corner where it is zero.
    """
    a = corners[:, 0] - origin
    b = corners[:, 1] - origin
    c = corners[:, 2] - origin
    weights = np.stack([np.cross(c, b), np.cross(a, c), np.cross(b, a)]) @ direction
    total = weights.sum(axis=0)
    sign = np.where(total < 0, -1, 1)
    normal = np.cross(b - a, c - a)
    return (weights * sign).min(axis=0), total * sign, (normal * a).sum(axis=1) * -sign


@pytest.mark.extended
@settings(
    max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    corners=hnp.arrays(
        np.int64, st.tuples(st.integers(1, 12), st.just(3), st.just(3)), elements=grid
    ).filter(lambda c: np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]).any()),
    origins=points(10),
    data=st.data(),
)
def test_integer_triangles(backend, corners, origins, data):
    directions = data.draw(
        hnp.arrays(np.int64, origins.shape, elements=grid).filter(lambda d: d.any(axis=1).all())
    )
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    hits = RayCaster(corners.reshape(-1, 3), faces, backend).cast(origins, directions)
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        weight, total, t = exact(corners, origin, direction)
        length = np.linalg.norm(direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(total > 0, t / total * length, np.inf)
        # What touches an edge, or the origin, may go either way by the direction's rounding.
        clear = (weight > 0) & (t > 0)
        nearest = distance[clear].min(initial=np.inf)
        k = hits.triangle[i]
        assert hits.distance[i] <= nearest + 1e-9
        if k < 0:
            assert nearest == np.inf
        elif total[k] > 0:
            assert weight[k] >= 0
            assert hits.distance[i] == pytest.approx(distance[k], abs=1e-9)


@pytest.mark.parametrize("far", [1e155, 1e200, 1e300])
def test_rays_whose_areas_overflow_hit_nothing_and_warn_of_nothing(far):
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float)
    origins = np.array([[far, -far, 5], [far, far, far], [-far, 0, -far]])
    rays = shear_rays(origins, np.tile([0.0, 0.0, -1.0], (3, 1)))
    plane = intersect(rays, np.arange(3), corners, np.zeros(3, int))
    assert not is_inside(plane.a, plane.b, plane.c, plane.det).any()
