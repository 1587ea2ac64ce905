"""Whatever `lidarpool view` opens, opened in a browser: a file of each kind, and lists of jobs."""

import re
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.drives import the_scene, the_sweeps, write_set
from tests.packet_surveys import points_of
from tests.shapes import room

from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.picture_file import PICTURE_FILE, PictureContent
from lidarpool import LidarError, Mounted, Pose, Survey, Track, load_sensor
from lidarpool.pages import opened, recorded
from lidarpool.pages.job_list import JobList
from lidarpool.pages.opened import growing_view, is_data_set, open_view
from lidarsim.sweeps.sweeps import SWEEPS_FILE
from lidarview.viewer.server import page_server

pytestmark = [pytest.mark.browser, pytest.mark.slow]

EXAMPLES = Path(__file__).parents[2] / "examples"
FORMATS = (
    "las", "laz", "pcd", "ply", "e57", "mcap", "rosbag2", "kitti", "nuscenes", "parquet",
    "webdataset", "pcap",
)  # fmt: skip
FILES = ("mesh.obj", "scenario.yaml", "robot.urdf", "result", "set")
SWEEPS = 2
PLAYED = ("pcd", "e57", "mcap", "rosbag2", "kitti", "nuscenes", "webdataset", "pcap", "result")
SCENARIO = """scene: mesh.obj
sensor: velodyne/vlp16
trajectory:
  points: [{time_s: 0, position: [3, 0, 1]}, {time_s: 0.1, position: [3.1, 0, 1]}]
"""


@pytest.fixture(scope="session")
def kinds(tmp_path_factory):
    """Return a folder with a file or folder of each kind, named by its format or as in `FILES`."""
    folder = tmp_path_factory.mktemp("kinds")
    sensors = [Mounted(load_sensor("vlp16"), Pose((0, 0, 0)), "roof")]
    track = Track([0, 0.2], [[0, 0, 0], [0.5, 0, 0]])
    columns = ["ray", "range", "intensity", "reflectivity", "time", "channel"]
    columns += ["azimuth", "elevation", "return_number", "returns", "object", "class"]
    survey = Survey(sensors=sensors, trajectory=track, columns=columns, keep_every=1)
    cloud, sweeps = points_of(survey, room())
    cloud = replace(cloud, sweeps=lambda: sweeps)
    for name in FORMATS:
        row = ExportSpec(name).row
        (folder / name).mkdir()
        try:
            ExportSpec(name).write(folder / name / row.file, cloud, sweeps)
        except LidarError:  # its package is missing, and so is its file
            shutil.rmtree(folder / name)
    (folder / "result").mkdir()
    ExportSpec("ply").write(folder / "result" / "cloud.ply", cloud, sweeps)
    sweeps.save(folder / "result" / SWEEPS_FILE)
    content, _ = PictureContent.before_casting(room(), survey, None)
    content.save(folder / "result" / PICTURE_FILE)
    scene = the_scene()
    write_set(folder / "set", "kitti", scene, the_sweeps(scene))
    shutil.copy(EXAMPLES / "car.obj", folder / "mesh.obj")
    shutil.copy(EXAMPLES / "rover.urdf", folder / "robot.urdf")
    (folder / "scenario.yaml").write_text(SCENARIO)
    return folder


def place_of(kinds, name):
    """Return the file or folder of a kind."""
    if name in FILES:
        return kinds / name
    path = kinds / name / ExportSpec(name).row.file
    return next(path.glob("*.pcap")) if name == "pcap" else path


def drawn(tab):
    """Return the number of points that are drawn, 0 before the page is ready."""
    return tab.value("window.lidarpool?.picture.drawn") or 0


def check_view(tab, view, name):
    """Check the page of a view: all points are drawn, and sweeps are played."""
    count = len(view.points)
    assert count > 300, name
    by_sweep = name == "pcap"  # which has no poses
    tab.wait_for(lambda _: drawn(tab) == count if not by_sweep else 0 < drawn(tab) < count)
    assert tab.value("[lidarpool.state.points, lidarpool.state.preview]") == [
        count,
        name in FILES[:3],
    ]
    if name in PLAYED:
        tab.key("ArrowRight")
        tab.wait_for(lambda text: f"sweep 2 of {SWEEPS}" in text and 0 < drawn(tab) < count)


def test_each_kind_of_file_is_opened(kinds, new_tab):
    tab = new_tab("about:blank")
    tab.resize(420, 300)
    for name in (*FILES, *FORMATS):
        if not (kinds / name).exists():
            continue
        path = place_of(kinds, name)
        assert is_data_set(path) == (name == "set")
        view = JobList(path) if name == "set" else open_view(path)
        index = "jobs.html" if name == "set" else "index.html"
        with page_server(view.answer, port=0, index=index) as page:
            tab.open(page.url)
            if name == "set":
                tab.wait_for(lambda text: "5 of 6" in text and "Points of job 00" in text)
            else:
                check_view(tab, view, name)
            tab.open("about:blank")  # asks nothing of a server that ends
    assert tab.errors == []


def test_labeled_boxes_are_shown_with_their_names_in_their_sweeps(tmp_path, new_tab):
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "label_2").mkdir()
    values = "0 0 0 1 2 3 4 1.5 1.8 4.2 -3 1.6 12 0.3"
    for number, kind in enumerate(("Car", "Van")):
        points = np.random.default_rng(number).uniform(-20, 20, (500, 4)) * (1, 1, 0, 0)
        points.astype("<f4").tofile(tmp_path / f"velodyne/{number:06}.bin")
        (tmp_path / f"label_2/{number:06}.txt").write_text(f"{kind} {values}\n")
    with page_server(open_view(tmp_path).answer, port=0) as page:
        tab = new_tab(page.url)
        tab.resize(900, 600)
        tab.wait_for(lambda text: drawn(tab) == 500 and "Car" in text and "Van" not in text, 20)
        tab.key("ArrowRight")
        tab.wait_for(
            lambda text: "sweep 2 of 2" in text and "Van" in text and "Car" not in text, 20
        )
        box = "lidarpool.picture.actors[0].box.geometry"
        tab.value(f"{box}.computeBoundingBox()")
        half = tab.value(f"{box}.boundingBox.max.toArray()")
        assert half == pytest.approx([2.1, 0.9, 0.75])
        tab.value("lidarpool.picture.showBoxes(false)")
        tab.wait_for(lambda text: "Van" not in text, 20)
        assert tab.errors == []
        tab.open("about:blank")


def test_a_large_cloud_is_drawn_by_a_sample_until_all_points_are_read(kinds, new_tab, monkeypatch):
    if not (kinds / "las").exists():
        pytest.skip("needs laspy")
    monkeypatch.setattr(recorded, "LARGE_POINTS", 1000)
    is_drawn = threading.Event()
    monkeypatch.setattr(
        opened, "open_view", lambda path, **_: is_drawn.wait(120) and open_view(path)
    )
    view = growing_view(place_of(kinds, "las"))
    with page_server(view.answer, port=0) as page:
        tab = new_tab(page.url)
        tab.wait_for(lambda text: drawn(tab) > 0 and "Loading points … 0 %" in text)
        tab.choose("color", "intensity")
        is_drawn.set()
        total = f"{view.total:,} points"
        tab.wait_for(lambda text: text.count(total) == 1 and drawn(tab) == view.total)
        tab.wait_for(lambda text: "Reading" not in text and "intensity" in text)
        assert tab.value("lidarpool.chosen.color") == "intensity" and tab.errors == []


def test_jobs_of_a_data_set_are_listed_and_each_is_opened(kinds, new_tab):
    with page_server(JobList(kinds / "set").answer, port=0, index="jobs.html") as page:
        tab = new_tab(page.url)
        tab.wait_for(lambda text: "5 of 6 jobs done" in text and "Points of job 00" in text)
        assert "failed" in tab.text and "switch to newer jobs automatically" not in tab.text
        links = tab.value("[...document.querySelectorAll('#jobs a')].map(link => link.href)")
        assert len(links) == 5
        job = new_tab(links[1])
        job.wait_for(lambda text: re.search(r"[1-9][\d,]* points", text) and "sweep 1 of" in text)
        assert job.value("document.title") == "job 01 - set"
        assert tab.errors == job.errors == []
