"""A data set, its list of jobs and the points of each, in a browser."""

import re

import pytest
from tests.drives import the_scene, the_sweeps, write_set

from lidarpool.live.job_list import JobList
from lidarview.viewer.server import page_server

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def test_jobs_of_a_data_set_are_listed_and_each_is_opened(new_tab, tmp_path):
    scene = the_scene()
    write_set(tmp_path / "set", "kitti", scene, the_sweeps(scene))
    with page_server(JobList(tmp_path / "set").answer, port=0, index="jobs.html") as page:
        tab = new_tab(page.url)
        tab.wait_for(lambda text: "5 of 6 jobs done" in text and "Points of job 00" in text)
        assert "failed" in tab.text and "go on to newer jobs" not in tab.text
        links = tab.value("[...document.querySelectorAll('#jobs a')].map(link => link.href)")
        assert len(links) == 5
        job = new_tab(links[1])
        job.wait_for(lambda text: re.search(r"[1-9][\d,]* points", text) and "sweep 1 of" in text)
        assert job.value("document.title") == "job 01 - set"
        assert tab.errors == job.errors == []
