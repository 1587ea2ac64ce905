"""A campaign on its live page: counts, the table, charts, and points of a job."""

import time
import urllib.error
import urllib.request
from contextlib import contextmanager

import pytest
import trimesh
from distributed import Client
from tests.clusters import thread_cluster
from tests.pages import ask

from lidarpool import Campaign, Job, Scene, Sensor, Survey
from lidarpool.export.jobs import JobRow
from lidarpool.live.live_page import ENDED_MOST, FAILED_MOST, UNDER_WAY_MOST, live_page
from lidarpool.report.campaign_output import DataSetOutput
from lidarpool.run.conductor import Conductor
from lidarpool.run.options import RunOptions
from lidarpool.run.page import JobNow
from lidarpool.run.progress import Progress, Screen
from lidarpool.scene.mesh import Mesh

LONG_S = 120.0
WALL = trimesh.creation.box(bounds=[(5, -9, 0), (6, 9, 4)])
SCENE = Scene.from_meshes([Mesh("Wall", WALL.vertices, WALL.faces)])


def make(number, rng):
    height = float(rng.uniform(1, 3))
    if number == 2:
        raise ValueError("no such wall")
    survey = Survey(Sensor.grid(), poses=[(0, 0, height)], steps=4)
    return Job(SCENE, survey, values={"height": height, "side": "left"})


def progress(done, count, seconds):
    return Progress(seconds, jobs=count, jobs_done=done)


def row(number, **given):
    more = {} if given.get("error") else {"rays": 100, "points": 50, "seconds": 0.5}
    return JobRow(number, f"{number:04}", "", {"height": 1.23456, "side": "left"}, **(more | given))


@contextmanager
def shown(count):
    with live_page(count, ("height", "side"), "Walls", port=0, browser=False) as live:
        yield live


def wait_for_charts(live, count):
    """Ask until so many charts are there."""
    stop = time.monotonic() + LONG_S
    while ask(live.page.url, "charts")["svg"].count("<svg") != count:
        assert time.monotonic() < stop, "they were not drawn"
        ask(live.page.url, "jobs")
        time.sleep(0.05)


def test_the_page_tells_of_jobs_and_keeps_few_of_them():
    busy = [
        JobNow(f"{5000 + k}", {"height": 2.0, "side": "left"}, k, 40, 10 * k, 0.1, writing=k > 15)
        for k in range(20)
    ]
    with shown(10_000) as live:
        for number in range(5000):
            live.ended(row(number, error="no surface" if number % 100 == 0 else ""))
        live.on_progress(progress(3000, 10_000, 50.0), lambda: busy)
        live.on_progress(progress(5000, 10_000, 150.0), lambda: busy)
        told = ask(live.page.url, "jobs")
        assert told["title"] == "Walls"
        assert (told["count"], told["done"], told["failed"]) == (10_000, 4950, 50)
        assert told["busy"] == 20
        assert (told["points"], told["rays"]) == (4950 * 50, 4950 * 100)
        assert (told["rate"], told["left"]) == ("20 jobs/s", "4 min")
        assert told["names"] == ["height", "side"]
        assert [job["name"] for job in told["ended"]] == [f"{4999 - k}" for k in range(ENDED_MOST)]
        assert told["ended"][0]["values"] == ["1.235", "left"]
        assert [job["error"] for job in told["failures"]] == ["no surface"] * FAILED_MOST
        assert len(told["under_way"]) == UNDER_WAY_MOST
        assert [told["under_way"][4][name] for name in ("stored", "scans")] == [4, 40]
        wait_for_charts(live, 1)
        assert not told["over"]


def test_its_user_stops_the_run_as_an_interrupt_does():
    with shown(3) as live:
        live.on_progress(progress(0, 3, 1.0), list)
        order = urllib.request.Request(f"{live.page.url}stop", method="POST")
        urllib.request.urlopen(order, timeout=LONG_S).close()
        assert ask(live.page.url, "jobs")["state"] == "stopping"
        with pytest.raises(KeyboardInterrupt):
            live.on_progress(progress(0, 3, 2.0), list)


@pytest.mark.parametrize("what", ["nothing", "job/7/state", "job/x/state", "other/7/state"])
def test_other_questions_have_no_answer(what):
    with shown(3) as live, pytest.raises(urllib.error.HTTPError, match="404"):
        ask(live.page.url, what)


def test_a_campaign_is_watched_to_its_end(tmp_path):
    states = set()
    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster,
        Client(cluster, set_as_default=False) as client,
        shown(6) as live,
    ):

        def look(_):
            told = ask(live.page.url, "jobs", newest=1)
            states.add(told["state"])
            assert told["done"] + told["failed"] <= 6

        campaign = Campaign(make, 6, keep="folder", title="Walls")
        output = DataSetOutput(tmp_path / "set", campaign)
        options = RunOptions(client=client, backend="numpy", folder=tmp_path / "set" / "run")
        run = Conductor(campaign, options, output, Screen(look), live)()
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
        points = ask(viewer, "points", colour="z", most=1_000_000)["arrays"]["rows"]
        done = {job["name"]: job["points"] for job in told["ended"]}
        assert len(points) == done[name]
        for page, script in ((live.page.url, b"jobs.js"), (viewer, b"page.js")):
            with urllib.request.urlopen(page, timeout=LONG_S) as file:
                assert script in file.read()
