"""Scans that kill whatever worker takes them."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from distributed import Client

import lidarpool.scan.caster
import lidarpool.scan.crew
import lidarpool.scan.long_stages
import lidarpool.trials
from lidarpool import LidarpoolError, Planning, Scene, Sensor, Survey, simulate
from lidarpool.scan import CloudBuilder, SurveyPump
from lidarpool.scan import casting as casting_module
from lidarpool.scan.failures import words_on_memory
from poolpart import local_cluster, trace_to

SURVEY = Survey(
    Sensor(rays_per_revolution=720, layers=16, step_deg=1), poses=[(0, 0, 1), (1, 0, 2)], steps=360
)
POISON = 217


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """A local cluster with two casting workers."""
    with local_cluster(gpu_workers=2, other_workers=1) as cluster, Client(cluster) as client:
        yield client


@pytest.fixture(scope="module")
def undisturbed(client):
    client.wait_for_workers(4, timeout=120)
    return simulate(Scene.seed(), SURVEY, client=client).cloud


@pytest.fixture(autouse=True)
def all_workers(client, wait_for_all, small_batches) -> None:
    """Begin with all workers, also behind a test that killed some.

    A batch of ten scans costs a worker before the poison in it is alone, at any speed.
    """
    wait_for_all(client, 4)


@pytest.fixture
def clouds(monkeypatch) -> list[CloudBuilder]:
    """What the pumps of a test collect."""
    made: list[CloudBuilder] = []
    original = SurveyPump.__init__

    def spy(self, *arguments, **options) -> None:
        original(self, *arguments, **options)
        made.append(self.cloud)

    monkeypatch.setattr(SurveyPump, "__init__", spy)
    return made


def dying_at(scans: set[int], deaths_left: Path | None = None) -> Callable[[int], None]:
    """A function of a scan that ends its process, each time or as often as a file is long."""

    def die(scan: int) -> None:
        if scan not in scans:
            return
        if deaths_left is not None:
            left = deaths_left.stat().st_size
            if not left:
                return
            os.truncate(deaths_left, left - 1)
        os.kill(os.getpid(), signal.SIGKILL)

    return die


def poisoned_intersect(die: Callable[[int], None]) -> Callable:
    original = casting_module.intersect

    def intersect(setup, wire, run):
        batch = original(setup, wire, run)
        for numbers in wire:
            die(int(numbers[0]))
        return batch

    return intersect


def poisoned_collect(die: Callable[[int], None]) -> Callable:
    def collect(attempt, *arguments):
        from lidarpool.scan import stages

        original = stages.points_of

        def points_of(sensor, spec, *others):
            die(spec.scan)
            return original(sensor, spec, *others)

        stages.points_of = points_of
        return stages.collect(attempt, *arguments)

    return collect


def poisoned_sort(die: Callable[[int], None]) -> Callable:
    def sort_frames(attempt, *arguments):
        from lidarpool.scan import stages

        original = stages._frame_runs

        def frame_runs(frames, records):
            for frame in frames:
                die(frame.scan)
            return original(frames, records)

        stages._frame_runs = frame_runs
        return stages.sort_frames(attempt, *arguments)

    return sort_frames


def tasks_left(client: Client) -> list[str]:
    """Keys that the scheduler still knows, after a moment."""
    until = time.monotonic() + 120
    while True:
        keys = client.run_on_scheduler(lambda dask_scheduler: list(map(str, dask_scheduler.tasks)))
        if not keys or time.monotonic() > until:
            return keys
        time.sleep(0.05)


def test_a_scan_that_kills_its_worker_is_named_and_all_others_are_kept(client, clouds, monkeypatch):
    poisoned = poisoned_intersect(dying_at({POISON}))
    monkeypatch.setattr(lidarpool.scan.caster, "intersect", poisoned)
    frames = []
    message = rf"^scan {POISON} kills the worker that casts it: 3 of them died"
    with pytest.raises(LidarpoolError, match=message):
        simulate(
            Scene.seed(), SURVEY, client=client, on_frame=lambda frame: frames.append(frame.scan)
        )
    # Everything that was under way beside it has arrived; frames are in order, up to it.
    missing = list(clouds[0].ledger.missing())
    assert missing[0] == POISON
    assert missing[1:] == list(range(missing[1], SURVEY.scan_count))
    assert frames == list(range(len(frames)))
    assert len(frames) <= POISON
    assert tasks_left(client) == []


def test_a_scan_that_stops_killing_is_not_to_blame(
    client, undisturbed, same_cloud, monkeypatch, tmp_path
):
    """Whoever is hit some times by others is cast in the end, and nothing is lost."""
    deaths_left = tmp_path / "deaths"
    deaths_left.write_bytes(b"x" * 5)
    poisoned = poisoned_intersect(dying_at({POISON}, deaths_left))
    monkeypatch.setattr(lidarpool.scan.caster, "intersect", poisoned)
    points = []
    trace_to(lambda point, fields: points.append((point, fields.get("reason"))))
    try:
        cloud = simulate(Scene.seed(), SURVEY, client=client).cloud
    finally:
        trace_to(None)
    assert same_cloud(cloud, undisturbed)
    assert deaths_left.stat().st_size == 0
    assert ("driver.recast", "on trial") in points


@pytest.mark.parametrize(
    ("function", "poisoned", "stage"),
    [("collect", poisoned_collect, "collect"), ("sort_frames", poisoned_sort, "sort")],
)
@pytest.mark.slow
def test_a_scan_that_kills_a_long_stage_is_named(
    client, clouds, monkeypatch, function, poisoned, stage
):
    monkeypatch.setattr(lidarpool.scan.long_stages, function, poisoned(dying_at({POISON})))
    message = rf"^scan {POISON} kills the worker that runs stage {stage}: 3 of them died"
    with pytest.raises(LidarpoolError, match=message):
        simulate(Scene.seed(), SURVEY, client=client)
    assert all(scan in clouds[0].ledger for scan in range(POISON))
    assert tasks_left(client) == []


@pytest.mark.slow
def test_a_scene_that_kills_its_workers_ends_the_run(client, monkeypatch):
    def prepare(setup) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(lidarpool.scan.crew, "_prepare", prepare)
    with pytest.raises(LidarpoolError, match="preparing the scene on the GPU workers has ended"):
        simulate(Scene.seed(), SURVEY, client=client)
    assert tasks_left(client) == []


def test_a_worker_that_was_ended_for_its_memory_is_known(client):
    client.log_event("worker-restart-memory", {"worker": "tcp://127.0.0.1:1", "rss": 1})
    assert words_on_memory(client, ["tcp://127.0.0.1:2"]) == ""
    until = time.monotonic() + 120
    while not (words := words_on_memory(client, ["tcp://127.0.0.1:1"])):
        assert time.monotonic() < until
    assert "memory" in words


@pytest.mark.slow
def test_a_trial_whose_workers_were_killed_is_tried_again(client, monkeypatch, tmp_path):
    """Dask gives a task up at the fourth death, whoever is to blame for it."""
    deaths_left = tmp_path / "deaths"
    deaths_left.write_bytes(b"x" * 4)
    die, original = dying_at({2}, deaths_left), lidarpool.trials.run_trial

    def run_trial(planning, number):
        die(number)
        return original(planning, number)

    monkeypatch.setattr(lidarpool.trials, "run_trial", run_trial)
    planning = Planning((25, 25), (-30, -20), trials=5, particles=50, iterations=20)
    result = simulate(Scene.seed(), Survey(poses=[(0, 0, 1)]), planning, client=client)
    assert sorted(trial.trial for trial in result.trials) == list(range(5))
    assert deaths_left.stat().st_size == 0
    assert tasks_left(client) == []
