"""benchmarks/sensors.py at toy size: the times mean nothing, that it runs and agrees does."""

from __future__ import annotations

import json

import numpy as np
import pytest
from benchmarks import sensors

from lidarpool.scene.city import city


def test_every_case_of_a_sensor(tmp_path, capsys):
    out = tmp_path / "out.json"
    arguments = ["--quick", "--model", "velodyne/vlp16", "--backend", "numpy", "--json", str(out)]
    assert sensors.main(arguments) == 0
    [row] = json.loads(out.read_text())["models"]
    assert tuple(row["seconds"]) == sensors.CASES
    assert all(len(rounds) == 2 for rounds in row["seconds"].values())
    assert all(0.1 < share < 1 for share in row["hits"].values())
    assert row["hits"]["ten actors"] != row["hits"]["moving"], "the actors are seen"
    said = capsys.readouterr().out
    assert "mujoco and pyhelios3d: not installed" in said and "the bar of 1.15 x" in said


def test_a_peer_gets_the_same_rays(tmp_path):
    survey = sensors.surveys("ouster/os1-128", 0.02)["moving"]
    sensors.write_job(survey, city(2_000), tmp_path / "job.npz")
    job = np.load(tmp_path / "job.npz")
    assert len(job["directions"]) == survey.ray_count == 128 * len(job["origins"])
    assert np.ptp(job["origins"], axis=0)[0] == pytest.approx(20 * 0.0019, rel=0.05)
    assert job["turned"] == pytest.approx(len(job["origins"]) / 1024)
