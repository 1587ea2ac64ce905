"""A campaign, watched in a browser from its first job to its end."""

import re
import threading

import numpy as np
import pytest

from lidarpool import Campaign, Job, Scene, Sensor, Survey
from lidarpool.pages.live_page import live_page
from lidarpool.report.campaign_output import run_campaign
from lidarpool.run.cluster.connection import local_client
from lidarpool.run.options import RunOptions
from lidarpool.run.progress import Screen

pytestmark = [pytest.mark.browser, pytest.mark.slow]

COUNT = 8
FAILS = 3
DRAWN = """(() => {
  const page = document.querySelector('#frames iframe')?.contentDocument;
  return !!page && !page.getElementById('hint').textContent;
})()"""


def make(number, rng):
    height = float(rng.uniform(1, 3))
    if number == FAILS:
        raise ValueError("no such place")
    survey = Survey(Sensor.grid(), poses=[(0, 0, height)], steps=36)
    return Job(Scene.seed(), survey, values={"height": height})


def test_jobs_are_counted_listed_drawn_and_shown(new_tab, tmp_path):
    campaign = Campaign(make, COUNT, keep="folder", title="Heights")
    looked = threading.Event()
    ended = []
    with (
        local_client({"LIDAR": 5}, gpu_workers=1) as client,
        live_page(COUNT, campaign.names, "Heights", port=0, browser=False) as live,
    ):
        options = RunOptions(
            client=client, startup_timeout_s=120.0, folder=tmp_path / "set" / "run"
        )

        def hold(progress):
            """Stand still once a job is done, until the browser has shown it."""
            if progress.jobs_done > 1:  # one of them fails
                looked.wait(300)

        def drive():
            ended.append(run_campaign(tmp_path / "set", campaign, options, Screen(hold), live))

        tab = new_tab(live.page.url)
        tab.wait_for(lambda text: "Heights" in text and "starting" in text)
        run = threading.Thread(target=drive)
        run.start()
        try:
            tab.wait_for(lambda text: re.search(rf"[1-7] of {COUNT} jobs done", text))
            tab.wait_for(lambda text: "Points of job" in text)
        finally:
            looked.set()
            run.join(300)
        assert [row.number for row in ended[0].failed] == [FAILS]
        text = tab.wait_for(lambda text: f"{COUNT - 1} of {COUNT} jobs done" in text and text)
        assert "no such place" in text and "Running" not in text
        tab.wait_for(lambda text: "done" in text.split("\n")[1])
        tab.wait_for(lambda _: tab.value("document.querySelectorAll('#charts svg').length") == 2)
        tab.wait_for(lambda _: tab.value(DRAWN))
        links = "[...document.querySelectorAll('#jobs a')].map(link => link.href)"
        job = new_tab(tab.value(links)[-1])
        job.wait_for(lambda text: re.search(r"[1-9][\d,]* points", text))
        assert len(tab.value(links)) == COUNT - 1 and job.errors == []
        picture = tab.picture(tmp_path / "campaign.png")[60:400, 340:1240]
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100, "points of a job"
        assert tab.errors == []
        own = (live.page.url, "data:", "blob:", "about:")
        assert [request for request in tab.requests if not request.startswith(own)] == []
        tab.click("Close")
        tab.wait_for(lambda _: live.stopped.is_set())
