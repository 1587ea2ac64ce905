"""The command on a cluster that somebody else started: same bytes, right places."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarpool import Cloud, read_cloud

EXAMPLE = Path(__file__).parents[2] / "examples" / "seed.yaml"


@pytest.fixture(scope="module")
def seed(tmp_path_factory) -> Path:
    """The default survey with less planning."""
    text = EXAMPLE.read_text()
    fewer = text.replace("trials: 100 ", "trials: 40 ").replace("keep_every: 5 ", "keep_every: 1 ")
    assert fewer != text
    path = tmp_path_factory.mktemp("seed") / "seed.yaml"
    path.write_text(fewer)
    return path


@pytest.fixture
def run(
    lidarpool, tmp_path, seed, no_pictures, all_records
) -> Callable[..., tuple[bytes, dict[str, Any]]]:
    """Run the survey; the cloud's bytes and the report."""

    def run(name: str, *options: str) -> tuple[bytes, dict[str, Any]]:
        outcome = lidarpool("run", seed, "--out", tmp_path / name, "--quiet", *options)
        assert (outcome.code, outcome.err) == (0, "")
        report = json.loads((tmp_path / name / "report.json").read_text())
        return (tmp_path / name / "cloud.ply").read_bytes(), report

    return run


def check_places(report: dict[str, Any], gpu_workers: int) -> None:
    assert report["placement_violations"] == 0
    assert report["tasks"]["GPU"].keys() == {"intersect"}
    assert report["tasks"]["LIDAR"] == {"generate": 1, "sort": 1, "collect": 2}
    assert report["tasks"]["OTHER"] == {"trial": 40}
    assert 1 <= len(report["stages"]["intersect"]["workers"]) <= gpu_workers


def test_an_outside_cluster_gives_the_same_bytes(run, lidarpool, outside):
    local, report = run("local")
    check_places(report, gpu_workers=report["stages"]["intersect"]["tasks"])

    cluster = outside()
    cluster.add("GPU")
    cluster.add("LIDAR", count=4)
    cluster.add("OTHER")
    cluster.wait()
    cloud, report = run("six", "--scheduler", cluster.address)
    assert cloud == local
    check_places(report, gpu_workers=1)
    lidar = {w for s in ("generate", "sort", "collect") for w in report["stages"][s]["workers"]}
    assert len(lidar) == 4  # a long task each, since each has one slot

    cluster.add("GPU")
    cluster.add("OTHER")
    cluster.wait()
    cloud, report = run("eight", "--scheduler", cluster.address)
    assert cloud == local
    check_places(report, gpu_workers=2)
    assert len(report["stages"]["trial"]["workers"]) == 2

    told = lidarpool("info", "--scheduler", cluster.address)
    assert told.code == 0
    assert told.out.count("GPU=1") == told.out.count("OTHER=1") == 2
    assert told.out.count("LIDAR=1") == 4
    assert "8 workers" in told.out and cluster.processes.keys() - {"scheduler"} <= set(
        told.out.split()
    )
    assert cluster.complaints() == []


def test_backends_agree_on_one_worker_with_four_slots(run, outside, tmp_path):
    cluster = outside()
    cluster.add("GPU")
    cluster.add("LIDAR", slots=4)
    cluster.add("OTHER")
    cluster.wait()
    for backend in ("embree", "numpy"):
        _, report = run(backend, "--scheduler", cluster.address, "--backend", backend)
        check_places(report, gpu_workers=1)
        assert report["backend"] == backend
    check_agreement(*(read_cloud(tmp_path / b / "cloud.ply") for b in ("embree", "numpy")))


def check_agreement(one: Cloud, other: Cloud) -> None:
    """At least 99.5% of the points are the same; others a rounding step or a silhouette apart."""
    assert len(one) > 4000
    assert abs(len(one) - len(other)) <= 1e-3 * len(one)
    rows = [
        Counter(zip(c.scan, c.ring, c.object, map(bytes, c.positions), strict=True))
        for c in (one, other)
    ]
    same = (rows[0] & rows[1]).total()
    assert same >= 0.995 * max(len(one), len(other))
    # What differs lies within a step of a point that the other has, or is one of the few rays
    # that pass an edge: at most a thousandth.
    far = 0
    for mine, other_positions in ((rows[0] - rows[1], other), (rows[1] - rows[0], one)):
        for scan, _, _, position in mine:
            near = other_positions.positions[other_positions.scan == scan]
            here = np.frombuffer(position, other_positions.positions.dtype)
            far += not (np.abs(near - here).max(axis=1, initial=0) <= 0.0101).any()
    assert far <= 2e-3 * len(one)
