"""The parts of benchmarks/cuda_kernel.py that need no device."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import cuda_kernel

from raybeam import RayCaster, available_backends


@pytest.mark.parametrize("triangles", [500, 20_000])
def test_city(triangles):
    vertices, faces = cuda_kernel.city(triangles)
    assert 0.5 < len(faces) / triangles < 1.5
    np.testing.assert_array_equal(cuda_kernel.city(triangles)[0], vertices)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert low[2] == 0
    rng = np.random.default_rng(0)
    above = rng.uniform(low + 0.01, high - 0.01, (500, 3)) * [1, 1, 0] + [0, 0, high[2] + 1]
    down = RayCaster(vertices, faces, "numpy").cast(above, np.tile([0, 0, -1], (500, 1)))
    assert down.hit.all()
    assert 0.1 < (down.distance < high[2]).mean() < 0.9  # roofs, and streets between them


def test_six_objects_are_closed():
    vertices, faces = cuda_kernel.six_objects()
    directions = np.random.default_rng(1).normal(size=(2000, 3))
    assert RayCaster(vertices, faces, "numpy").cast([5, 5, 1], directions).hit.all()
    assert len(faces) == 6 * 79 * 80 * 2


def test_revolution():
    directions = cuda_kernel.revolution(1280, layers=128)
    assert directions.shape == (1280, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)


def test_says_so_without_a_device(capsys):
    if not available_backends()["cuda"]:
        pytest.skip("there is a device")
    assert cuda_kernel.main(["--rays", "100"]) == 2
    assert "Nothing was measured: " in capsys.readouterr().err
