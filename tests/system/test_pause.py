"""Runs that are paused: everything arrives, nothing more is begun, and nothing times out."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from distributed import Client

from lidarpool import LidarpoolError, Planning, ScanSpec, Scene, Sensor, Survey, simulate
from lidarpool.run.database import FILE, RunDatabase
from lidarpool.run.job import Job
from lidarpool.run.progress import Progress
from lidarpool.run.run import Run
from lidarpool.run.store import RunStore

LONG_S = 300.0
SENSOR = Sensor.grid(rays_per_revolution=720, layers=8)


def make_job(stations: int = 20) -> Job:
    """Make a survey that takes some seconds, and a planning beside it."""
    planning = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=30, iterations=40)
    poses = [(0, 0, 1 + step / 40) for step in range(stations)]
    return Job(Scene.seed(), Survey(SENSOR, poses), planning, "numpy")


class Clock:
    """The module `time`, with a clock that can be put forward."""

    ahead_s = 0.0

    def monotonic(self) -> float:
        return time.monotonic() + self.ahead_s

    def __getattr__(self, name: str) -> object:
        return getattr(time, name)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Clock that all of lidarpool goes by."""
    clock = Clock()
    for name, module in list(sys.modules.items()):
        if name.startswith("lidarpool.") and getattr(module, "time", None) is time:
            monkeypatch.setattr(module, "time", clock)
    return clock


@pytest.fixture
def all_due(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Have stage 1 describe half of the scans until this is set.

    The driver may be held up for as long as the survey takes, and be told to pause too late.
    """
    all_due, describe = threading.Event(), Survey.scan

    def scan(survey: Survey, index: int) -> ScanSpec:
        assert index < survey.scan_count // 2 or all_due.wait(LONG_S)
        return describe(survey, index)

    monkeypatch.setattr(Survey, "scan", scan)
    yield all_due
    all_due.set()


class Driven:
    """A run in a folder, which is paused as soon as it has some points."""

    def __init__(self, client: Client, folder: Path, job: Job | None = None) -> None:
        self.kept = RunStore(job or make_job(), folder / "run", resume=True)
        self.paused, self.stopped = threading.Event(), threading.Event()
        self.run = Run(client, self.kept, self.paused.is_set)
        self.seen: list[Progress] = []
        self.still = threading.Event()

    def on_progress(self, progress: Progress) -> None:
        self.seen.append(progress)
        if not self.seen[0].paused and progress.points and not self.still.is_set():
            self.paused.set()
        if progress.paused:
            self.still.set()
        if self.stopped.is_set():
            raise KeyboardInterrupt

    def drive(self, then: Callable[[], object]) -> None:
        """Drive the run here; `then` is called in another thread when it stands still."""

        def wait() -> None:
            assert self.still.wait(LONG_S)
            then()

        helper = threading.Thread(target=wait)
        helper.start()
        try:
            with self.kept.kept_on_error():
                self.result = self.run.drive(None, self.on_progress)
        finally:
            self.still.set()
            helper.join(LONG_S)


@pytest.fixture
def client(cluster: str) -> Iterator[Client]:
    with Client(cluster, set_as_default=False) as client:
        yield client


def busy_tasks(client: Client) -> list[str]:
    """Tasks that hold or wait for a worker, but for the long stages."""

    def look(dask_scheduler):
        tasks = dask_scheduler.tasks.values()
        return [task.prefix.name for task in tasks if task.state in ("processing", "queued")]

    long = {"generate", "sort", "collect"}
    return [name for name in client.run_on_scheduler(look) if name not in long]


def test_a_paused_run_stands_still_for_long_and_then_goes_on(client, tmp_path, clock, all_due):
    """Longer than anything may take: nothing is under way that could be late or silent."""
    driven = Driven(client, tmp_path)
    found = {}

    def wait_for_looks(count: int) -> None:
        seen, stop = len(driven.seen), time.monotonic() + LONG_S
        while len(driven.seen) < seen + count and time.monotonic() < stop:
            time.sleep(0.05)

    def look_and_go_on() -> None:
        all_due.set()
        found["busy"] = busy_tasks(client)
        before = driven.kept.db.scans_done, driven.kept.db.frames
        shutil.copytree(tmp_path / "run", tmp_path / "crashed" / "run")  # as after a crash now
        wait_for_looks(5)
        clock.ahead_s = 1000.0
        wait_for_looks(10)  # of which each takes a tenth of a second
        found["stood"] = (driven.kept.db.scans_done, driven.kept.db.frames) == before
        driven.paused.clear()

    driven.drive(look_and_go_on)
    assert found == {"busy": [], "stood": True}
    paused = [progress for progress in driven.seen if progress.paused]
    first = paused[0]
    assert len(paused) > 10
    assert 0 < first.collected == first.framed == first.cast < first.scans
    assert {(p.collected, p.trials_done) for p in paused} == {(first.collected, first.trials_done)}
    assert driven.seen[-1].collected == first.scans
    assert driven.result.replayed == driven.result.duplicates_dropped == 0
    job = make_job()
    whole = simulate(job.scene, job.survey, job.planning, client=client, backend="numpy")
    assert np.array_equal(driven.result.cloud.positions, whole.cloud.positions)
    # What a crash during the pause would have left.
    left = RunDatabase(tmp_path / "crashed" / "run" / FILE, job.survey.scan_count)
    assert left.scans_done == left.frames == first.collected
    assert len(left.trials) == first.trials_done
    left.close()


@pytest.mark.parametrize("how", ["stop", "interrupt"])
def test_a_paused_run_can_be_ended_and_resumed(client, tmp_path, how, left_over, all_due):
    driven = Driven(client, tmp_path)
    stop = driven.stopped.set if how == "stop" else lambda: os.kill(os.getpid(), signal.SIGINT)

    def end() -> None:
        all_due.set()
        stop()

    with pytest.raises(KeyboardInterrupt) as ended:
        driven.drive(end)
    delivered = driven.seen[-1].collected
    assert f"{delivered:,} of" in "".join(ended.value.__notes__)
    assert left_over(client) == ([], [], [])
    again = Driven(client, tmp_path)
    assert again.kept.resumed == delivered > 0
    again.drive(again.paused.clear)
    assert again.result.resumed == delivered
    again.kept.remove()


def test_a_cluster_that_is_lost_during_a_pause_ends_the_run(outside, tmp_path):
    cluster = outside()
    cluster.add_threads(("GPU", 1), ("LIDAR", 4), ("OTHER", 1))
    cluster.wait()
    with Client(cluster.address, set_as_default=False) as client:
        driven = Driven(client, tmp_path, make_job(400))  # not to be over before the pause
        with pytest.raises(LidarpoolError, match="cannot be reached any more") as ended:
            driven.drive(lambda: cluster.kill("scheduler"))
    assert "continue with" in "".join(ended.value.__notes__)
    kept = RunStore(make_job(400), tmp_path / "run", resume=True)
    assert kept.resumed == driven.seen[-1].collected > 0
    kept.remove()
