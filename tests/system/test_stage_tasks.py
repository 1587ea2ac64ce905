"""LIDAR as four workers of one slot each, where a stage can be given to a slot that is taken."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress

import numpy as np
import pytest
from distributed import Client, Nanny, Scheduler

import lidarpool.watch
from lidarpool import LidarpoolError, Planning, Scene, Sensor, Survey, simulate
from lidarpool.scan import SurveyPump
from lidarpool.trials import TrialPump
from poolpart import worker_identities
from poolpart.local import _NannyCluster

SURVEY = Survey(
    Sensor(rays_per_revolution=360, layers=4, step_deg=1), poses=[(0, 0, 1)] * 4, steps=360
)


def cluster_of_slots(foreign: int = 0):
    resources = {"GPU-0": {"GPU": 1}, "OTHER-0": {"OTHER": 1}}
    resources |= {f"LIDAR-{i}": {"LIDAR": 1} for i in range(4)}
    resources |= {f"foreign-{i}": {} for i in range(foreign)}
    options = {"nthreads": 1, "host": "127.0.0.1", "dashboard": False, "silence_logs": 50}
    workers = {
        name: {"cls": Nanny, "options": {**options, "resources": declared}}
        for name, declared in resources.items()
    }
    scheduler = {
        "cls": Scheduler,
        "options": {"host": "127.0.0.1", "port": 0, "dashboard_address": "127.0.0.1:0"},
    }
    return _NannyCluster(workers=workers, scheduler=scheduler, silence_logs=50)


@pytest.fixture(scope="module")
def cluster():
    with cluster_of_slots() as cluster:
        yield cluster


@pytest.fixture(scope="module")
def connected(cluster):
    with Client(cluster) as client:
        yield client


@pytest.fixture
def client(cluster, connected):
    """Client of the cluster once all workers are there that an earlier test has killed."""
    connected.wait_for_workers(len(cluster.worker_spec), timeout=120)
    return connected


@pytest.fixture(scope="module")
def undisturbed(connected):
    return simulate(Scene.seed(), SURVEY, client=connected).cloud


def worker_of(client: Client, stage: str) -> str:
    """Address of the worker that runs a stage."""

    def look(dask_scheduler):
        return [
            task.processing_on.address
            for key, task in dask_scheduler.tasks.items()
            if str(key).startswith(stage) and task.processing_on
        ]

    return client.run_on_scheduler(look)[0]


def kill_worker_of(client: Client, stage: str) -> None:
    address = worker_of(client, stage)
    os.kill(client.run(os.getpid, workers=[address])[address], signal.SIGKILL)


def test_each_stage_has_a_slot_of_its_own(client, undisturbed):
    for _ in range(3):
        result = simulate(Scene.seed(), SURVEY, client=client)
        stages = [r for r in result.records if r.partition == "LIDAR"]
        assert len({record.worker for record in stages}) == len(stages) == 4
        assert np.array_equal(result.cloud.positions, undisturbed.positions)


@pytest.mark.parametrize("stage", ["generate", "sort", "collect-0"])
def test_a_stage_whose_worker_dies_is_started_elsewhere(client, undisturbed, stage, left_over):
    def on_frame(frame) -> None:
        if frame.scan == 300:
            kill_worker_of(client, stage)

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert np.array_equal(result.cloud.positions, undisturbed.positions)
    assert np.array_equal(result.cloud.scan, undisturbed.scan)
    casts = [r for r in result.records if r.stage == "intersect"]
    assert sum(record.items for record in casts) == SURVEY.scan_count
    assert left_over(client) == ([], [], [])


def test_more_deaths_than_dask_allows_a_task(client, undisturbed, left_over):
    """Dask gives a task up for good when its fourth worker dies."""
    killed = []

    def on_frame(frame) -> None:
        if frame.scan % 200 == 100:
            # The sorter may just be between two workers, or its worker may have only started.
            with suppress(OSError, IndexError):
                kill_worker_of(client, "sort")
                killed.append(frame.scan)

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert len(killed) > 3
    assert np.array_equal(result.cloud.positions, undisturbed.positions)
    assert left_over(client) == ([], [], [])


@pytest.mark.parametrize("pump", [SurveyPump, TrialPump])
def test_an_interrupt_while_starting_leaves_nothing(
    client, undisturbed, monkeypatch, pump, left_over
):
    method = "start" if pump is SurveyPump else "step"
    original = getattr(pump, method)

    def interrupted(self) -> None:
        original(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(pump, method, interrupted)
    planning = Planning((25, 25), (-30, -20), trials=3, particles=50, iterations=20)
    with pytest.raises(KeyboardInterrupt):
        simulate(Scene.seed(), SURVEY, planning, client=client)
    monkeypatch.undo()
    assert left_over(client) == ([], [], [])
    again = simulate(Scene.seed(), SURVEY, client=client).cloud
    assert np.array_equal(again.positions, undisturbed.positions)


def test_trials_cancelled_by_somebody_end_the_run(client, left_over):
    planning = Planning((25, 25), (-30, -20), trials=500)
    pumps = []
    original = TrialPump.__init__

    def spy(self, *arguments) -> None:
        original(self, *arguments)
        pumps.append(self)

    def cancel(progress) -> None:
        client.cancel(list(pumps[0]._running), force=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrialPump, "__init__", spy)
        with pytest.raises(LidarpoolError, match=r"trial \d+ was cancelled"):
            simulate(Scene.seed(), SURVEY, planning, client=client, on_progress=cancel)
    assert left_over(client)[1:] == ([], [])


def test_a_slot_lost_for_good_ends_the_run(monkeypatch, left_over):
    monkeypatch.setattr(lidarpool.watch, "PATIENCE_S", 2.0)
    with cluster_of_slots() as cluster, Client(cluster) as client:

        def on_frame(frame) -> None:
            if frame.scan == 300:
                address = worker_of(client, "sort")
                workers = worker_identities(client)
                nanny = cluster.workers[workers[address]["name"]]
                threading.Thread(target=client.sync, args=(nanny.close,)).start()

        with pytest.raises(LidarpoolError, match="Stage sort has had no free slot"):
            simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
        assert left_over(client)[1:] == ([], [])


@pytest.mark.parametrize(
    "wrong", [{"collectors": 0}, {"queue_capacity": 0}, {"gpu_workers": 0}, {"other_workers": -1}]
)
def test_numbers_below_one_are_refused(wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(LidarpoolError, match=f"{name} is {value}; it must be at least 1"):
        simulate(Scene.seed(), SURVEY, **wrong)


def test_workers_of_others_are_left_alone(undisturbed):
    """A worker of no partition need not even have lidarpool."""
    with cluster_of_slots(foreign=1) as cluster, Client(cluster) as client:
        workers = worker_identities(client)
        foreign = [address for address, w in workers.items() if not w["resources"]]
        client.run(_hide_lidarpool, workers=foreign)
        cloud = simulate(Scene.seed(), SURVEY, client=client).cloud
    assert np.array_equal(cloud.positions, undisturbed.positions)


def _hide_lidarpool() -> None:
    import sys

    for name in ("lidarpool", "lidarpool._version", "poolpart", "poolpart.probe"):
        sys.modules[name] = None
