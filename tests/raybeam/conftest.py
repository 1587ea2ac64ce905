"""Backends under test: the list grows with what the machine has.

Beside the three real ones there is "source": intersect.cu compiled for the CPU.
"""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.gpu_scenes import grid_faces
from tests.cuda_on_host import source_backend  # noqa: F401 - a fixture

from raybeam import RayCaster, available_backends, registry

CUDA = pytest.param("cuda", marks=pytest.mark.gpu)


def usable(name, request):
    """Make a backend known to `RayCaster` for a test; skips where it cannot be used."""
    if name == "source":
        made = request.getfixturevalue("source_backend")
        patch = request.getfixturevalue("monkeypatch")
        patch.setattr(registry, "BACKENDS", (*registry.BACKENDS, made))
    elif reason := available_backends()[name]:
        pytest.skip(f"{name}: {reason}")
    return name


@pytest.fixture(params=["numpy", "tiles", "source", CUDA])
def backend(request):
    """Name of a backend that can be used here, for ``RayCaster(..., backend=backend)``."""
    return usable(request.param, request)


@pytest.fixture(params=["source", CUDA])
def kernels(request):
    """Name of a backend whose rays intersect.cu casts."""
    return usable(request.param, request)


@pytest.fixture
def caster(backend):
    """Make a `RayCaster` with the backend under test."""
    return lambda vertices, faces, **more: RayCaster(vertices, faces, backend, **more)


def _cube():
    x, y, z = np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij")
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), np.array(faces)


def _sphere(rows=40, columns=60, radius=1.0):
    polar = np.linspace(0, np.pi, rows)[:, None]
    around = np.arange(columns) * 2 * np.pi / columns
    ring = np.sin(polar)
    ring[[0, -1]] = 0
    points = np.broadcast_arrays(ring * np.cos(around), ring * np.sin(around), np.cos(polar))
    return radius * np.stack(points, axis=-1).reshape(-1, 3), grid_faces(rows, columns, wrap=True)


def _vase(rows=80, columns=80):
    """A surface of revolution like the default survey's objects, with a waist."""
    points, faces = _sphere(rows, columns, 2.0)
    height = points[:, 2]
    points[:, :2] *= (0.65 + 0.35 * np.cos(3 * height))[:, None]
    return points, faces


def _terrain_box(cells=60):
    """Rough ground with walls and a lid: closed."""
    line = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    ground = np.stack([x, y, 0.1 * np.sin(17 * x) * np.cos(23 * y) + 0.05 * np.sin(91 * x * y)], -1)
    points = ground.reshape(-1, 3)
    lid = points * [1, 1, 0] + [0, 0, 1]
    n = cells + 1
    faces = grid_faces(n, n)
    rim = np.concatenate([
        np.arange(n), np.arange(1, n) * n + n - 1,
        (n - 1) * n + np.arange(n - 2, -1, -1), np.arange(n - 2, 0, -1) * n,
    ])  # fmt: skip
    nxt = np.roll(rim, -1)
    top = rim + len(points)
    above = np.roll(top, -1)
    walls = np.concatenate([np.stack([rim, nxt, above], -1), np.stack([rim, above, top], -1)])
    return np.concatenate([points, lid]), np.concatenate([faces, faces + len(points), walls])


def _soup(kind, count=300, seed=0):
    """Unconnected triangles of one kind, some 20 m around zero."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-20, 20, (count, 1, 3))
    edges = rng.normal(size=(count, 2, 3))
    if kind == "sliver":
        edges *= 8
        edges[:, 1] = edges[:, 0] * rng.uniform(0.1, 1, (count, 1)) + 1e-4 * edges[:, 1]
    else:
        edges *= {"random": 4.0, "huge": 1e3, "tiny": 1e-3}[kind]
    points = np.concatenate([first, first + edges], axis=1).reshape(-1, 3)
    return points, np.arange(3 * count).reshape(-1, 3)


@pytest.fixture(scope="session")
def shapes():
    """Makers of meshes, by name: each returns vertices and faces."""
    return {
        "cube": _cube,
        "sphere": _sphere,
        "vase": _vase,
        "terrain box": _terrain_box,
        "soup": _soup,
    }
