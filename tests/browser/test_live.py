"""A run, watched and stopped in a browser while it goes on."""

import re
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from lidarpool import Job, Scene, Survey
from lidarpool.pages.live_page import live_page
from lidarpool.run.cluster.cluster import ClusterConnection
from lidarpool.run.cluster.connection import local_client
from lidarpool.run.job_source import SingleJob
from lidarpool.run.listener import Listener
from lidarpool.run.options import RunOptions
from lidarpool.run.progress import Screen
from lidarpool.run.runner import cast, open_store

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SCANS = 1080
ALL = float("inf")


@pytest.fixture(scope="module")
def client():
    """Return the client of a small cluster."""
    with local_client({"LIDAR": 4}, gpu_workers=1, other_workers=1) as client:
        yield client


@pytest.fixture
def live(monkeypatch):
    """Return a page, and the job that it follows, a survey of many small batches."""
    monkeypatch.setattr("lidarpool.run.pipeline.policies.scans_per_batch", lambda *_: 10)
    survey = Survey(poses=[(0, 0, 1 + step / 20) for step in range(SCANS // 36)])
    job = SingleJob(Job(Scene.seed(), survey))
    with live_page(title="yard", port=0, browser=False) as live:
        yield live, job


class Driven:
    """A run in a thread of its own, and how it ended.

    It stands still at the first frame after it has `most` points: a browser may be slower than
    any run. Few batches are ahead of the frames, so that it is far from its end then.
    """

    def __init__(self, client, live, job, most=1):
        self.error = None
        self.most = most
        begun = time.monotonic()
        options = RunOptions(client=client)
        screen = Screen(lambda progress: None)

        def on_frame(frame):
            while self.points.parts.point_count >= self.most:
                now = replace(self.points.progress(), seconds=time.monotonic() - begun)
                live.on_progress(now, list)  # KeyboardInterrupt if somebody has stopped it
                time.sleep(0.05)

        self._on_frame = on_frame

        def run():
            try:
                with (
                    ClusterConnection(job, options, screen) as connection,
                    open_store(job, options, screen) as self.store,
                ):
                    committed = cast(self.store, connection, Listener(live, self.on_frame))
                    result = committed.result(screen)
                    live.finish(result.seconds, result)
            except BaseException as error:
                self.error = error

        self.thread = threading.Thread(target=run)
        self.thread.start()

    def on_frame(self, frame):
        """Stand still, if it is time to."""
        self._on_frame(frame)

    @property
    def points(self):
        """What is committed."""
        return self.store.only_job

    def ended(self):
        """Wait for its end."""
        self.thread.join(300)
        assert not self.thread.is_alive()


def opened(new_tab, live):
    """Open the page of a run that has not begun."""
    tab = new_tab(live.page.url)
    tab.wait_for(lambda text: "starting" in text)
    assert tab.value("document.title") == "yard - lidarpool"
    return tab


def points_in(text):
    """Number of points that the panel tells of."""
    found = re.search(r"([\d,]+) points", text)
    return int(found[1].replace(",", "")) if found else 0


def test_points_grow_until_all_are_there(client, live, new_tab, tmp_path):
    live, job = live
    tab = opened(new_tab, live)
    other = opened(new_tab, live)
    run = Driven(client, live, job)
    try:
        first = tab.wait_for(points_in)
        run.most = first + 1
        tab.wait_for(lambda text: points_in(text) > first)
        tab.wait_for(lambda text: re.search(r"GPU, slots busy\s+\d+ % of 1", text))
        assert not run.points.is_complete
    finally:
        run.most = ALL
        run.ended()
    assert run.error is None
    assert run.points.is_complete
    total = f"{run.points.parts.point_count:,} points"
    tab.wait_for(lambda text: "done" in text and total in text)
    rays = "[lidarpool.chosen.rays, lidarpool.picture.rays?.visible ?? false]"
    tab.wait_for(lambda _: tab.value(rays) == [False, False])  # rays would hide the points
    assert tab.value("document.title") == "yard - lidarpool"
    assert tab.value("document.querySelector('#panel h1').textContent") == "yard"
    other.wait_for(lambda text: "done" in text and total in text)
    tab.wait_for(lambda _: len(colors(tab.picture(tmp_path / "live.png"))) > 200)
    assert tab.errors == []
    own = (live.page.url, "data:", "blob:")
    assert [request for request in tab.requests if not request.startswith(own)] == []


def test_stop_ends_the_run_as_an_interrupt_does(client, live, new_tab):
    live, job = live
    tab = opened(new_tab, live)
    run = Driven(client, live, job)
    try:
        tab.wait_for(points_in)
        tab.click("Stop")
        tab.wait_for(lambda _: live.stopped.is_set())
    finally:
        live.stopped.set()
        run.ended()
    assert isinstance(run.error, KeyboardInterrupt)
    assert not run.points.is_complete


def colors(picture):
    """Colors left of the panel."""
    return np.unique(picture[100:, :900].reshape(-1, 3), axis=0)
