"""LIDAR as four workers of one slot each, where a stage can be given to a slot that is taken."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from distributed import Client, Nanny, Scheduler
from distributed.core import Status

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
def client(cluster, connected, wait_for_all):
    """Client of the cluster once all workers are there that an earlier test has killed."""
    wait_for_all(connected, len(cluster.worker_spec))
    return connected


@pytest.fixture(scope="module")
def undisturbed(connected):
    return simulate(Scene.seed(), SURVEY, client=connected).cloud


def workers_of(client: Client, stage: str) -> list[str]:
    """Address of the worker that runs a stage; none while it is between two."""

    def look(dask_scheduler):
        return [
            task.processing_on.address
            for key, task in dask_scheduler.tasks.items()
            if str(key).startswith(stage) and task.processing_on
        ]

    return client.run_on_scheduler(look)


def kill_worker_of(client: Client, stage: str) -> None:
    address = workers_of(client, stage)[0]
    os.kill(client.run(os.getpid, workers=[address])[address], signal.SIGKILL)


def test_each_stage_has_a_slot_of_its_own(client, undisturbed, all_records):
    for _ in range(3):
        result = simulate(Scene.seed(), SURVEY, client=client)
        stages = [r for r in result.records if r.partition == "LIDAR"]
        assert len({record.worker for record in stages}) == len(stages) == 4
        assert np.array_equal(result.cloud.positions, undisturbed.positions)


@pytest.mark.parametrize("stage", ["generate", "sort", "collect-0"])
def test_a_stage_whose_worker_dies_is_started_elsewhere(
    client, undisturbed, stage, left_over, small_batches
):
    def on_frame(frame) -> None:
        if frame.scan == 300:
            kill_worker_of(client, stage)

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert np.array_equal(result.cloud.positions, undisturbed.positions)
    assert np.array_equal(result.cloud.scan, undisturbed.scan)
    casts = [r for r in result.records if r.stage == "intersect"]
    assert sum(record.items for record in casts) == SURVEY.scan_count
    assert left_over(client) == ([], [], [])


def test_more_deaths_than_dask_allows_a_task(
    client, cluster, undisturbed, left_over, small_batches
):
    """Dask gives a task up for good when its fourth worker dies."""
    killed: dict[str, int] = {}  # {worker: scan}

    def on_frame(frame) -> None:
        if len(killed) == 5 or frame.scan % 10 or frame.scan < 100 * len(killed):
            return
        # The sorter may be between two workers for many frames: what it has sent still arrives.
        for address in workers_of(client, "sort"):
            nannies = [n for n in cluster.workers.values() if n.worker_address == address]
            for nanny in nannies if address not in killed else ():
                os.kill(nanny.pid, signal.SIGKILL)
                killed[address] = frame.scan

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


def test_a_slot_lost_for_good_ends_the_run(monkeypatch, left_over, small_batches):
    monkeypatch.setattr(lidarpool.watch, "PATIENCE_S", 2.0)
    with cluster_of_slots() as cluster, Client(cluster) as client:

        def on_frame(frame) -> None:
            if frame.scan == 300:
                address = workers_of(client, "sort")[0]
                workers = worker_identities(client)
                nanny = cluster.workers[workers[address]["name"]]
                # At once: a worker that is closed has the time to sort all that there is.
                nanny.status = Status.closing_gracefully  # it is not to start another
                os.kill(nanny.pid, signal.SIGKILL)

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
