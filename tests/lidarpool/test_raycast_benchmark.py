"""benchmarks/raycast.py at toy size: the rates mean nothing, that it runs and agrees does."""

from __future__ import annotations

import json

import numpy as np
import pytest
from benchmarks import raycast
from benchmarks.raycast_engines import BruteForce, Embree, Numpy
from benchmarks.raycast_peers import EmbreeAlone, Open3D
from benchmarks.raycast_scenes import jobs, survey_job

from lidarpool.scene.city import city
from lidarpool.scene.scene_file import write_scene
from raybeam import RayCaster

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """What it wrote, run at toy size with a mesh file."""
    folder = tmp_path_factory.mktemp("bench")
    mesh = write_scene(folder / "village.glb", city(1_000))
    out = folder / "out.json"
    left_out = ["--without", "Warp CPU", "--without", "Warp CUDA"]  # Warp compiles for seconds
    scenes = ["--scene", "survey", "--scene", "village"]
    arguments = ["--quick", *left_out, *scenes, "--mesh", str(mesh), "--json", str(out)]
    assert raycast.main(arguments) == 0
    return json.loads(out.read_text())


def test_every_scene_in_both_orders(report):
    rows = [(row["scene"], row["order"]) for row in report["jobs"]]
    scenes = ["default survey", "village"]
    assert rows == [(scene, order) for scene in scenes for order in ("coherent", "shuffled")]


def test_every_engine_finds_the_same(report):
    for row in report["jobs"]:
        shares = {
            name: entry["hit_share"]
            for name, entry in row["engines"].items()
            if name != "brute force, NumPy"  # casts a few of the rays only
        }
        assert {"numpy", "embree", "embree, cast alone", "Open3D, bare"} <= set(shares)
        assert 0.01 < shares["numpy"] < 1
        np.testing.assert_allclose(list(shares.values()), shares["numpy"], atol=2e-3)


def test_rates_of_every_round(report):
    for row in report["jobs"]:
        for entry in row["engines"].values():
            assert len(entry["mrays_s"]) == 2
            assert min(entry["mrays_s"]) > 0
    assert report["environment"]["versions"]["numpy"] == np.__version__


def test_brute_force_is_right():
    job = survey_job(2_000)
    engine = BruteForce(1)
    rays = engine.rays(job)
    step = len(job.directions) // rays
    turned = job.directions[::step][:rays] @ job.rotation.T
    hits = RayCaster(job.vertices, job.faces, "numpy").cast(job.origins[0], turned)
    assert engine.prepare(job)() == hits.hit.sum() > 0


@pytest.mark.parametrize("engine", [Embree, EmbreeAlone, Numpy, Open3D])
def test_shuffled_rays_are_the_same_rays(engine):
    if reason := engine(1).missing():
        pytest.skip(reason)
    job = jobs(2_000, [], quick=True)["city-2e3"]()
    found = engine(1).prepare(job)()
    assert 0 < found < job.rays
    assert engine(1).prepare(job.shuffled())() == found
