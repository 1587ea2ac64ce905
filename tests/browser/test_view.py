"""A finished result, looked at in a browser."""

import re
from dataclasses import replace

import numpy as np
import pytest

from lidarpool import Column, Scene, Track
from lidarpool.columns.table import SCAN
from lidarpool.export.cloud_file import CloudFile
from lidarpool.export.ply_format import header, row_type
from lidarpool.live.looking import Eye, Filter
from lidarpool.live.page import live_page, place_eye, redrawn
from lidarpool.live.result_page import ResultView
from lidarpool.run.picture_file import Pictured, SensorWay
from lidarpool.scene.actors import Actor, box

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture
def cloud(tmp_path):
    """Return a file with a spiral of 30,000 points in 300 scans."""
    turn = np.linspace(0, 20 * np.pi, 30_000)
    wet = Column("wetness", "float32", "%", "how wet it is", source="wetness")
    row = row_type(np.dtype(np.float32), (SCAN, wet))
    rows = np.zeros(30_000, row)
    rows["wetness"] = np.linspace(0, 100, 30_000)
    rows["x"], rows["y"], rows["z"] = 9 * np.cos(turn), 9 * np.sin(turn), turn / 8
    rows["scan"] = np.arange(30_000) // 100
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(row, 30_000) + rows.tobytes())
    return path


@pytest.fixture
def served(cloud):
    """Return a page that shows it, at most 20,000 points at a time, and the view."""
    with live_page("a cloud", port=0) as page:
        view = ResultView(page, CloudFile(cloud), most=20_000)
        with redrawn(view.draw, 0.1):
            yield page, view


def test_view_shows_the_cloud_and_asks_nobody_else(served, new_tab, tmp_path):
    page, view = served
    tab = new_tab(page.url)
    tab.wait_for(lambda text: "30,000 of 30,000 points, 20,000 shown" in text and "z, m" in text)
    tab.wait_for(lambda _: colourful(tab.picture(tmp_path / "a.png")) > 3000)
    picture = tab.picture(tmp_path / "a.png")
    assert len(np.unique(picture[:, :900].reshape(-1, 3), axis=0)) > 200
    own = (page.url, "data:", "blob:")
    assert [request for request in tab.requests if not request.startswith(own)] == []
    view._view.cloud.set_filter(Filter((("scan", 100, 149),)))
    tab.wait_for(lambda text: re.search(r"5,000 of 30,000 points, all\s+shown", text))
    view._view.cloud.colour.value = "wetness"
    tab.wait_for(lambda text: "wetness" in text and "z, m" not in text)
    tab.wait_for(lambda _: colourful(tab.picture(tmp_path / "b.png")) > 500)
    assert tab.errors == []


def test_time_is_chosen_and_played(cloud, new_tab, tmp_path):
    """A red sensor drives along y through the spiral, and a box along x."""
    way = SensorWay(np.array([0, 2e9]), np.array([[0, -9, 4], [0, 9, 4.0]]), True, "nose", "VLP-16")
    track = Track([0, 2], [[-9, 0, 8], [9, 0, 8]])
    scene = Scene.from_meshes([box("Floor", (20, 20, 0.1))])  # few triangles: browsers are slow
    scene = replace(scene, actors=(Actor(box("Van", (4, 2, 2)), track),))
    hits, rays = np.zeros(scene.triangles, np.int64), np.zeros((0, 2, 3), np.float32)
    pictured = Pictured(scene, [way], hits, rays, None, None, (), 2e9)
    with live_page("a drive", port=0) as page:
        view = ResultView(page, CloudFile(cloud), pictured)
        with redrawn(view.draw, 0.1):
            tab = new_tab(page.url)
            tab.wait_for(lambda text: "nose: VLP-16" in text and "time, s" in text)
            tab.click("Play")
            tab.wait_for(lambda text: "Pause" in text)
            van = page.scene.get_handle_by_name("/actors/0")
            tab.wait_for(lambda _: -8 < van.position[0] < 9)
            tab.click("Pause")
            tab.wait_for(lambda text: "Play" in text)
            tab.picture(tmp_path / "a.png")  # what was being drawn is drawn by now
            at = van.position[0]
            tab.picture(tmp_path / "b.png")
            assert van.position[0] == at
            assert tab.errors == []


def test_points_are_clicked_at_measured_seen_from_near_and_linked_to(served, new_tab, tmp_path):
    page, view = served
    tab = new_tab(page.url)
    tab.wait_for(lambda text: "20,000 shown" in text and "Click a point" in text)
    tab.wait_for(lambda _: colourful(tab.picture(tmp_path / "a.png")) > 3000)
    client = next(iter(page.get_clients().values()))
    eye = Eye.of(client.camera)
    wide, tall = client.camera.image_width, client.camera.image_height
    (start, end), _ = eye.seen(view._even.positions[[10_000, 12_000]] - view._view.origin)
    for shift, place, told in ((False, start, "wetness"), (True, end, "distance")):
        x, y = (place + 1) / 2 * (wide, tall)
        tab.press(x, y, shift=shift)
        tab.wait_for(lambda text, told=told: re.search(rf"\b{told} \d", text))
    # To the middle of the spiral, which has half of its points behind the camera then.
    place_eye(client, client.camera.look_at, client.camera.look_at + np.array([0.0, 1.0, 0.0]))
    tab.wait_for(lambda text: "more of them from near" in text)
    view._view.cloud.set_filter(Filter((("scan", 100, 149),)))
    tab.wait_for(lambda text: "5,000 of 30,000 points" in text)
    link = page.link(client, view._view.choices)
    view._view.cloud.set_filter(Filter())
    tab.wait_for(lambda text: "20,000 shown" in text)
    other = new_tab(link)
    other.wait_for(lambda text: "5,000 of 30,000 points" in text)
    newest = page.get_clients()[max(page.get_clients())].camera
    other.wait_for(lambda _: np.allclose(newest.position, client.camera.position, atol=1e-3))
    assert tab.errors == other.errors == []


def test_each_browser_is_dark_where_its_system_is_until_its_user_wants_otherwise(served, new_tab):
    page, _ = served
    scheme = "document.documentElement.dataset.mantineColorScheme"
    light, dark = new_tab("about:blank"), new_tab("about:blank")
    for tab, name in ((light, "light"), (dark, "dark")):
        media = [{"name": "prefers-color-scheme", "value": name}]
        tab.call("Emulation.setEmulatedMedia", features=media)
        tab.open(page.url)
        tab.wait_for(lambda text: "20,000 shown" in text)
    dark.wait_for(lambda _: dark.value(scheme) == "dark")
    assert light.value(scheme) == "light"
    for client in page.get_clients():
        page._dark[client].value = not page._dark[client].value
    dark.wait_for(lambda _: dark.value(scheme) == "light")
    light.wait_for(lambda _: light.value(scheme) == "dark")


def colourful(picture):
    """Count the pixels left of the panel that are of a colour."""
    part = picture[200:, :900].astype(int)
    return int((part.max(axis=2) - part.min(axis=2) > 60).sum())
