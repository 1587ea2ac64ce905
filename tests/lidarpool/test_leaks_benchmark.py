"""benchmarks/leaks.py at toy size: the default survey's own objects do not leak."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest
from benchmarks import leaks

pytestmark = pytest.mark.slow

NAMES = ["cube", "unit sphere", "sphere", "vase", "bell", "pawn", "spindle", "bowl", "terrain box"]


@pytest.fixture(scope="module")
def meshes():
    made = list(leaks.closed_meshes(3_000))
    assert [mesh.name for mesh in made] == NAMES
    return made


def test_meshes_are_closed(meshes):
    for mesh in meshes:
        faces = mesh.faces
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        there, back = (Counter(map(tuple, e.tolist())) for e in (edges, edges[:, ::-1]))
        assert there == back


def test_points_are_inside(meshes):
    """The surface covers the whole sphere of directions, once (Van Oosterom and Strackee, 1983)."""
    rng = np.random.default_rng(0)
    for mesh in meshes:
        for _ in range(5):
            start = mesh.inside + mesh.room * rng.uniform(-1, 1, 3)
            a, b, c = (mesh.vertices[mesh.faces[:, k]] - start for k in range(3))
            x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
            volume = (a * np.cross(b, c)).sum(axis=1)
            sides = (a * b).sum(axis=1) * z + (b * c).sum(axis=1) * x + (c * a).sum(axis=1) * y
            assert abs(2 * np.arctan2(volume, x * y * z + sides).sum()) == pytest.approx(4 * np.pi)


def test_none_escapes_but_from_embree(tmp_path, capsys):
    out = tmp_path / "leaks.json"
    arguments = ["--rays", "90000", "--triangles", "3000", "--json", str(out)]
    assert leaks.main(arguments) == 0
    results = json.loads(out.read_text())
    assert set(results["numpy"]) == set(NAMES)
    for name, meshes in results.items():
        for entry in meshes.values():
            assert entry["rays"] == 10_000
            assert entry["escaped"] <= (0.01 * entry["rays"] if name == "embree" else 0)
    assert "numpy: 0 of " in capsys.readouterr().out
