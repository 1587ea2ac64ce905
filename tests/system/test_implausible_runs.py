"""Warnings of surveys that are likely mistakes, in every way of running."""

import json
from collections.abc import Iterator

import pytest
from tests.clusters import thread_cluster

BASE = {
    "scene": "seed",
    "sensor": {"rays_per_revolution": 90, "layers": 2, "vertical_fov_deg": 20, "step_deg": 30},
    "poses": [[0, 0, 1]],
    "steps": 12,
    "noise": {"range_m": 20.0},
    "pool": {"backend": "numpy", "gpu": 1},
}
CAMPAIGN = {"base": "base.yaml", "count": 3, "vary": {"steps": {"each": [12, 24, 36]}}}


@pytest.fixture(scope="module")
def slots() -> Iterator[str]:
    """Address of a cluster with the slots of a campaign."""
    with thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster:
        yield cluster.scheduler_address


@pytest.mark.slow(every=5)
@pytest.mark.parametrize(
    ("file", "options", "begins"),
    [
        ("base.yaml", [], "warning: `noise.range_m`"),
        ("base.yaml", ["--shard", "2/2"], "warning: `noise.range_m`"),
        ("c.yaml", ["--job", "1"], "warning: `noise.range_m`"),
        ("c.yaml", [], "warning: job 0000: `noise.range_m`"),
        ("c.yaml", ["--shard", "2/2"], "warning: job 0001: `noise.range_m`"),
    ],
    ids=["survey", "shard of a survey", "job", "campaign", "shard of a campaign"],
)
def test_a_run_warns_once_and_strict_exits_with_1(
    tmp_path, lidarpool, slots, file, options, begins
):
    (tmp_path / "base.yaml").write_text(json.dumps(BASE))
    (tmp_path / "c.yaml").write_text(json.dumps(CAMPAIGN))
    given = ("--out", tmp_path / "out", "--scheduler", slots, "--quiet", "--strict", *options)
    outcome = lidarpool("run", tmp_path / file, *given)
    warnings = [line for line in outcome.err.splitlines() if line.startswith("warning: ")]
    assert outcome.code == 1 and len(warnings) == 1 and warnings[0].startswith(begins), outcome.err
