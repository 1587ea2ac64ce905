"""Runs that are paused: everything arrives, nothing more is begun, and nothing times out."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from distributed import Client

import poolpart.whereabouts
from lidarpool import LidarpoolError, Planning, Scene, Sensor, Survey, simulate
from lidarpool.job import Job
from lidarpool.journal import Journal, open_journal
from lidarpool.live.control import RunControl
from lidarpool.progress import Progress
from lidarpool.run import Run
from lidarpool.scan import caster, pump

LONG_S = 120.0
LIMIT_S = 5.0  # that anything may take, in the test of a pause that is longer
SENSOR = Sensor(rays_per_revolution=720, layers=8)
POSES = [(0, 0, 1 + step / 40) for step in range(20)]


def make_job() -> Job:
    """Make a survey that takes some seconds, and a planning beside it."""
    planning = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=30, iterations=40)
    return Job(Scene.seed(), Survey(SENSOR, POSES), planning, "numpy", scans_per_second=300)


class Driven:
    """A run with a journal, which is paused as soon as it has some points."""

    def __init__(self, client: Client, folder: Path) -> None:
        self.kept: Journal = open_journal(folder / "journal", make_job(), resume=True)
        self.control = RunControl()
        self.run = Run(client, self.kept, lambda: self.control.paused)
        self.seen: list[Progress] = []
        self.still = threading.Event()

    def on_progress(self, progress: Progress) -> None:
        self.seen.append(progress)
        if not self.seen[0].paused and progress.points and not self.still.is_set():
            self.control.pause()
        if progress.paused:
            self.still.set()
        self.control.check()

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


def test_a_paused_run_stands_still_for_long_and_then_goes_on(client, tmp_path, monkeypatch):
    """Longer than anything may take: nothing is under way that could be late or silent."""
    # No less: what is under way before and after the pause may take so long on a busy machine.
    limits = (pump, "STALL_SECONDS"), (caster, "LATE_S"), (poolpart.whereabouts, "SILENT_S")
    for module, name in limits:
        monkeypatch.setattr(module, name, LIMIT_S)
    driven = Driven(client, tmp_path)
    found = {}

    def look_and_go_on() -> None:
        found["busy"] = busy_tasks(client)
        before = driven.kept.cloud.ledger.delivered, driven.kept.totals.frames
        # As after a crash at this moment, and of the kind that loses what was not synced.
        found["unsynced"] = driven.kept._store.file.end - driven.kept._store.file._durable
        shutil.copytree(tmp_path / "journal", tmp_path / "crashed" / "journal")
        time.sleep(LIMIT_S + 1)
        found["stood"] = (driven.kept.cloud.ledger.delivered, driven.kept.totals.frames) == before
        driven.control.go_on()

    driven.drive(look_and_go_on)
    assert found == {"busy": [], "unsynced": 0, "stood": True}
    paused = [progress for progress in driven.seen if progress.paused]
    first = paused[0]
    assert len(paused) > 10
    assert 0 < first.collected == first.framed == first.cast < first.scans
    assert {(p.collected, p.trials_done) for p in paused} == {(first.collected, first.trials_done)}
    assert driven.seen[-1].collected == first.scans
    assert driven.result.replayed == driven.result.duplicates_dropped == 0
    assert any("was paused for" in note for note in driven.result.notes)
    job = make_job()
    whole = simulate(job.scene, job.survey, job.planning, client=client, backend="numpy")
    assert np.array_equal(driven.result.cloud.positions, whole.cloud.positions)
    # What a crash during the pause would have left.
    left = open_journal(tmp_path / "crashed" / "journal", make_job(), resume=True)
    assert left.resumed == left.totals.frames == first.collected
    assert len(left.trials) == first.trials_done
    left.close()


@pytest.mark.parametrize("how", ["stop", "interrupt"])
def test_a_paused_run_can_be_ended_and_resumed(client, tmp_path, how, left_over):
    driven = Driven(client, tmp_path)
    end = driven.control.stop if how == "stop" else lambda: os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as ended:
        driven.drive(end)
    delivered = driven.seen[-1].collected
    assert f"{delivered:,} of" in "".join(ended.value.__notes__)
    assert left_over(client) == ([], [], [])
    again = Driven(client, tmp_path)
    assert again.kept.resumed == delivered > 0
    again.drive(again.control.go_on)
    assert again.result.resumed == delivered
    again.kept.remove()


@pytest.mark.slow  # starts a cluster of processes
def test_a_cluster_that_is_lost_during_a_pause_ends_the_run(outside, tmp_path):
    cluster = outside()
    cluster.add("GPU")
    cluster.add("LIDAR", slots=4)
    cluster.add("OTHER")
    cluster.wait()
    with Client(cluster.address, set_as_default=False) as client:
        driven = Driven(client, tmp_path)
        with pytest.raises(LidarpoolError, match="cannot be reached any more") as ended:
            driven.drive(lambda: cluster.kill("scheduler"))
    assert "continue with" in "".join(ended.value.__notes__)
    kept = open_journal(tmp_path / "journal", make_job(), resume=True)
    assert kept.resumed == driven.seen[-1].collected > 0
    kept.close()
