"""Runs whose cloud has no points: a warning with a reason, in every way of running."""

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from distributed import Client
from tests.clusters import thread_cluster
from tests.shapes import room

from lidarpool import Campaign, Job, Sensor, Survey, merge, simulate

SURVEY: dict[str, Any] = {
    "scene": "seed",
    "sensor": {"rays_per_revolution": 90, "layers": 4, "vertical_fov_deg": 20, "step_deg": 30},
    "poses": [[0, 0, 1000]],
    "steps": 12,
    "pool": {"backend": "numpy", "gpu": 1},
}
NOTHING = "no ray hits a surface at any distance. Check poses and units. The sensor starts at ("
EMPTY = f"the cloud has no points: {NOTHING}"
SMALL = Sensor.grid(90, layers=2, step_deg=10)


@pytest.fixture(scope="module")
def slots() -> Iterator[str]:
    """Address of a cluster with the slots of a campaign."""
    with thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def client(slots) -> Iterator[Client]:
    with Client(slots, set_as_default=False) as client:
        yield client


@pytest.fixture
def run(tmp_path, lidarpool, slots) -> Callable[..., Any]:
    """Run a scenario into the folder `out`."""

    def run(*options: object, out: str = "out", **changed: Any) -> Any:
        (tmp_path / "s.yaml").write_text(json.dumps(SURVEY | changed))
        given = ("--out", tmp_path / out, "--scheduler", slots, "--cloud-only")
        return lidarpool("run", tmp_path / "s.yaml", *given, *options)

    return run


def warnings(outcome: Any) -> list[str]:
    lines = outcome.err.splitlines()
    return [line.removeprefix("warning: ") for line in lines if line.startswith("warning: ")]


@pytest.mark.slow
def test_a_warning_is_on_stderr_and_strict_exits_with_1(run):
    outcome = run("--quiet")
    assert outcome.code == 0
    [warning] = warnings(outcome)
    assert warning.startswith(EMPTY) and "no points: " not in outcome.out
    outcome = run("--quiet", "--strict", "--overwrite")
    assert outcome.code == 1 and [warning] == warnings(outcome)
    outcome = run("--quiet", "--strict", "--overwrite", poses=[[0, 0, 1]])
    assert (outcome.code, outcome.err) == (0, "")


@pytest.mark.extended
def test_json_has_the_warning_as_a_note(run):
    outcome = run("--json")
    [warning] = warnings(outcome)
    assert outcome.code == 0 and warning.startswith(EMPTY)
    assert warning in json.loads(outcome.out)["notes"]


@pytest.mark.extended(every=6)
@pytest.mark.slow(every=3)
@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        (
            {"sensor": SURVEY["sensor"] | {"min_range_m": 500}, "poses": [[0, 0, 1]]},
            "all surfaces are closer than `min_range_m` (500 m), at ranges",
        ),
        (
            {"sensor": SURVEY["sensor"] | {"max_range_m": 1}, "poses": [[0, 0, 1]]},
            "all surfaces are farther than `max_range_m` (1 m), at ranges",
        ),
        (
            {"noise": {"dropout": 1.0}, "poses": [[0, 0, 1]]},
            "m, but no return is reported. Check noise.dropout",
        ),
        (
            {"poses": [[0, 0, 1]], "noise": {"detection_range_m": 0.01}},
            "m, but no return is reported. Check noise.detection_range_m",
        ),
    ],
    ids=["minimum range", "maximum range", "dropout", "detection"],
)
def test_the_reason_is_the_most_likely_one(run, changed, reason):
    [warning] = warnings(run("--quiet", **changed))
    assert warning.startswith("the cloud has no points: ") and reason in warning


@pytest.mark.extended
def test_check_gives_the_same_reason(tmp_path, lidarpool):
    sensor = SURVEY["sensor"] | {"min_range_m": 500}
    (tmp_path / "s.yaml").write_text(json.dumps(SURVEY | {"sensor": sensor, "poses": [[0, 0, 1]]}))
    outcome = lidarpool("check", tmp_path / "s.yaml")
    assert outcome.code == 0
    assert "warning: the cloud has no points: all surfaces are closer than" in outcome.out
    assert lidarpool("check", tmp_path / "s.yaml", "--strict").code == 1


@pytest.mark.extended
def test_shards_of_a_survey_and_what_is_merged_of_them(run, lidarpool, tmp_path):
    for number in (1, 2):
        outcome = run("--quiet", "--shard", f"{number}/2", "--strict", out=f"part-{number}")
        assert outcome.code == 1
        [warning] = warnings(outcome)
        assert warning.startswith(f"shard {number}/2 has no points: {NOTHING}")
    parts = [tmp_path / f"part-{number}" for number in (1, 2)]
    outcome = lidarpool("merge", *parts, "--out", tmp_path / "whole", "--json", "--strict")
    assert outcome.code == 1
    [warning] = warnings(outcome)
    assert warning.startswith(EMPTY)
    assert json.loads(outcome.out)["notes"] == [warning]


CAMPAIGN = {
    "base": "base.yaml",
    "count": 4,
    "vary": {"poses": {"each": [[[0, 0, 1]], [[0, 0, 1000]]]}},
    "keep": "folder",
}


@pytest.fixture
def campaign(tmp_path) -> Path:
    """A campaign whose odd jobs have no points."""
    (tmp_path / "base.yaml").write_text(json.dumps(SURVEY | {"poses": [[0, 0, 1]]}))
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(CAMPAIGN))
    return tmp_path / "c.yaml"


@pytest.mark.slow
def test_a_campaign_names_its_jobs_without_points(campaign, lidarpool, slots, tmp_path):
    given = ("--out", tmp_path / "set", "--scheduler", slots, "--quiet", "--strict", "--json")
    outcome = lidarpool("run", campaign, *given)
    assert outcome.code == 1, outcome.err
    [warning] = warnings(outcome)
    assert warning.startswith(f"2 jobs have no points: 0001, 0003. Job 0001: {NOTHING}")
    assert warning in json.loads(outcome.out)["notes"]
    outcome = lidarpool("run", campaign, *given, "--resume")  # nothing is left to do
    assert outcome.code == 1 and [warning] == warnings(outcome)


@pytest.mark.slow
def test_shards_of_a_campaign_and_what_is_merged_of_them(campaign, lidarpool, slots, tmp_path):
    for number, jobs in ((1, ""), (2, "2 jobs have no points: 0001, 0003. Job 0001: no ray hits")):
        out = tmp_path / f"part-{number}"
        given = ("--shard", f"{number}/2", "--out", out, "--scheduler", slots, "--quiet")
        outcome = lidarpool("run", campaign, *given, "--strict")
        assert outcome.code == bool(jobs), outcome.err
        assert jobs in outcome.err and len(warnings(outcome)) == bool(jobs)
    parts = [tmp_path / f"part-{number}" for number in (1, 2)]
    outcome = lidarpool("merge", *parts, "--out", tmp_path / "set", "--strict")
    assert outcome.code == 1
    [warning] = warnings(outcome)
    assert warning.startswith(
        "2 jobs have no points: 0001, 0003. To see the most likely reason, run"
    )
    report = json.loads((tmp_path / "set" / "report.json").read_text())
    assert report["notes"] == [warning]
    merged = f"4 jobs, {report['totals']['points']:,} points in {tmp_path / 'set'}"
    assert outcome.out.splitlines()[-1] == merged


@pytest.mark.slow
def test_python_logs_a_warning(client, caplog, tmp_path):
    far = Survey(SMALL, poses=[(0, 0, 1000)], steps=2)
    result = simulate(room(), far, client=client)
    [record] = [one for one in caplog.records if one.levelno == logging.WARNING]
    assert record.message.startswith(EMPTY) and result.notes == (record.message,)
    caplog.clear()
    campaign = Campaign(lambda number, rng: Job(room(), far), count=2)
    run = campaign.run(tmp_path / "set", client=client)
    [record] = [one for one in caplog.records if one.levelno == logging.WARNING]
    assert record.message.startswith(
        "2 jobs have no points: 0000, 0001. Job 0000: no ray hits a surface"
    )
    assert run.notes == (record.message,)
    caplog.clear()
    for number in (1, 2):
        campaign.run(tmp_path / f"part-{number}", client=client, shard=(number, 2))
    caplog.clear()
    merge([tmp_path / "part-1", tmp_path / "part-2"], tmp_path / "merged")
    [record] = [one for one in caplog.records if one.levelno == logging.WARNING]
    names, _, advice = record.message.partition(". ")
    assert names == "2 jobs have no points: 0000, 0001"
    assert advice == "To see the most likely reason, run `lidarpool check CAMPAIGN --job N`"
