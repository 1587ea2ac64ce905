"""`lidarpool check` of a campaign: what varies, and some of its jobs."""

import json
import re
import shutil
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"

CAMPAIGN = """
base: base.yaml
count: 9
vary:
  sensor.layers: {integer: [4, 8]}
  weather.visibility_km: {choice: [null, 0.5]}
keep: {format: mcap, layout: ouster}
splits: {train: 0.5, test: 0.5}
"""


@pytest.fixture
def campaign(tmp_path):
    """Write a campaign on the objects of the demo, and return its file."""
    (tmp_path / "base.yaml").write_text("scene: seed\nsteps: 4\npool: {backend: numpy}\n")
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    return tmp_path / "campaign.yaml"


def test_it_shows_what_varies_and_five_jobs(campaign, lidarpool):
    outcome = lidarpool("check", campaign, "--out", campaign.parent / "out")
    assert outcome.code == 0
    lines = outcome.out.splitlines()
    assert lines[:5] == [
        "campaign    9 jobs, seed 0, stored as mcap, ouster",
        "varied      sensor.layers: 4 to 8, integer",
        "varied      weather.visibility_km: chosen from none, 0.5",
        "splits      train 0.5, test 0.5",
        "checked     5 of 9 jobs",
    ]
    jobs = [re.match(r"job +(\d+) \((train|test)\): sensor.layers (\d)", line) for line in lines]
    jobs = [(number, int(layers)) for number, _, layers in (m.groups() for m in jobs if m)]
    assert [number for number, _ in jobs] == ["0000", "0002", "0004", "0006", "0008"]
    rays = [
        int(m[1].replace(",", "")) for m in (re.search(r"([\d,]+) rays", i) for i in lines) if m
    ]
    # Four steps of 28 azimuths, from three poses.
    assert rays[:5] == [layers * rays[0] // jobs[0][1] for _, layers in jobs]
    assert rays[5] == round(sum(rays[:5]) * 9 / 5)
    assert lines[-1].startswith(f"The campaign can be run: lidarpool run {campaign}")
    assert not (campaign.parent / "out").exists()


@pytest.mark.extended
def test_a_result_in_the_output_folder_is_not_compared_with_each_job(campaign, lidarpool):
    out = campaign.parent / "out"
    (out / "jobs").mkdir(parents=True)
    (out / "report.json").write_text("{}")
    outcome = lidarpool("check", campaign, "--out", out)
    assert outcome.code == 0 and "different survey" not in outcome.out
    assert f"--out {out}-2" in outcome.out


def test_one_job_is_shown_like_a_scenario(campaign, lidarpool):
    outcome = lidarpool("check", campaign, "--job", 3)
    assert outcome.code == 0
    words = [line.split(maxsplit=1)[0] for line in outcome.out.splitlines()]
    assert words[:4] == ["job", "scene", "size", "survey"] and "planning    none" in outcome.out
    assert re.match(r"job +0003 \((train|test)\): sensor.layers \d", outcome.out)
    assert outcome.out.rstrip().endswith("campaign.yaml --job 3")
    assert "The job can be run: " in outcome.out


@pytest.mark.parametrize(("options", "word"), [((), "--live"), (("--live",), "survey")])
def test_a_campaign_has_no_pace(campaign, lidarpool, options, word):
    refused = lidarpool("run", campaign, *options, "--pace", 1, "--out", campaign.parent / "ds")
    assert refused.code == 2 and "--pace" in refused.err and word in refused.err
    assert not (campaign.parent / "ds").exists()


@pytest.mark.extended
def test_as_json(campaign, lidarpool):
    found = json.loads(lidarpool("check", campaign, "--json").out)
    assert found["can_run"] and (found["count"], found["checked"]) == (9, 5)
    keep = {"format": "mcap", "layout": "ouster", "compensated": False}
    keep |= {"compensated_actors": False, "pose_rate_hz": None}
    assert found["keep"] == keep
    assert [job["number"] for job in found["jobs"]] == [0, 2, 4, 6, 8]
    one = json.loads(lidarpool("check", campaign, "--json", "--job", 4).out)
    assert one["job"] == found["jobs"][2]
    (campaign).write_text("base: none.yaml\n")
    failed = lidarpool("check", campaign, "--json")
    assert failed.code == 2 and json.loads(failed.out)["can_run"] is False


def test_jobs_that_cannot_run_are_reasons(campaign, lidarpool):
    (campaign.parent / "hall.stl").write_bytes(b"none")
    campaign.write_text("base: base.yaml\nvary: {scene: {each: [seed, hall.stl]}}\n")
    outcome = lidarpool("check", campaign)
    assert outcome.code == 2
    assert "checked     2 of 2 jobs" in outcome.out and "0000: scene seed" in outcome.out
    assert "1 of 2 checked jobs cannot be run; the others can.\njob 0001: " in outcome.err
    assert "hall.stl" in outcome.err
    assert json.loads(lidarpool("check", campaign, "--json").out)["failed"] == ["0001"]
    campaign.write_text("base: base.yaml\nvary: {scene: {each: [hall.stl, hall.stl]}}\n")
    outcome = lidarpool("check", campaign)
    assert outcome.code == 2 and "None of the 2 checked jobs can be run.\n" in outcome.err


@pytest.mark.parametrize(
    ("name", "job", "says"),
    [
        ("campaign.yaml", 9, "Job 9 does not exist. The jobs of the campaign are 0 to 8"),
        (
            "base.yaml",
            1,
            "base.yaml is not a campaign. `--job 1` can only be used with a campaign.",
        ),
        ("campaign.yaml", -1, "-1 is not in the range"),
    ],
)
def test_a_job_that_is_not_there(campaign, lidarpool, name, job, says):
    outcome = lidarpool("check", campaign.parent / name, "--job", job)
    assert (outcome.code, outcome.out) == (2, "")
    assert says in outcome.err


@pytest.mark.slow
def test_the_example_can_run(lidarpool, tmp_path):
    for file in EXAMPLES.iterdir():
        if file.is_file() and file.suffix in (".yaml", ".csv", ".glb", ".obj"):
            shutil.copy(file, tmp_path)
    outcome = lidarpool("check", tmp_path / "campaign.yaml")
    assert (outcome.code, outcome.out.count("\njob ")) == (0, 5)
    notes = [line for line in outcome.out.splitlines() if line.startswith("note:")]
    assert all("have no angles" in note for note in notes), notes
