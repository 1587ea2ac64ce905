"""Benchmarks at toy size: the times mean nothing, that they run and agree does."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from benchmarks import augmentation, live, odometry, raycast, realism, scanner, trees
from benchmarks.harness import read_results

from lidarscenes.procedural.city import city
from lidarscenes.writers.scene_file import write_scene


@pytest.mark.slow
def test_every_engine_finds_the_same(tmp_path):
    mesh = write_scene(tmp_path / "village.glb", city(1_000))
    out = tmp_path / "out.json"
    scenes = ["--scene", "survey", "--scene", "village"]
    assert raycast.main(["--quick", *scenes, "--mesh", str(mesh), "--json", str(out)]) == 0
    jobs = read_results(out)
    rows = [(row["scene"], row["order"]) for row in jobs]
    scenes = ["default survey", "village"]
    assert rows == [(scene, order) for scene in scenes for order in ("coherent", "shuffled")]
    for row in jobs:
        shares = {name: entry["hit_share"] for name, entry in row["engines"].items()}
        assert {"numpy", "tiles", "Open3D, bare"} <= set(shares)
        assert 0.01 < shares["numpy"] < 1
        np.testing.assert_allclose(list(shares.values()), shares["numpy"], atol=2e-3)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++ to compile the kernels")
def test_trees_are_about_as_good_as_the_best_there_are(tmp_path):
    out = tmp_path / "out.json"
    scenes = [f"--scene={name}" for name in ("survey", "city-2e3", "terrain-2e3")]
    assert trees.main(["--quick", *scenes, "--json", str(out)]) == 0
    rows = read_results(out)
    assert [row["scene"] for row in rows] == ["default survey", "city 2e3", "terrain 2e3"]
    for row in rows:
        assert 1 < row["ours"]["nodes"] < 1.06 * row["sweep"]["nodes"]
        assert row["ours"]["triangles"] < 1.1 * row["sweep"]["triangles"]
        assert row["ours"]["nodes"] < 0.9 * row["clustered"]["nodes"]
        assert 0 < row["ours"]["hit_share"] < 1
        assert len({row[name]["hit_share"] for name in trees.TREES}) == 1


@pytest.mark.slow
def test_a_scanner_finds_what_a_cast_and_open3d_find(tmp_path, capsys):
    out = tmp_path / "out.json"
    assert scanner.main(["--quick", "--backend", "tiles", "--json", str(out)]) == 0
    rows = read_results(out)
    assert [row["case"] for row in rows] == [*scanner.CASES]
    for row in rows:
        clouds = {"sweep", "moving"} if row["poses"] == 1 else set()
        assert row["hits"].keys() == {"cast", "ranges", "noise", "open3d"} | clouds
        assert all(len(rounds) == 2 for rounds in row["seconds"].values())
        assert 0.05 < row["hits"]["cast"] < 1
        assert row["hits"]["ranges"] == pytest.approx(row["hits"]["cast"], abs=1e-9)
        assert row["hits"]["open3d"] == pytest.approx(row["hits"]["cast"], abs=2e-3)
    said = capsys.readouterr().out
    assert "mujoco-lidar is skipped" in said and said.count("1.00 x cast") >= 3


@pytest.mark.slow
def test_what_is_real_is_measured_beside_what_is_bare(capsys):
    toy = ["--triangles", "2000", "--cars", "2", "3", "--sensor", "velodyne/vlp16"]
    rows = realism.main([*toy, "--repeat", "1"])
    assert "x bare" in capsys.readouterr().out
    assert rows["bare"]["times"] == 1 and all(row["points"] > 500 for row in rows.values())
    assert {"3 boxes, moving", "19 sub-rays", "rain", "fog", "snow", "all"} <= rows.keys()


@pytest.mark.slow
def test_augmented_drives_agree_with_simulated_drives(capsys):
    results = augmentation.main(["--quick", "--repeat", "1"])
    assert "two seeds" in capsys.readouterr().out
    drives = results["equivalence"]
    for name in ("OS1-64", "VLP-16", "HDL-64E", "MCAP", "PCD", "compensated"):
        for comparison in drives[name].values():
            assert abs(comparison["surfaces_z"]) < 5 and abs(comparison["air_z"]) < 5
    for counts in results["insertion"].values():
        assert counts["same"] > 0.95 * counts["simulated"] and counts["behind"] == 0
    assert results["speed"]["OS1-64"]["fog"]["ms"] > 0


@pytest.mark.slow
def test_odometry_deskews_a_bag_as_one_of_a_driver():
    """KISS-ICP moves points to their true positions, from which points as fired are far."""
    pytest.importorskip("kiss_icp", reason="KISS-ICP is not installed")
    distances = odometry.measured("velodyne/vlp16", 14, 20_000)
    assert distances[True].median < distances[False].median / 3
    assert distances[False].median > 0.2


@pytest.mark.slow
def test_odometry_without_kiss_icp_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(odometry, "find_spec", lambda name: None)
    assert odometry.main(["--quick"]) == 1
    assert "pip install kiss-icp" in capsys.readouterr().err


@pytest.mark.slow
def test_live_packets_arrive(tmp_path):
    figures = live.main(["--minutes", "0.005", "--rate", "0.2", "--triangles", "2000"])
    assert [row["lost"] for row in figures.values()] == [0, 0]
    assert [row["sent"]["sent"] for row in figures.values()] == [3 * 64, 226 + 16]
    for row in figures.values():
        assert sum(row["sent"]["lateness"].values()) == row["received"]
