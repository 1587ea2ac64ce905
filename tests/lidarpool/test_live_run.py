"""A run on its live page: the parts that it commits, those of an earlier run, and its end."""

from __future__ import annotations

import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from distributed import Client
from tests.clusters import thread_cluster
from tests.committing import commit
from tests.pages import ask
from tests.shapes import box

from lidarfiles.datasets.job_table import JobRow
from lidarpool import Campaign
from lidarpool.pages.listed_jobs import MAX_ENDED, MAX_FAILED, MAX_UNDER_WAY
from lidarpool.pages.live_job import LiveJob
from lidarpool.pages.live_page import LivePage, live_page
from lidarpool.pages.run_status import busy_slots
from lidarpool.report.campaign_output import run_campaign
from lidarpool.run import listener
from lidarpool.run.job_source import SingleJob
from lidarpool.run.listener import Listener
from lidarpool.run.options import RunOptions
from lidarpool.run.progress import Progress, Screen
from lidarpool.run.runner import cast_to_store
from lidarpool.run.store.run_store import RunStore
from lidarscenario import Job, Planning
from lidarsim import Column, Scene, Sensor, Survey
from lidarsim.columns.ply_format import header, row_type
from lidarsim.columns.table import CHANNEL, OBJECT, SCAN
from poolpart import PartitionStats

LONG_S = 120.0
SCENE = Scene.from_meshes([box("Wall", (5, -9, 0), (6, 9, 4))])  # beside the sensor
WETNESS = Column("wetness", "float32", "%", "how wet it is", source="intensity")


def make_job(scans: int) -> SingleJob:
    """Make a survey from two poses, 1 m and 5 m up, in cells of half a meter."""
    poses = [(0, 0, 1), (0, 0, 5)]
    return SingleJob(Job(SCENE, Survey(Sensor.grid(), poses, steps=scans // 2, precision_m=0.5)))


@contextmanager
def shown(store: RunStore):
    """Yield the page of a run that nobody looks at."""
    with live_page(port=0, browser=False) as live:
        live.on_survey_start(store.only_job)
        yield live


def news(live: LivePage):
    """What the page is told of the run."""
    return ask(live.page.url, "news")


def wait_for(condition):
    """Wait for what is shown by itself, as a page that asks again and again."""
    stop = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < stop, "it was not shown"
        time.sleep(0.02)


def displayed(live: LivePage) -> int:
    """Count the points on the page."""
    news(live)  # or nobody looks
    return len(ask(live.page.url, "points", color="z", most=1_000_000)["arrays"]["rows"])


def test_frames_and_their_parts_are_shown_in_order_at_the_pace(monkeypatch):
    """At a tenth of the scanner's rate, never faster after a delay, nor before the part is due."""
    clock = SimpleNamespace(now=7.0)
    clock.monotonic = lambda: clock.now
    clock.sleep = lambda seconds: setattr(clock, "now", clock.now + seconds)
    monkeypatch.setattr(listener, "time", clock)
    shown = []
    page = SimpleNamespace(
        on_frame=lambda frame: shown.append((round(clock.now, 9), frame.scan)),
        on_parts=lambda parts: shown.append((round(clock.now, 9), *[part.name for part in parts])),
    )
    passed = Listener(page, pace=0.1)
    parts = [SimpleNamespace(name=name, first=first) for name, first in (("b", 2), ("a", 0))]
    passed.on_parts(parts)
    assert shown == []
    for scan, time_s in enumerate((0.0, 0.1, 0.2, 0.3, 0.0)):  # the last of a second sensor
        if scan == 3:
            clock.now += 5
        passed.on_frame(SimpleNamespace(scan=scan, time_ns=time_s * 1e9))
    assert shown == [(7, "a"), (7, 0), (8, 1), (9, "b"), (9, 2), (14, 3), (14, 4)]


def test_points_are_bounded_and_even_and_hits_exact_where_all_parts_are_read():
    store = RunStore(make_job(100))
    live = LiveJob(store.only_job, max_points=500)
    for scan in range(100):
        commit(store, scan, [33], [scan % 10], [165])
        live.add_receipts([store.only_job.parts.part_of(scan)])
        live.gather()
    assert 150 < len(live.cloud) <= 500
    by_tenth = np.histogram(live.cloud["scan"], bins=10, range=(0, 100))[0]
    assert by_tenth.min() > 0.3 * by_tenth.mean()
    assert np.array_equal(live.hit_counts(), store.only_job.hit_counts())


def test_a_part_that_cannot_be_read_is_left_out_and_the_others_are_shown():
    store = RunStore(make_job(4))
    live = LiveJob(store.only_job)
    for scan in range(3):
        commit(store, scan, [5], [7], [25])
    store.storage.remove([store.only_job.parts.part_of(1).name])
    live.add_receipts(store.only_job.parts.ordered)
    live.gather()
    assert len(live.cloud) == 10


@pytest.mark.extended
def test_a_resumed_run_shows_what_the_earlier_one_has_left(tmp_path):
    job = make_job(100)
    first = RunStore(job, location=tmp_path / "run")
    for scan in range(60):
        commit(first, scan, [10], [7], [50])
    first.db.close()
    store = RunStore(job, location=tmp_path / "run", resume=True)
    with shown(store) as live:
        # Before there is a cluster, what is left of the first is there to see.
        told = news(live)
        assert told["points"] == 600
        assert [*told["stages"][-1][1:]] == [60, 100]
        assert "starting" in told["state"]
        wait_for(lambda: displayed(live) == 600)


@pytest.mark.extended
def test_a_run_is_watched_from_its_first_part_to_its_path():
    planning = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=2, iterations=20)
    survey = Survey(poses=[(0, 0, 1), (0, 0, 3)], columns=["intensity", WETNESS])
    job = SingleJob(Job(SCENE, survey, planning))
    seen = []
    busy = set()
    scans = []
    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 4}, {"OTHER": 1}) as cluster,
        Client(cluster, set_as_default=False) as client,
        live_page(port=0, browser=False) as live,
    ):
        assert ask(live.page.url, "state")["state"] == "starting"

        def show(progress):
            seen.append(progress)
            busy.update(label.split(",")[0] for label, *_ in news(live)["slots"])

        options = RunOptions(client=client, backend="numpy")
        on_frame = scans.append
        result = cast_to_store(job, options, Screen(show), live, lambda f: on_frame(f.scan))
        assert scans == [*range(survey.scan_count)]
        told = news(live)
        assert (told["over"], told["points"]) == (True, len(result.points))
        assert told["state"] == "done"
        assert displayed(live) == len(result.points)
        state = ask(live.page.url, "state")
        assert state["path"]["corners"] == result.plan.path.tolist()
        assert len(state["arrays"]["rays"]) > 0
        hits = ask(live.page.url, "surface", color="hits")
        assert "hits per square meter" in hits["legend"]["title"]
        wet, energy = (
            ask(live.page.url, "points", color=name, most=1_000_000)["arrays"]["colors"]
            for name in ("wetness", "intensity")
        )
    assert busy == {"GPU", "LIDAR", "OTHER"}
    assert seen[-1].collected == survey.scan_count
    assert np.array_equal(wet, energy)


def progress(seconds, done, **more):
    return Progress(
        scans=100, generated=100, cast=done, framed=done, collected=done, points=2000,
        trials=0, trials_done=0, seconds=seconds, **more,
    )  # fmt: skip


@pytest.fixture
def live():
    """Return the page of a run that nobody looks at."""
    with shown(RunStore(make_job(100))) as live:
        yield live


def test_the_panel_tells_stages_pace_and_what_is_waited_for(live):
    assert "starting" in news(live)["state"]
    live.on_progress(progress(0.0, 0), list)
    live.on_progress(progress(5.0, 50), list)
    told = news(live)
    assert [told[name] for name in ("state", "seconds", "rate", "left")] == [
        "running", 5.0, "10/s", "5 s",
    ]  # fmt: skip
    assert ["2 intersect", 50, 100] in told["stages"]
    live.on_progress(progress(6.0, 60, waits_for="<GPU>"), list)
    assert "waiting for <GPU> slots held" in news(live)["state"]


def test_a_run_is_stopped_as_by_an_interrupt(live):
    live.on_progress(progress(1.0, 1), list)
    request = urllib.request.Request(f"{live.page.url}stop", data=b"")
    urllib.request.urlopen(request, timeout=LONG_S).close()
    assert news(live)["state"] == "stopping"
    with pytest.raises(KeyboardInterrupt):
        live.on_progress(progress(2.0, 2), list)


def test_a_page_that_stays_shows_the_file_of_the_cloud_and_its_sweeps(live, tmp_path):
    rows = np.zeros(3000, row_type(np.dtype(np.float32), (SCAN, CHANNEL, OBJECT)))
    rows["x"] = np.linspace(5, 6, 3000)
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())
    live.on_progress(progress(1.0, 1), list)
    before = news(live)["ends"]
    live.stopped.set()  # it stays no longer than that
    live.keep_open(path)
    assert news(live)["ends"] > before  # the page asks for all again
    assert displayed(live) == 3000
    assert "sweep_scans" in ask(live.page.url, "state")["arrays"]


@pytest.mark.extended
def test_a_run_brings_no_page_and_no_pictures_before_it_needs_them():
    """Matplotlib takes a second."""
    code = "import sys, lidarpool.cli.run_command; print(*sys.modules, sep='\\n')"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    pages = {"lidarview.viewer.server", "matplotlib", "open3d", "lidarpool.pages.live_page"}
    assert pages.isdisjoint(told.stdout.split())


def make(number, rng):
    height = float(rng.uniform(1, 3))
    if number == 2:
        raise ValueError("no such wall")
    survey = Survey(Sensor.grid(), poses=[(0, 0, height)], steps=4)
    return Job(SCENE, survey, values={"height": height, "side": "left"})


def jobs_progress(done, count, seconds):
    return Progress(seconds, jobs=count, jobs_done=done)


def row(number, **given):
    more = {} if given.get("error") else {"rays": 100, "points": 50, "seconds": 0.5}
    return JobRow(number, f"{number:04}", "", {"height": 1.23456, "side": "left"}, **(more | given))


@contextmanager
def campaign_shown(count):
    with live_page(count, ("height", "side"), "Walls", port=0, browser=False) as live:
        yield live


def wait_for_charts(live, count):
    """Ask until so many charts are there."""
    stop = time.monotonic() + LONG_S
    while ask(live.page.url, "charts")["svg"].count("<svg") != count:
        assert time.monotonic() < stop, "they were not drawn"
        ask(live.page.url, "jobs")
        time.sleep(0.05)


def status(number, stored):
    """Status of a job with some of its 40 scans in storage."""
    return {
        "name": f"{number}",
        "values": {"height": 2.0, "side": "left"},
        "stored": stored,
        "scans": 40,
        "points": 10 * stored,
        "seconds": 0.0,
        "writing": stored > 15,
    }


def test_the_page_tells_of_jobs_and_keeps_few_of_them():
    busy = [status(5000 + k, k) for k in range(20)]
    with campaign_shown(10_000) as live:
        for number in range(5000):
            live.on_job_end(row(number, error="no surface" if number % 100 == 0 else ""))
        live.on_progress(jobs_progress(3000, 10_000, 50.0), lambda: busy)
        live.on_progress(jobs_progress(5000, 10_000, 150.0), lambda: busy)
        told = ask(live.page.url, "jobs")
        assert told["title"] == "Walls"
        assert (told["count"], told["done"], told["failed"]) == (10_000, 4950, 50)
        assert told["busy"] == 20
        assert (told["points"], told["rays"]) == (4950 * 50, 4950 * 100)
        assert (told["rate"], told["left"]) == ("20 jobs/s", "4 min")
        assert told["names"] == ["height", "side"]
        assert [job["name"] for job in told["ended"]] == [f"{4999 - k}" for k in range(MAX_ENDED)]
        assert told["ended"][0]["values"] == ["1.235", "left"]
        assert [job["error"] for job in told["failures"]] == ["no surface"] * MAX_FAILED
        assert len(told["under_way"]) == MAX_UNDER_WAY
        assert [told["under_way"][4][name] for name in ("stored", "scans")] == [4, 40]
        assert told["under_way"][4]["values"] == ["2", "left"]
        assert told["under_way"][4]["points"] == 40
        live.on_job_end(row(5003))
        told = ask(live.page.url, "jobs")
        assert told["ended"][0]["name"] == "5003"
        assert "5003" not in [job["name"] for job in told["under_way"]], "it is listed once"
        wait_for_charts(live, 2)
        assert not told["over"]


def test_a_finished_campaign_shows_its_last_job():
    """Of other jobs, the first is read, and those for which there is time."""
    with campaign_shown(4) as live:
        shown = []
        for number in (1, 0, 3, 2):
            store = RunStore(make_job(4))
            commit(store, 0, [5], [7], [25])
            live.on_job_end(row(number))
            live.on_job_written(row(number), store.only_job)
            shown.append(ask(live.page.url, "jobs")["newest"])
        live.finish(9.0)
        assert ask(live.page.url, "jobs")["newest"] == [2, "0002"]
    assert shown == [[1, "0001"], [1, "0001"], [1, "0001"], [2, "0002"]]


def test_a_page_that_is_opened_early_has_the_state_of_one_that_is_opened_late():
    store = RunStore(make_job(100))
    with shown(store) as live:
        early = ask(live.page.url, "state")
        for scan in range(100):
            commit(store, scan, [33], [scan % 10], [165])
            live.on_parts([store.only_job.parts.part_of(scan)])
        wait_for(lambda: displayed(live) > 0)
        late = ask(live.page.url, "state")
    before, after = early.pop("arrays"), late.pop("arrays")
    assert {name for name in early if early[name] != late[name]} == {"version"}
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before.keys() - {"rays"})


def load(busy, seconds, slots=2):
    """What a partition says of itself."""
    return {"GPU": PartitionStats(name="GPU", busy=busy, slots=slots, seconds=seconds)}


def test_busy_slots_are_a_share_over_the_last_seconds():
    assert busy_slots([]) == []
    assert busy_slots([(0.0, load(1, 0))]) == [["GPU, slots busy", 0.5, 2]]
    short = [(float(k), load(0, 1.5 * k)) for k in range(5)]  # none is seen, all are over
    assert busy_slots(short) == [["GPU, slots busy", 0.75, 2]]
    long = [(float(k), load(2, 0)) for k in range(5)]
    assert busy_slots(long) == [["GPU, slots busy", 1.0, 2]]
    assert busy_slots([(0.0, load(0, 0)), (1.0, load(2, 90))])[0][1] == 1.0, "no more than all"
    assert busy_slots([(0.0, load(0, 0, 0))])[0][1:] == [0.0, 0]


@pytest.mark.slow
def test_a_campaign_is_watched_to_its_end(tmp_path):
    states = set()
    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster,
        Client(cluster, set_as_default=False) as client,
        campaign_shown(6) as live,
    ):

        def look(_):
            told = ask(live.page.url, "jobs", newest=1)
            states.add(told["state"])
            assert told["done"] + told["failed"] <= 6

        campaign = Campaign(make, 6, keep="folder", title="Walls")
        options = RunOptions(client=client, backend="numpy", folder=tmp_path / "set" / "run")
        run = run_campaign(tmp_path / "set", campaign, options, Screen(look), live)
        assert (run.done, len(run.failed)) == (5, 1)
        told = ask(live.page.url, "jobs")
        assert (told["done"], told["failed"], told["over"]) == (5, 1, True)
        assert "no such wall" in told["failures"][0]["error"]
        assert told["points"] == run.points
        assert told["under_way"] == []
        assert told["state"] == "done" and states  # a short campaign may not be seen running
        wait_for_charts(live, 2)

        number, name = told["newest"]
        viewer = f"{live.page.url}job/{number}/"
        assert ask(viewer, "state")["title"].startswith(f"job {name}")
        for job in told["ended"]:  # the newest as it was read, the others as they are written
            assert job["opens"]
            shown = ask(f"{live.page.url}job/{job['number']}/", "points", color="z", most=10**6)
            assert len(shown["arrays"]["rows"]) == job["points"]
        assert not any(job["opens"] for job in told["failures"])
        with pytest.raises(urllib.error.HTTPError, match="404"):
            ask(f"{live.page.url}job/{told['failures'][0]['number']}/", "state")
        for page, script in ((live.page.url, b"jobs.js"), (viewer, b"page.js")):
            with urllib.request.urlopen(page, timeout=LONG_S) as file:
                assert script in file.read()
