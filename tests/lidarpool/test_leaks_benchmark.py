"""benchmarks/leaks.py at toy size: the default survey's own objects do not leak."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest
from benchmarks import leaks

from raybeam import RayCaster

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
    """A ray from inside crosses the surface an odd number of times."""
    for mesh in meshes:
        caster = RayCaster(mesh.vertices, mesh.faces, "numpy")
        rng = np.random.default_rng(0)
        for _ in range(20):
            start = mesh.inside + mesh.room * rng.uniform(-1, 1, 3)
            assert caster.count(start, rng.normal(size=3), every=True).sum() % 2 == 1


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
