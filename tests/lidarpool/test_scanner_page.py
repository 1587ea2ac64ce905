"""The page of a scanner, asked as a browser asks, and the cell of a notebook."""

import subprocess
import sys
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from tests.pages import ask

from lidarpool import show
from lidarsim import Actor, LidarError, Mounted, Pose, Scanner, Scene, Sensor, Track, box

SCRIPT = """
from lidarpool import Pose, Scanner, Scene, Sensor, show
scanner = Scanner(Scene.seed(), Sensor.grid(100, 4), backend="numpy")
view = show(scanner, to=":0")
view.show(scanner.sweep(Pose((0, 0, 1))), Pose((0, 0, 1)))
print(view.url)
"""


@pytest.fixture(scope="module")
def hall():
    """Return a scene far from zero, with an actor."""
    floor = box("Floor", (40, 40, 0.1)).affine_transform(
        "Floor", np.eye(3), np.array([5e5, 5e6, 0.0])
    )
    return Scene.from_meshes([floor]).with_actors([Actor(box("Car 1", (4, 2, 1.5)))])


def newest(view, version=0, **asked):
    """Return the news of a page and its points, once the points are of another version."""
    give_up_at = time.monotonic() + 20
    while (news := ask(view.url, "news"))["version"] <= version:
        assert time.monotonic() < give_up_at
        time.sleep(0.02)
    return news, ask(view.url, "points", color="z", most=100_000, **asked)


@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_the_page_shows_the_newest_sweep_its_sensor_and_its_actors(hall, coordinates, capsys):
    mount = Pose((0.5, 0, 0.4), yaw_deg=30)
    sensor = Mounted(Sensor.grid(200, 8), mount)
    scanner = Scanner(hall, sensor, columns=["range"], coordinates=coordinates, backend="numpy")
    with show(scanner, to=":0") as view:
        assert capsys.readouterr().err == f"The page is available at {view.url}\n"
        assert view.url.startswith("http://127.0.0.1:")
        state = ask(view.url, "state")
        assert state["state"] == "waiting for the first sweep"
        assert "columns" not in state
        pose = Pose((-1, 0.5, 1.5), yaw_deg=70)
        view.show(scanner.sweep(pose, number=0), pose)
        state = ask(view.url, "state")
        assert state["live"]
        assert state["points"] > 500
        assert [sensor["moves"] for sensor in state["sensors"]] == [True]
        assert [actor["name"] for actor in state["actors"]] == ["Car 1"]
        assert {"z", "range", "object"} <= {column["name"] for column in state["columns"]}
        scanner.move("Car 1", Pose((4, 2, 0), yaw_deg=90))
        pose = Pose((-3, 0.5, 1.5), yaw_deg=80)
        cloud = scanner.sweep(pose, number=1)
        view.show(cloud, pose)
        news, points = newest(view, state["version"])
    expected = Scanner(scanner.scene, sensor, backend="numpy").sweep(pose, number=1)
    local = expected.positions - scanner.origin
    assert len(cloud) == len(points["arrays"]["positions"])
    assert np.abs(points["arrays"]["positions"] - local).max() < 0.02
    assert np.allclose(news["arrays"]["actor_places"], [[4, 2, 0]])
    assert news["arrays"]["actor_there"].tolist() == [1]
    trail = news["arrays"]["sensor0_places"]
    assert np.allclose(trail[-1], pose.compose(mount).position)
    assert len(trail) == 2
    assert news["state"] == "sweep 2"


def test_several_scanners_share_a_page(hall):
    front, rear = (
        Scanner(hall, Sensor.grid(100, 4), name=name, columns=columns, backend="numpy")
        for name, columns in (("front", ["range"]), ("rear", []))
    )
    track = Track([0, 1], [(0, 0, 1), (2, 0, 1)])
    with show([front, rear], to=":0") as view:
        first = front.sweep(track, start_s=0.4)
        view.show(first, track, start_s=0.4)
        second = rear.sweep(Pose((0, 0, 2)))
        view.show(second, Pose((0, 0, 2)), scanner=rear)
        state = ask(view.url, "state")
        column = ask(view.url, "column", name="sensor")
        news = ask(view.url, "news")
        other = Scanner(hall, Sensor.grid(100, 4), name="side", backend="numpy")
        with pytest.raises(LidarError, match="does not show the scanner 'side'"):
            view.show(second, Pose((0, 0, 2)), scanner=other)
    assert state["points"] == len(first) + len(second)
    assert "range" not in {column["name"] for column in state["columns"]}
    assert [name for name, _ in column["labels"]] == ["front", "rear"]
    assert np.allclose(news["arrays"]["sensor0_places"], [[0.8, 0, 1]])
    assert np.allclose(news["arrays"]["sensor1_places"], [[0, 0, 2]])


def test_faults_are_one_line(hall):
    scanner = Scanner(hall, Sensor.grid(100, 4), backend="numpy")
    with show(scanner, to=":0") as view:
        port = view.url.split(":")[2].split("/")[0]
        with pytest.raises(LidarError, match=rf"127\.0\.0\.1:{port} cannot be used: .* in use\. "):
            show(scanner, to=f"127.0.0.1:{port}")
        address = view.url
        assert f'<iframe src="{address}"' in view._repr_html_()
    view.close()  # again
    with pytest.raises(LidarError, match=r"view is closed and cannot show further sweeps"):
        view.show(scanner.sweep(Pose((0, 0, 1))), Pose((0, 0, 1)))
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address, timeout=5)
    assert "iframe" not in view._repr_html_()
    with pytest.raises(LidarError, match=r"different names, such as .*are '', ''"):
        show([scanner, scanner])
    with pytest.raises(LidarError, match=r"scanner must be a list, but is 'vlp16'"):
        show("vlp16")


@pytest.mark.slow  # starts a process
def test_a_script_ends_though_its_page_is_open():
    ended = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0
    assert ended.stderr == f"The page is available at {ended.stdout}"
