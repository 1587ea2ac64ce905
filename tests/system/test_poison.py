"""Scans that kill whatever worker takes them."""

import os
import signal
import time
from typing import Any

import pytest
from distributed import Client

import lidarpool.run.pipeline.long_stages
import lidarpool.run.planning_trials
from lidarpool import LidarError, Planning, ScanFrame, Scene, Sensor, Survey, simulate
from lidarpool.run.pipeline.failures import memory_clause

SURVEY = Survey(Sensor.grid(rays_per_revolution=360, layers=8, step_deg=2), [(0, 0, 1)], steps=180)
POISON = 57

pytestmark = pytest.mark.usefixtures("small_batches")


@pytest.fixture(scope="module")
def undisturbed(cluster_client):
    return simulate(Scene.seed(), SURVEY, client=cluster_client).cloud


@pytest.mark.slow
def test_a_scan_that_kills_its_worker_is_named_and_all_others_are_kept(
    client, sabotage, undisturbed, same_cloud, tmp_path, left_over
):
    armed = sabotage("intersect.cast", POISON)
    frames: list[int] = []

    def on_frame(frame: ScanFrame) -> None:
        frames.append(frame.scan)

    def run(**options: Any):
        return simulate(
            Scene.seed(), SURVEY, client=client, on_frame=on_frame, folder=tmp_path / "run",
            **options,
        )  # fmt: skip

    message = (
        rf"^3 workers in a row died in stage intersect while they processed only scan {POISON}"
    )
    with pytest.raises(LidarError, match=message) as caught:
        run()
    assert frames == list(range(len(frames)))
    assert len(frames) <= POISON
    (kept,) = caught.value.__notes__
    assert int(kept.split()[0]) > POISON
    assert left_over(client) == ([], [], [])
    armed.unlink()
    result = run(resume=True)
    assert str(result.resumed) == kept.split()[0]
    assert frames == list(range(SURVEY.scan_count))
    assert same_cloud(result.cloud, undisturbed)


@pytest.mark.slow
def test_summaries_that_kill_the_sorter_end_the_run(client, sabotage, monkeypatch, left_over):
    monkeypatch.setattr(lidarpool.run.pipeline.long_stages, "MAX_DEATHS", 2)
    sabotage("sort.get", POISON)
    with pytest.raises(LidarError, match=r"^Stage \w+ was started 3 times, and each time"):
        simulate(Scene.seed(), SURVEY, client=client)
    assert left_over(client) == ([], [], [])


def test_a_worker_that_was_ended_for_its_memory_is_known(cluster_client: Client):
    cluster_client.log_event("worker-restart-memory", {"worker": "tcp://127.0.0.1:1", "rss": 1})
    assert memory_clause(cluster_client, ["tcp://127.0.0.1:2"]) == ""
    until = time.monotonic() + 120
    while not (words := memory_clause(cluster_client, ["tcp://127.0.0.1:1"])):
        assert time.monotonic() < until
    assert "memory" in words


@pytest.mark.slow
def test_a_trial_whose_workers_were_killed_is_tried_again(client, monkeypatch, tmp_path, left_over):
    """Dask gives a task up at the fourth death, whoever is to blame for it."""
    lives = tmp_path / "lives"
    lives.write_bytes(bytes(4))
    original = lidarpool.run.planning_trials.run_trial

    def run_trial(planning, number):
        left = lives.stat().st_size
        if number == 2 and left:
            os.truncate(lives, left - 1)
            os.kill(os.getpid(), signal.SIGKILL)
        return original(planning, number)

    monkeypatch.setattr(lidarpool.run.planning_trials, "run_trial", run_trial)
    planning = Planning((25, 25), (-30, -20), trials=5, particles=50, iterations=20)
    result = simulate(Scene.seed(), Survey(poses=[(0, 0, 1)]), planning, client=client)
    assert sorted(trial.trial for trial in result.trials) == list(range(5))
    assert lives.stat().st_size == 0
    assert left_over(client) == ([], [], [])
