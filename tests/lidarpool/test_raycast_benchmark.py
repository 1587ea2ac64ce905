"""benchmarks/raycast.py at toy size: the rates mean nothing, that it runs and agrees does."""

from __future__ import annotations

import json

import numpy as np
import pytest
from benchmarks import raycast

from lidarpool.scene.city import city
from lidarpool.scene.scene_file import write_scene

pytestmark = pytest.mark.slow


def test_every_engine_finds_the_same(tmp_path):
    mesh, out = write_scene(tmp_path / "village.glb", city(1_000)), tmp_path / "out.json"
    left_out = ["--without", "Warp CPU", "--without", "Warp CUDA"]  # Warp compiles for seconds
    scenes = ["--scene", "survey", "--scene", "village"]
    arguments = ["--quick", *left_out, *scenes, "--mesh", str(mesh), "--json", str(out)]
    assert raycast.main(arguments) == 0
    jobs = json.loads(out.read_text())["jobs"]
    rows = [(row["scene"], row["order"]) for row in jobs]
    scenes = ["default survey", "village"]
    assert rows == [(scene, order) for scene in scenes for order in ("coherent", "shuffled")]
    for row in jobs:
        shares = {
            name: entry["hit_share"]
            for name, entry in row["engines"].items()
            if name != "brute force, NumPy"  # casts a few of the rays only
        }
        assert {"numpy", "embree", "embree, cast alone", "Open3D, bare"} <= set(shares)
        assert 0.01 < shares["numpy"] < 1
        np.testing.assert_allclose(list(shares.values()), shares["numpy"], atol=2e-3)
