"""Workers that are stopped, replaced, and wake up beside those that have replaced them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest
from distributed import Client, Nanny, Scheduler

import poolpart.whereabouts
from lidarpool import Scene, Sensor, Survey, simulate
from poolpart import trace_to
from poolpart.local import _NannyCluster

SURVEY = Survey(
    Sensor(rays_per_revolution=360, layers=4, step_deg=1), poses=[(0, 0, 1)] * 4, steps=360
)


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """Two casting workers, and one LIDAR worker more than a survey needs, of one slot each."""
    resources = {f"GPU-{i}": {"GPU": 1} for i in range(2)}
    resources |= {f"LIDAR-{i}": {"LIDAR": 1} for i in range(5)}
    options = {"nthreads": 1, "host": "127.0.0.1", "dashboard": False, "silence_logs": 50}
    workers = {
        name: {"cls": Nanny, "options": {**options, "resources": declared}}
        for name, declared in resources.items()
    }
    scheduler = {
        "cls": Scheduler,
        "options": {"host": "127.0.0.1", "port": 0, "dashboard_address": "127.0.0.1:0"},
    }
    with (
        _NannyCluster(workers=workers, scheduler=scheduler, silence_logs=50) as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def undisturbed(client):
    return simulate(Scene.seed(), SURVEY, client=client).cloud


def pid_of_worker(client: Client, stage: str) -> int:
    """Process that runs a stage, or the first that has run a task of it."""

    def look(dask_scheduler):
        tasks = [t for key, t in dask_scheduler.tasks.items() if str(key).startswith(stage)]
        places = [w.address for t in tasks for w in ([t.processing_on] if t.processing_on else [])]
        return [*places, *(w.address for t in tasks for w in t.who_has or ())]

    address = client.run_on_scheduler(look)[0]
    return client.run(os.getpid, workers=[address])[address]


@pytest.mark.parametrize("stage", ["generate", "sort", "collect-0", "prepare"])
def test_one_that_wakes_up_beside_its_successor_does_no_harm(
    client, undisturbed, same_cloud, monkeypatch, small_batches, stage, left_over
):
    """The scheduler would take it for dead after five minutes, and wait that long."""
    pids, seen, events = [], [], set()

    def on_frame(frame) -> None:
        seen.append(frame.scan)
        if frame.scan == 300:
            pids.append(pid_of_worker(client, stage))
            os.kill(pids[0], signal.SIGSTOP)
            # Only now: on a busy machine others that are well may be silent for so long.
            patience.setattr(poolpart.whereabouts, "SILENT_S", 2.0)
        elif frame.scan == 1000:
            patience.undo()
            os.kill(pids[0], signal.SIGCONT)

    trace_to(lambda point, fields: events.add((point, fields["stage"])))
    try:
        with monkeypatch.context() as patience:
            result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    finally:
        trace_to(None)
        os.kill(pids[0], signal.SIGCONT)
    assert seen == list(range(SURVEY.scan_count))
    assert same_cloud(result.cloud, undisturbed)
    if stage == "sort":
        assert ("driver.replay", "sort") in events
    assert left_over(client) == ([], [], [])
