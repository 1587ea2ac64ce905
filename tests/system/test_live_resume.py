"""A live run that is killed half way and goes on, live: the page shows what both have done."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np
import pytest
from benchmarks.live import CAMERA
from distributed import Client
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from lidarpool import Planning, ScanSpec, Scene, Sensor, Survey, simulate
from lidarpool.job import Job
from lidarpool.journal import open_journal
from lidarpool.live import LiveRun, live_run
from lidarpool.progress import Progress
from lidarpool.run import Run

LONG_S = 120.0
POSES = [(0, 0, 1 + step / 40) for step in range(10)]


def make_job() -> Job:
    """Make a survey of some seconds, and a planning."""
    survey = Survey(Sensor(rays_per_revolution=720, layers=8), POSES)
    planning = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=8, iterations=20)
    return Job(Scene.seed(), survey, planning, "numpy", scans_per_second=300)


@contextmanager
def looked_at(live: LiveRun) -> Iterator[None]:
    """Have somebody look at a page: whatever is drawn is drawn for them."""
    protocol = Subprotocol(f"viser-v{version('viser')}")
    url = live.url.replace("http", "ws", 1)
    patient = {"open_timeout": LONG_S, "ping_timeout": LONG_S}
    with connect(
        url, subprotocols=[protocol], max_size=None, compression=None, **patient
    ) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))

        def take() -> None:
            try:
                for _ in socket:
                    pass
            except ConnectionClosed:
                return

        thread = threading.Thread(target=take)
        thread.start()
        yield
    thread.join(LONG_S)


class Watched:
    """A run on a page; what the panel said, and what came in what order."""

    def __init__(self, folder: Path, live: LiveRun, kept) -> None:
        self.folder, self.live, self.kept = folder, live, kept
        self.frames: list[int] = []
        self.progress: list[Progress] = []

    @property
    def panel(self) -> str:
        return re.sub(r"<[^>]*>", " ", self.live._text.content)

    def drive(self, client: Client, until: Callable[[Progress], bool]) -> object:
        """Drive the run, to an interrupt as soon as `until` says so."""

        def show(progress: Progress) -> None:
            self.progress.append(progress)
            if until(progress):
                raise KeyboardInterrupt

        def on_frame(frame):
            self.frames.append(frame.scan)
            self.live.on_frame(frame)

        run = Run(client, self.kept, self.live.wants_pause)
        with self.kept.kept_on_error():
            result = run.drive(on_frame, self.live.with_progress(show, run.partitions))
        self.live.finish()
        return result


@contextmanager
def watched(folder: Path) -> Iterator[Watched]:
    job = make_job()
    kept = open_journal(folder / "journal", job, resume=True)
    with live_run(job, port=0, browser=False) as live, looked_at(live):
        live.follow(kept)
        yield Watched(folder, live, kept)


def wait_for(condition: Callable[[], object]) -> None:
    """Wait for what is drawn by itself."""
    stop = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < stop, "it was not drawn"
        time.sleep(0.05)


@pytest.fixture
def client(cluster: str) -> Iterator[Client]:
    with Client(cluster, set_as_default=False) as client:
        yield client


def test_a_resumed_run_shows_what_both_runs_have_done(client, tmp_path, monkeypatch):
    go_on, describe = threading.Event(), Survey.scan

    def scan(survey: Survey, index: int) -> ScanSpec:
        """Describe no more than so many scans yet: a driver that is held up would get them all."""
        assert index < 250 or go_on.wait(LONG_S)
        return describe(survey, index)

    def enough(progress: Progress) -> bool:
        if progress.collected > 150 and progress.framed > 50:
            go_on.set()  # nothing more is taken, and stage 1 can end
        return go_on.is_set()

    monkeypatch.setattr(Survey, "scan", scan)
    with watched(tmp_path) as first, pytest.raises(KeyboardInterrupt):
        first.drive(client, enough)
    frames_before = first.frames

    with watched(tmp_path) as second:
        kept, scans = second.kept, second.kept.job.survey.scan_count
        done = kept.cloud.point_count
        assert 150 < kept.resumed < scans
        # Before there is a cluster, what is left of the first is there to see.
        told = f"{done:,} points"
        wait_for(lambda: told in second.panel and f"{kept.resumed:,} / {scans:,}" in second.panel)
        assert "starting" in second.panel
        assert second.live._scene.points.seen == done
        wait_for(lambda: second.live._scene.displayed == done)
        hits_before = kept.totals.hits
        assert hits_before > 0

        result = second.drive(client, lambda progress: False)
        total = f"{kept.cloud.point_count:,} points"
        wait_for(lambda: "done" in second.panel and total in second.panel)
        assert f"{scans:,} / {scans:,}" in second.panel
        points = second.live._scene.points
        wait_for(lambda: second.live._scene.displayed == points.seen)
    # Frames in order, each of them in one of the runs, or in both if it was not kept.
    assert frames_before == list(range(len(frames_before)))
    assert second.frames == list(range(second.frames[0], scans))
    assert second.frames[0] <= len(frames_before)
    assert [p.collected for p in second.progress] == sorted(p.collected for p in second.progress)
    assert second.progress[0].collected >= kept.resumed
    # All points, and the colours that hits give, as of a run in one go.
    assert points.seen == kept.cloud.point_count == len(points.rows)
    job = make_job()
    whole = simulate(job.scene, job.survey, job.planning, client=client, backend="numpy")
    assert np.array_equal(kept.totals.hit_counts, whole.hit_counts)
    shown = points.rows[np.argsort(points.rows["scan"], kind="stable")]
    assert np.array_equal(shown["scan"], whole.cloud.scan)
    assert np.array_equal(np.bincount(shown["ring"]), np.bincount(whole.cloud.ring))
    assert np.allclose(shown["position"].min(axis=0), whole.cloud.positions.min(axis=0), atol=1e-4)
    assert result.resumed == kept.resumed


def test_a_run_that_was_complete_but_for_its_files_is_shown_whole(client, tmp_path):
    with watched(tmp_path) as first:
        first.drive(client, lambda progress: False)
        first.kept.close()  # and then the machine went down
    with watched(tmp_path) as second:
        assert second.kept.complete
        second.live.finish()
        total = f"{second.kept.cloud.point_count:,} points"
        wait_for(lambda: "done" in second.panel and total in second.panel)
        assert "8 / 8" in second.panel  # trials
        wait_for(lambda: second.live._scene.displayed == second.kept.cloud.point_count)
        assert second.live._page.scene.get_handle_by_name("/path") is not None
        second.kept.close()


def test_whoever_closes_the_page_and_opens_it_again_sees_all_of_it(client, tmp_path):
    job = make_job()
    kept = open_journal(tmp_path / "journal", job, resume=True)
    with live_run(job, port=0, browser=False) as live:
        live.follow(kept)
        seen = Watched(tmp_path, live, kept)
        with looked_at(live):
            wait_for(lambda: "starting" in seen.panel)
        wait_for(lambda: not live._page.get_clients())
        seen.drive(client, lambda progress: False)
        assert "done" not in seen.panel  # nobody has looked
        with looked_at(live):
            total = f"{kept.cloud.point_count:,} points"
            wait_for(lambda: "done" in seen.panel and total in seen.panel)
            wait_for(lambda: live._scene.displayed == live._scene.points.seen)
    kept.remove()
