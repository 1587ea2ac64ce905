"""Surfaces of revolution are closed, round and as large as they should be."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpool.base.errors import LidarpoolError
from lidarpool.scene.shapes import SEED_POSITIONS, revolve, seed_objects


def solid(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("index", range(6))
def test_each_seed_object(index):
    mesh = seed_objects()[index]
    assert len(mesh.faces) == 12_800
    assert len(mesh.vertices) == 80 * 80 + 2
    assert solid(mesh).is_volume, "closed, faces outward"
    assert solid(mesh).area_faces.min() > 1e-5
    assert len(np.unique(mesh.vertices.round(9), axis=0)) == len(mesh.vertices)
    local = mesh.vertices - [*SEED_POSITIONS[index], 0]
    assert np.hypot(local[:, 0], local[:, 1]).max() == pytest.approx(2.0, abs=1e-12)
    assert local[:, 2].min() == 0.0
    assert 2.0 <= local[:, 2].max() <= 5.2
    if mesh.name == "Sphere":
        assert solid(mesh).volume == pytest.approx(4 / 3 * np.pi * 8, rel=3e-3)


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 5)), min_size=1, max_size=12),
    st.integers(3, 40),
)
def test_revolved_profiles_are_watertight(steps, segments):
    heights = np.cumsum([0.0] + [step for _, step in steps] + [1.0])
    radii = [0.0, *(radius for radius, _ in steps), 0.0]
    mesh = revolve(np.column_stack([radii, heights]), segments)
    assert len(mesh.faces) == 2 * len(steps) * segments
    assert solid(mesh).is_volume


@pytest.mark.parametrize(
    ("profile", "segments", "message"),
    [
        ([(0, 0), (0, 1)], 8, "cannot be revolved"),
        ([(0, 0), (0, 1), (0, 2)], 8, "positive radii"),
        ([(0, 0), (1, 1), (0, 2)], 2, "at least 3"),
        ([(0, 0, 0), (1, 1, 1), (0, 2, 2)], 8, "cannot be revolved"),
    ],
)
def test_bad_profiles(profile, segments, message):
    with pytest.raises(LidarpoolError, match=message):
        revolve(profile, segments)
