"""Stages 1, 3 and 4 on LIDAR workers of one slot each: placed, killed, stopped, replaced."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from distributed import Client, Nanny, Scheduler, SpecCluster

import poolpart.task_locations
from lidarpool import LidarpoolError, Planning, Scene, Sensor, Survey, simulate
from lidarpool.run.trials import TrialPump
from lidarpool.scan import SurveyDriver
from poolpart import trace_to, worker_identities
from poolpart.internals import FixedCluster

SURVEY = Survey(
    Sensor.grid(rays_per_revolution=360, layers=4, step_deg=1), poses=[(0, 0, 1)] * 4, steps=360
)

pytestmark = pytest.mark.usefixtures("small_batches")


@pytest.fixture(scope="module")
def slots() -> Iterator[SpecCluster]:
    """Two casting workers, one LIDAR worker more than a survey needs, and one of somebody else."""
    resources = {f"GPU-{i}": {"GPU": 1} for i in range(2)} | {"OTHER-0": {"OTHER": 1}}
    resources |= {f"LIDAR-{i}": {"LIDAR": 1} for i in range(5)}
    resources |= {"foreign-0": {}}
    options = {"nthreads": 1, "host": "127.0.0.1", "dashboard": False, "silence_logs": 50}
    workers = {
        name: {"cls": Nanny, "options": {**options, "resources": declared}}
        for name, declared in resources.items()
    }
    scheduler = {
        "cls": Scheduler,
        "options": {"host": "127.0.0.1", "port": 0, "dashboard_address": "127.0.0.1:0"},
    }
    with FixedCluster(workers=workers, scheduler=scheduler, silence_logs=50) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def connected(slots: SpecCluster) -> Iterator[Client]:
    with Client(slots, set_as_default=False) as client:
        workers = worker_identities(client)
        foreign = [address for address, w in workers.items() if not w["resources"]]
        client.run(_hide_lidarpool, workers=foreign)
        yield client


def _hide_lidarpool() -> None:
    """A worker of no partition need not even have lidarpool."""
    import sys

    for name in ("lidarpool", "lidarpool._version", "poolpart", "poolpart.probe"):
        sys.modules[name] = None


@pytest.fixture
def client(slots, connected, wait_for_all) -> Client:
    """Client of the cluster once all workers are there that an earlier test has killed."""
    wait_for_all(connected, len(slots.worker_spec))
    return connected


@pytest.fixture(scope="module")
def undisturbed(cluster_client):
    return simulate(Scene.seed(), SURVEY, client=cluster_client).cloud


def workers_of(client: Client, stage: str) -> list[str]:
    """Address of the worker that runs a stage; none while it is between two."""

    def look(dask_scheduler):
        return [
            task.processing_on.address
            for key, task in dask_scheduler.tasks.items()
            if str(key).startswith(stage) and task.processing_on
        ]

    return client.run_on_scheduler(look)


def pid_of_worker(client: Client, stage: str) -> int:
    """Process that runs a stage, or has prepared itself for stage 2."""

    def look(dask_scheduler):
        tasks = [t for key, t in dask_scheduler.tasks.items() if str(key).startswith(stage)]
        return [w.address for t in tasks for w in t.who_has or ()]

    address = (workers_of(client, stage) or client.run_on_scheduler(look))[0]
    return client.run(os.getpid, workers=[address])[address]


def test_each_stage_has_a_slot_of_its_own(client, undisturbed, all_records):
    result = simulate(Scene.seed(), SURVEY, client=client)
    stages = [r for r in result.records if r.partition == "LIDAR"]
    assert len({record.worker for record in stages}) == len(stages) == 4
    assert np.array_equal(result.cloud.positions, undisturbed.positions)


@pytest.mark.parametrize(
    "stage", ["sort", "collect-0", pytest.param("generate", marks=pytest.mark.slow)]
)
def test_a_stage_whose_worker_dies_is_started_elsewhere(client, undisturbed, stage, left_over):
    def on_frame(frame) -> None:
        if frame.scan == 300:
            os.kill(pid_of_worker(client, stage), signal.SIGKILL)

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert np.array_equal(result.cloud.positions, undisturbed.positions)
    assert np.array_equal(result.cloud.scan, undisturbed.scan)
    casts = [r for r in result.records if r.stage == "intersect"]
    assert sum(record.items for record in casts) == SURVEY.scan_count
    assert left_over(client) == ([], [], [])


@pytest.mark.slow
def test_more_deaths_than_dask_allows_a_task(client, slots, undisturbed, left_over):
    """Dask gives a task up for good when its fourth worker dies."""
    killed: dict[str, int] = {}  # {worker: scan}

    def on_frame(frame) -> None:
        if len(killed) == 5 or frame.scan % 10 or frame.scan < 100 * len(killed):
            return
        # The sorter may be between two workers for many frames: what it has sent still arrives.
        for address in workers_of(client, "sort"):
            nannies = [n for n in slots.workers.values() if n.worker_address == address]
            for nanny in nannies if address not in killed else ():
                os.kill(nanny.pid, signal.SIGKILL)
                killed[address] = frame.scan

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert len(killed) > 3
    assert np.array_equal(result.cloud.positions, undisturbed.positions)
    assert left_over(client) == ([], [], [])


@pytest.mark.parametrize(
    "stage", ["sort", *(pytest.param(s, marks=pytest.mark.slow) for s in ("collect-0", "prepare"))]
)
def test_one_that_wakes_up_beside_its_successor_does_no_harm(
    client, undisturbed, same_cloud, monkeypatch, stage, left_over
):
    """The scheduler would take it for dead after five minutes, and wait that long."""
    pids, seen = [], []
    events: set[tuple[str, str]] = set()

    def on_frame(frame) -> None:
        seen.append(frame.scan)
        if frame.scan == 300:
            pids.append(pid_of_worker(client, stage))
            os.kill(pids[0], signal.SIGSTOP)
            # Only now: on a busy machine others that are well may be silent for so long.
            patience.setattr(poolpart.task_locations, "SILENT_S", 2.0)
        elif frame.scan == 1000:
            patience.undo()
            os.kill(pids[0], signal.SIGCONT)

    trace_to(lambda point, fields: events.add((point, fields.get("reason", fields["stage"]))))
    try:
        with monkeypatch.context() as patience:
            result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    finally:
        trace_to(None)
        os.kill(pids[0], signal.SIGCONT)
    assert seen == list(range(SURVEY.scan_count))
    assert same_cloud(result.cloud, undisturbed)
    again = {
        "collect-0": "the worker of collect-0 died",
        "prepare": "its worker is gone or silent",
    }
    assert stage not in again or ("driver.replay", again[stage]) in events
    assert left_over(client) == ([], [], [])


@pytest.mark.parametrize("pump", [SurveyDriver, TrialPump])
def test_an_interrupt_while_starting_leaves_nothing(client, monkeypatch, pump, left_over):
    method = "start" if pump is SurveyDriver else "step"
    original = getattr(pump, method)

    def interrupted(self) -> None:
        original(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(pump, method, interrupted)
    planning = Planning((25, 25), (-30, -20), trials=3, particles=50, iterations=20)
    with pytest.raises(KeyboardInterrupt):
        simulate(Scene.seed(), SURVEY, planning, client=client)
    assert left_over(client) == ([], [], [])


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


@pytest.mark.slow
def test_a_slot_lost_for_good_ends_the_run(outside, left_over):
    cluster = outside()
    cluster.add("GPU")
    cluster.add("LIDAR", count=4)
    cluster.wait()
    with Client(cluster.address, set_as_default=False) as client:

        def on_frame(frame) -> None:
            if frame.scan == 300:
                names = {a: w["name"] for a, w in worker_identities(client).items()}
                cluster.kill(names[workers_of(client, "sort")[0]])

        with pytest.raises(LidarpoolError, match="Stage sort has had no free slot"):
            # Paced: the slot of stage 1 comes free when it has described all scans.
            simulate(
                Scene.seed(),
                SURVEY,
                client=client,
                on_frame=on_frame,
                patience_s=2.0,
                scans_per_second=100,
            )
        assert left_over(client)[1:] == ([], [])


@pytest.mark.parametrize(
    "wrong", [{"collectors": 0}, {"queue_capacity": 0}, {"gpu_workers": 0}, {"other_workers": -1}]
)
def test_numbers_below_one_are_refused(wrong: dict[str, Any]):
    ((name, value),) = wrong.items()
    with pytest.raises(LidarpoolError, match=f"{name} is {value}; it must be at least 1"):
        simulate(Scene.seed(), SURVEY, **wrong)
