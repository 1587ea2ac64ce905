"""benchmarks/leaks.py at toy size: the default survey's own objects do not leak."""

from __future__ import annotations

import json

import pytest
from benchmarks import leaks

pytestmark = pytest.mark.slow

NAMES = ["cube", "unit sphere", "sphere", "vase", "bell", "pawn", "spindle", "bowl", "terrain box"]


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
