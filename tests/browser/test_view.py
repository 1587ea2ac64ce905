"""A finished result, looked at, played and measured in a browser."""

import re
import threading
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace

import numpy as np
import pytest
from tests.spirals import COUNT, WET, spiral, spiral_view

from lidarfiles.picture_file import PictureContent, sensor_positions
from lidarpool import Actor, Mounted, Pose, Scene, Sensor, Survey, Track, box
from lidarpool.pages.downloads import downloads
from lidarpool.pages.live_page import LivePage
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import header
from lidarsim.columns.table import OBJECT, TABLE
from lidarsim.scene.animation import Animation
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.viewer.result_views import open_results
from lidarview.viewer.server import page_server
from lidarview.viewer.sharing import render_page
from lidarview.viewer.view import View

pytestmark = [pytest.mark.browser, pytest.mark.slow]

PICTURE = "lidarpool.picture"


@pytest.fixture
def cloud(tmp_path):
    return spiral(tmp_path / "cloud.ply", WET)


@pytest.fixture
def view(cloud):
    return spiral_view(cloud)


@pytest.fixture
def served(view):
    with page_server(view.answer, port=0) as page:
        yield page


def opened(new_tab, page, link=""):
    """Open a page and wait until all its points are there."""
    tab = new_tab("about:blank")
    tab.call(
        "Emulation.setDeviceMetricsOverride", width=1280, height=720, deviceScaleFactor=1,
        mobile=False,
    )  # fmt: skip
    tab.open(page.url + link)
    tab.wait_for(lambda text: re.search(r"[\d,]+ points", text))
    return tab


def drawn(tab):
    """Count the points that are drawn."""
    return tab.value(f"{PICTURE}.drawn")


def test_view_shows_the_cloud_and_asks_nobody_else(served, new_tab, tmp_path):
    tab = opened(new_tab, served)
    tab.wait_for(lambda text: "30,000 points" in text and "z, m" in text)
    assert tab.value("document.title") == "a spiral"
    tab.wait_for(lambda _: colorful(tab.picture(tmp_path / "a.png")) > 3000)
    own = (served.url, "data:", "blob:")
    assert [request for request in tab.requests if not request.startswith(own)] == []
    tab.choose("color", "wetness")
    tab.wait_for(lambda text: "wetness, %" in text and "z, m" not in text)
    tab.choose("color", "hidden")
    tab.wait_for(lambda _: drawn(tab) == 0)
    assert tab.errors == []


def test_stations_are_numbered_and_a_place_is_told_in_the_coordinate_system(new_tab, tmp_path):
    scene = Scene.from_meshes([box("Room", (20, 20, 0.1))])
    survey = Survey(
        Sensor.grid(layers=4, rays_per_revolution=36),
        [Pose((-5, 0, 2)), Pose((5, 0, 2)), Pose((0, 6, 2))],
        epsg=25832,
    )
    rays = np.zeros((0, 2, 3), np.float32)
    hits = np.zeros(scene.triangles, np.int64)
    pictured = PictureContent(scene, sensor_positions(survey), hits, rays)
    sweeps = Sweeps.from_survey(survey, scene)
    view = View(CloudFile(spiral(tmp_path / "cloud.ply", WET), [WET]), pictured, sweeps)
    with page_server(view.answer, port=0) as page:
        tab = opened(new_tab, page)
        tab.wait_for(lambda _: drawn(tab) == COUNT)
        shown = "[...document.querySelectorAll('#labels .station')].map(label => label.textContent)"
        tab.wait_for(lambda _: tab.value(shown) == ["1", "2", "3"])
        tab.wait_for(lambda _: tab.value(f"!!{PICTURE}.surface"))
        place = "document.getElementById('place').textContent"
        assert tab.value(place) == "EPSG:25832"
        # On a point, then on the floor where no point is.
        for is_point in (True, False):
            found = "({ place: [1, 2, 3] })" if is_point else "null"
            tab.value(f"{PICTURE}.pick = () => {found}")
            tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=480 + is_point, y=250)
            tab.wait_for(lambda _: "x " in tab.value(place))
            told = tab.value(place)
            numbers = [float(number) for number in re.findall(r"-?[\d.]+(?= m)", told)]
            assert told.startswith("EPSG:25832")
            if is_point:
                assert numbers == [1, 2, 3]
                tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=1200, y=600)
                tab.wait_for(lambda _: tab.value(place) == "EPSG:25832")
            else:
                assert numbers[2] == 0.1 and max(map(abs, numbers[:2])) < 11
        assert tab.errors == []


def test_a_player_of_stations_counts_them(new_tab, tmp_path):
    scene = Scene.from_meshes([box("Room", (20, 20, 0.1))])
    poses = [Pose((5 * k, 0, 2)) for k in range(3)]
    survey = Survey(Sensor.grid(layers=4, rays_per_revolution=36), poses, steps=36)
    sweeps = Sweeps.from_survey(survey, scene)
    view = View(CloudFile(spiral(tmp_path / "cloud.ply", WET), [WET]), None, sweeps)
    with page_server(view.answer, port=0) as page:
        tab = opened(new_tab, page)
        tab.wait_for(lambda text: "station 1 of 3" in text and " s ·" not in text)
        tab.key("ArrowRight")
        tab.wait_for(lambda text: "station 2 of 3" in text and 0 < drawn(tab) < COUNT)
        slider = "document.querySelector('#time .line input')"
        assert tab.value(f"[{slider}.min, {slider}.max, {slider}.value]") == ["0", "2", "1"]
        tab.key(" ")
        tab.wait_for(lambda text: "station 3 of 3" in text)
        tab.key(" ")
        tab.choose("color", "station")
        tab.wait_for(lambda text: all(f"station {k}\n" in text for k in (1, 2, 3)))
        assert tab.errors == []


# Largest distance from the middle of the picture, 1 at its sides, of points {x, y, z, …}.
FARTHEST = """((places) => {
  const m = lidarpool.picture.matrix.elements;
  let most = 0;
  for (let k = 0; k < places.length; k += 3) {
    const [x, y, z] = places.subarray(k, k + 3), w = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (w <= 0) return Infinity;
    for (const axis of [0, 1]) {
      const clip = m[axis] * x + m[axis + 4] * y + m[axis + 8] * z + m[axis + 12];
      most = Math.max(most, Math.abs(clip) / w);
    }
  }
  return most;
})"""


@pytest.mark.parametrize("size", [(1400, 900), (390, 844)])
def test_a_flight_opens_with_all_of_its_site_and_a_cloud_with_its_sides(new_tab, tmp_path, size):
    scene = Scene.from_meshes([box("Ground", (40, 30, 6))])
    flown = Track([0, 2], [[-20, 5, 60], [20, 5, 60.0]])
    survey = Survey(Sensor.grid(layers=4), steps=360, trajectory=flown)
    content, _ = PictureContent.before_casting(scene, survey)
    file = CloudFile(spiral(tmp_path / "cloud.ply", WET), [WET])
    corners = "lidarpool.state.arrays.corners"
    for view, places in (
        (View(file, content, Sweeps.from_survey(survey, scene)), corners),
        (
            View(file),
            "Object.values(lidarpool.picture.layers)[0].geometry.attributes.position.array",
        ),
    ):
        with page_server(view.answer, port=0) as page:
            tab = new_tab("about:blank")
            tab.resize(*size)
            tab.open(page.url)
            tab.wait_for(lambda _, tab=tab: tab.value(f"window.{PICTURE}?.drawn") == COUNT)
            assert 0.8 < tab.value(f"{FARTHEST}({places})") < 1


def test_a_player_of_several_sensors_stops_once_at_each_time(new_tab, tmp_path):
    """The second sensor starts 0.3 ms later, and its sweeps belong to the same stops."""
    scene = Scene.from_meshes([box("Room", (20, 20, 0.1))])
    late = replace(Sensor.grid(layers=4), start_ns=300_000.0)
    front = Mounted(Sensor.grid(layers=4), name="front")
    sensors = [front, Mounted(late, Pose((-2, 0, 0)), name="rear")]
    track = Track([0, 1], [[0, 0, 2], [8, 0, 2.0]])
    survey = Survey(sensors=sensors, trajectory=track, steps=144)
    content, _ = PictureContent.before_casting(scene, survey)
    sweeps = Sweeps.from_survey(survey, scene)
    view = View(CloudFile(spiral(tmp_path / "cloud.ply", WET), [WET]), content, sweeps)
    with page_server(view.answer, port=0) as page:
        tab = opened(new_tab, page)
        told = []
        for number in range(1, 5):
            at = f"sweep {number} of 4"
            tab.wait_for(lambda text, at=at: at in text)
            told.append(tab.value("document.querySelector('#time .now').textContent"))
            tab.key("ArrowRight")
        assert [words.split(" s")[0] for words in told] == ["0.000", "0.100", "0.200", "0.300"]
        assert tab.value("lidarpool.steps[1]") == pytest.approx(0.1003)
        assert tab.errors == []


def test_pages_that_are_opened_during_and_after_a_run_are_alike(view, new_tab, tmp_path):
    live = LivePage(1, (), "a spiral")
    during = View(view.points, view.pictured)
    ended = threading.Event()

    def answer(question, arguments, is_disconnected):
        shown = view if ended.is_set() else during
        if question != "news":
            header, arrays = shown.answer(question, arguments, is_disconnected)
            live_header = {"live": True, "sampled": False, "title": "a spiral"}
            return header | (live_header if question == "state" else {}), arrays
        if ended.is_set() and not live._status.over:
            live.finish(3.0)
        header, _ = live.answer("jobs", {}, is_disconnected)
        versions = {"rays_version": 1, "hits_version": 1, "version": shown.version}
        ends = {"ends": int(ended.is_set()), "path": None, "time": None, "points": COUNT}
        return header | versions | ends, {"rays": shown.displayed_rays}

    shown_now = (
        "[...lidarpool.picture.camera.position.toArray().map((value) => value.toFixed(6)), "
        "lidarpool.chosen.show, document.querySelector('#panel').innerText.split('slots')[0], "
        "document.querySelector('#labels').innerText]"
    )
    with page_server(answer, port=0) as page:
        early = opened(new_tab, page)
        early.wait_for(lambda text: "30,000 points" in text)
        ended.set()
        early.wait_for(lambda text: "done" in text and "sweep 1 of 10" in text)
        late = opened(new_tab, page)
        late.wait_for(lambda text: "done" in text and "sweep 1 of 10" in text)
        expected = late.wait_for(lambda _: late.value(shown_now))
        found: list[object] = []
        same = time.monotonic() + 20
        while found != expected and time.monotonic() < same:
            found = early.value(shown_now)
        assert found == expected
        assert early.errors == late.errors == []


def test_a_server_that_is_busy_at_first_is_asked_again(view, new_tab):
    asked = []

    def answer(question, *arguments):
        asked.append(question)
        if asked.count(question) < 3:
            raise OSError("not yet")
        return view.answer(question, *arguments)

    with page_server(answer, port=0) as page:
        tab = opened(new_tab, page)
        tab.wait_for(lambda text: "30,000 points" in text and drawn(tab) == COUNT)


def test_a_question_that_fails_is_named(view, new_tab):
    def answer(question, *arguments):
        if question == "surface":
            raise OSError("the disk is gone")
        return view.answer(question, *arguments)

    with page_server(answer, port=0) as page:
        tab = opened(new_tab, page)
        words = 'The request "surface" failed (500 Internal Server Error).'
        tab.wait_for(lambda text: words in text)
        assert drawn(tab) == COUNT


def test_a_page_that_loads_says_so_and_its_heading_is_whole(view, new_tab):
    name = "a survey of the long hall, the yard behind it and the road to the harbour"
    asked = threading.Event()

    def answer(question, *arguments):
        if question == "points":
            assert asked.wait(60)
        return view.answer(question, *arguments)

    view.title = f"{name} - lidarpool"
    with page_server(answer, port=0) as page:
        tab = new_tab("about:blank")
        tab.resize(1280)
        tab.open(page.url)
        tab.wait_for(lambda text: "Loading points …" in text)
        asked.set()
        tab.wait_for(lambda text: "30,000 points" in text and "Reading" not in text)
    heading = "document.querySelector('#panel h1')"
    assert tab.value(f"{heading}.textContent") == name
    assert tab.value(f"{heading}.scrollWidth <= {heading}.clientWidth")


def test_points_in_their_own_colors(new_tab, tmp_path):
    kinds = [*((axis, "<f4") for axis in "xyz"), *((c, "|u1") for c in ("red", "green", "blue"))]
    rows = np.zeros(40_000, kinds)
    rows["x"], rows["y"] = np.random.default_rng(0).uniform(-9, 9, (2, 40_000))
    rows["red"], rows["blue"] = 255 * (rows["x"] < 0), 255 * (rows["x"] > 0)
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())
    with page_server(View(CloudFile(path)).answer, port=0) as page:
        tab = opened(new_tab, page)
        tab.tick("depth shading", on=False)
        tab.key("t")
        tab.choose("color", "rgb")
        tab.wait_for(lambda text: "z, m" not in text)

        def halves(_):
            picture = tab.picture(tmp_path / "a.png").astype(int)
            red = picture[..., 0] - picture[..., 2:].max(axis=2) > 150
            blue = picture[..., 2] - picture[..., :2].max(axis=2) > 150
            enough = min(red.sum(), blue.sum()) > 5000
            return enough and red.nonzero()[1].mean() < blue.nonzero()[1].mean()

        tab.wait_for(halves)
        other = opened(new_tab, page, "#color=rgb")
        other.wait_for(lambda _: other.value("lidarpool.chosen.color") == "rgb")
        assert tab.errors == other.errors == []


def test_a_look_at_all_fills_the_picture_and_the_sensor_can_be_seen(served, new_tab):
    tab = opened(new_tab, served)
    tab.wait_for(lambda _: drawn(tab) == COUNT)
    for key in "atsf":
        tab.key(key)
        tab.value(f"{PICTURE}.updateCamera()")
        most = tab.value(
            "(({ corners, camera }) => Math.max(...corners.map((corner) => {"
            " const at = corner.clone().project(camera);"
            f" return Math.max(Math.abs(at.x), Math.abs(at.y)); }})))({PICTURE})"
        )
        assert most == pytest.approx(0.9, abs=0.01), key
    share = f"{PICTURE}.sensors[0].marker.scale.x / {PICTURE}.extent"
    tab.wait_for(lambda _: tab.value(share) == pytest.approx(0.0036))
    assert tab.errors == []


def test_play_shows_a_sweep_and_moves_on_and_the_arrows_step(served, new_tab):
    tab = opened(new_tab, served)
    tab.wait_for(lambda _: drawn(tab) == COUNT)
    tab.key("ArrowRight")
    tab.wait_for(lambda text: "sweep 2 of 10" in text and "3,000 points" in text)
    tab.wait_for(lambda _: drawn(tab) == 3000)
    assert tab.value("lidarpool.chosen.time") == pytest.approx(0.1, abs=1e-3)
    van = f"{PICTURE}.actors[0].mesh.position.x"
    assert tab.value(van) == pytest.approx(-9 + 1.8, abs=0.1)
    for key, sweep in (("ArrowRight", 3), ("End", 10), ("Home", 1)):
        tab.key(key)
        tab.wait_for(lambda text, sweep=sweep: f"sweep {sweep} of 10" in text)
    tab.key(" ")
    seen = set()
    while len(seen) < 8:  # of ten sweeps; a browser may be slow
        seen.add(tab.wait_for(lambda text: re.search(r"sweep (\d+) of 10", text))[1])
    tab.key(" ")
    assert not tab.value("lidarpool.playing")
    at = tab.value("lidarpool.chosen.time")
    assert -9 < tab.value(van) < 9
    tab.wait_for(lambda _: tab.value("lidarpool.chosen.time") == at)
    tab.click("Range image")
    image = "document.querySelector('#images canvas')"
    tab.wait_for(lambda _: (tab.value(f"{image}?.height") or 1) > 1)
    tab.tick("Sensor", False)
    tab.wait_for(lambda _: drawn(tab) == 0)
    assert tab.errors == []


def test_keys_work_wherever_the_focus_is_and_a_question_mark_shows_them(served, new_tab):
    tab = opened(new_tab, served)
    focus = "document.querySelector({!r}).focus({{ focusVisible: true }})"
    controls = ("#time .icon", "select", "input[type=checkbox]", "summary", "input[type=range]")
    boxes = "[...document.querySelectorAll('input[type=checkbox]')].map(box => box.checked)"
    before = tab.value(boxes)
    for number, control in enumerate(controls):
        tab.value(focus.format(control))
        tab.key("Home")
        tab.key("ArrowRight")
        tab.wait_for(lambda text: "sweep 2 of 10" in text)
        tab.key(" ")
        assert tab.value("lidarpool.playing"), control
        tab.key(" ")
        assert not tab.value("lidarpool.playing"), control
        if number % 2:  # a letter, too
            tab.key("t")
            assert tab.value(f"{PICTURE}.isParallel")
            tab.key("a")
    assert tab.value(boxes) == before
    tab.value(focus.format("input[type=checkbox]"))
    tab.key("Enter")
    assert tab.value(boxes)[0] != before[0]
    tab.key("?")
    tab.wait_for(lambda text: "play or pause" in text)
    tab.key(" ")
    assert not tab.value("lidarpool.playing"), "the page behind the list is left alone"
    tab.key("?")
    tab.wait_for(lambda text: "play or pause" not in text)
    text_field = (
        "document.body.append(Object.assign(document.createElement('input'), {id: 'text'}))"
    )
    tab.value(text_field)
    tab.value(focus.format("#text"))
    tab.key("?")
    assert "play or pause" not in tab.text and tab.errors == []


def test_the_range_image_is_off_and_filled_as_soon_as_it_is_on(served, new_tab):
    tab = opened(new_tab, served)
    assert tab.value("document.getElementById('images').hidden")
    tab.click("Range image")
    tab.wait_for(lambda _: (tab.value("document.querySelector('#images canvas')?.height") or 1) > 1)
    assert "30,000 points" in tab.text and tab.errors == []


def test_following_snaps_to_the_carrier_and_keeps_the_place_behind_it(served, new_tab):
    tab = opened(new_tab, served)
    tab.key("a")
    tab.click("Follow")
    beside = f"{PICTURE}.camera.position.clone().sub({PICTURE}.carrier).toArray()"
    x, y, z = at_start = tab.value(beside)
    assert abs(x) < 1e-6 and y < -1 and z > 0, "it drives along y"
    tab.key("End")
    tab.wait_for(lambda text: "sweep 10 of 10" in text)
    assert tab.value(beside) == pytest.approx(at_start, abs=1e-6)
    assert tab.value(f"{PICTURE}.carrier.y") > -2 and tab.errors == []


def test_an_object_fills_the_first_picture_and_no_rays_hide_it(view, new_tab):
    around = [[x, y, 2.0] for x in (-60, 60) for y in (-60, 60)]
    survey = Survey(Sensor.grid(layers=4), steps=9, poses=around)
    ends = np.array([[[60, 60, 2], [0, 0, 0]]] * 9, np.float32)
    scene = replace(view.pictured.scene, actors=())
    hits = np.zeros(scene.triangles, np.int64)
    pictured = PictureContent(scene, sensor_positions(survey), hits, ends)
    with page_server(View(view.points, pictured).answer, port=0) as page:
        tab = opened(new_tab, page)
        assert tab.value(f"{PICTURE}.viewHeight") < 40  # of an object of 20 m
        assert tab.value(f"{PICTURE}.rays.visible") is False
        tab.tick("sample rays", on=True)
        assert tab.value(f"{PICTURE}.rays.visible") and tab.errors == []


def test_points_are_clicked_at_measured_filtered_and_linked_to(served, new_tab, tmp_path):
    tab = opened(new_tab, served)
    tab.wait_for(lambda _: drawn(tab) == COUNT)
    place = (
        f"(k => {{ const p = {PICTURE}.layers.base.told.arrays.positions.subarray(3*k, 3*k+3);"
        f" const m = {PICTURE}.matrix.elements, c = {PICTURE}.canvas;"
        " const [x, y, w] = [0, 1, 3].map(r => m[r]*p[0] + m[r+4]*p[1] + m[r+8]*p[2] + m[r+12]);"
        " return [(x / w + 1) / 2 * c.clientWidth, (1 - y / w) / 2 * c.clientHeight]; })"
    )
    tab.key("a")
    for row, shift, words in ((10_000, False, "wetness"), (12_000, True, "distance")):
        tab.press(*tab.value(f"{place}({row})"), shift=shift)
        tab.wait_for(lambda text, words=words: re.search(rf"\b{words}\s\d", text))
    tab.open(served.url + "#filter=scan,100,149&color=wetness&camera=20,-20,9;0,0,4")
    tab.wait_for(lambda text: re.search("4,16. points of 30,000", text) and "wetness, %" in text)
    tab.key("t")  # from the top, without perspective
    tab.wait_for(lambda _: tab.value(f"{PICTURE}.isParallel"))
    tab.key("c")
    link = tab.wait_for(lambda _: tab.value("location.hash") if "link" in tab.text else None)
    other = opened(new_tab, served, tab.value("(history.state, location.hash)"))
    other.wait_for(lambda text: re.search("4,16. points of 30,000", text))
    assert "parallel" in link and other.value(f"{PICTURE}.isParallel")
    both = [one.value(f"{PICTURE}.camera.position.toArray()") for one in (tab, other)]
    assert both[0] == pytest.approx(both[1], abs=1e-2)
    assert tab.errors == other.errors == []


PLACE = (
    f"(k => {{ const p = {PICTURE}.layers.base.told.arrays.positions.subarray(3*k, 3*k+3);"
    f" const m = {PICTURE}.matrix.elements, c = {PICTURE}.canvas;"
    " const [x, y, w] = [0, 1, 3].map(r => m[r]*p[0] + m[r+4]*p[1] + m[r+8]*p[2] + m[r+12]);"
    " return [(x / w + 1) / 2 * c.clientWidth, (1 - y / w) / 2 * c.clientHeight]; })"
)


@pytest.mark.parametrize("width", [1280, 420])
def test_distances_angles_and_areas_are_measured_with_mouse_and_fingers(served, new_tab, width):
    tab = opened(new_tab, served)
    tab.call(
        "Emulation.setDeviceMetricsOverride", width=width, height=720, deviceScaleFactor=1,
        mobile=width == 420,
    )  # fmt: skip
    shown_width = f"{PICTURE}.renderer.domElement.width"
    tab.wait_for(lambda _: drawn(tab) == COUNT and tab.value(shown_width) in (420, 980))
    tab.wait_for(lambda _: (tab.value(shown_width) == 420) == (width == 420))
    tab.key("t")  # all points can be seen
    rows = (29_000, 28_000, 27_000)  # 60 degrees of a circle apart, with a radius of 9 m

    def press(x, y):
        if width == 1280:
            tab.press(x, y)
            return
        for kind, points in (("touchStart", [{"x": x, "y": y}]), ("touchEnd", [])):
            tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    turns = 20 * np.pi * np.array(rows) / (COUNT - 1)
    places = np.stack([9 * np.cos(turns), 9 * np.sin(turns), turns / 8], axis=1)
    sides = places - places[[1, 2, 0]]
    cosine = -sides[0] @ sides[1] / np.prod(np.linalg.norm(sides[:2], axis=1))
    values = {
        2: np.linalg.norm(sides[0]),
        3: np.degrees(np.arccos(cosine)),
        4: np.linalg.norm(np.cross(sides[0], sides[1])) / 2,
    }
    words = "document.querySelector('#measured b').textContent"
    for tool, value in values.items():
        tab.value(f"document.querySelectorAll('#tools button')[{tool - 1}].click()")
        for row in rows[: 2 if tool == 2 else 3]:
            press(*tab.value(f"{PLACE}({row})"))
        told = tab.wait_for(lambda _: re.search(r" ([\d.]+) (m|°|m²)$", tab.value(words) or ""))
        assert float(told[1]) == pytest.approx(value, rel=0.02), (tool, told[0])
    link = tab.wait_for(
        lambda _: re.search(
            "measure=area(%3B[^%]+%2C[^%]+%2C[^%&]+){3}", tab.value("location.hash")
        )
    )
    other = opened(new_tab, served, "#" + link[0])
    again = other.value(words).split()[1]
    assert float(again) == pytest.approx(values[4], rel=0.02), "the link has the measurement"
    press(5, 700 if width == 1280 else 300)
    tab.key("Escape")
    tab.wait_for(lambda _: tab.value("document.getElementById('measured').hidden"))
    assert tab.errors == other.errors == []


def test_color_limits_are_set_by_hand_and_the_clip_box_is_dragged(served, new_tab):
    tab = opened(new_tab, served, "#color=wetness")
    inputs = "document.querySelectorAll('.limits input')"
    tab.wait_for(lambda _: tab.value(f"{inputs}.length") == 2)
    low = f"{inputs}[0]"
    tab.value(f"{{ const low = {low}; low.value = 50; low.onchange(); }}")
    tab.wait_for(lambda text: re.search(r"50\s+75\s+100", text))
    first = f"[...{PICTURE}.layers.base.told.arrays.colors.slice(0, 4)]"
    colors = {str(tab.value(first))}
    assert tab.value(f"{PICTURE}.layers.base.told.legend.limits[0]") == 50
    tab.key("f")  # from the front, z is up in the picture
    tab.key("b")
    handles = "document.querySelectorAll('#handles button')"
    top = f"[...{handles}].find(one => one.ariaLabel === 'clip box, z, highest')"
    tab.wait_for(lambda _: tab.value(f"{handles}.length") == 6)
    corner = f"(({{ x, y }}) => [x + 14, y + 14])({top}.getBoundingClientRect())"
    x, y = tab.value(corner)
    for kind, shift in (("mousePressed", 0), ("mouseMoved", 60), ("mouseReleased", 60)):
        tab.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y + shift, button="left", buttons=1,
            clickCount=1,
        )  # fmt: skip
    cut = tab.wait_for(lambda _: tab.value("lidarpool.chosen.clip[2][1]"))
    assert 0 < cut < 8
    tab.value(f"{top}.focus()")
    tab.key("ArrowUp")
    assert tab.value("lidarpool.chosen.clip[2][1]") > cut
    link = tab.wait_for(
        lambda _: (
            "limits=50%2C" in (link := tab.value("location.hash")) and "box=true" in link and link
        )
    )
    other = opened(new_tab, served, link)
    other.wait_for(lambda text: re.search(r"50\s+75\s+100", text))
    assert {str(other.value(first))} == colors
    assert other.value(f"{handles}.length") == 6
    tab.click("Auto")
    tab.wait_for(lambda text: re.search(r"\n1\s+50\s+100", text))
    assert tab.errors == other.errors == []


def test_a_click_beside_all_points_is_answered(served, new_tab):
    tab = opened(new_tab, served)
    tab.key("t")
    tab.press(800, 600)
    tab.wait_for(lambda text: "There is no point here." in text)
    assert tab.errors == []


def test_a_drive_opens_behind_its_carrier_above_it_and_looks_ahead(served, new_tab):
    tab = opened(new_tab, served)  # it drives along y, 4 m up
    x, y, z = tab.value(f"{PICTURE}.camera.position.toArray()")
    towards = tab.value(f"{PICTURE}.controls.target.toArray()")
    assert abs(x) < 1e-6 and y < -9 < towards[1] and z > 4
    assert (tab.value("lidarpool.chosen.time"), tab.value(f"{PICTURE}.carrier.y")) == (0, -9)
    assert not tab.value(f"{PICTURE}.rays?.visible")
    tab.key("a")
    tab.key("c")
    link = tab.wait_for(lambda _: tab.value("location.hash"))
    other = opened(new_tab, served, link)
    both = [one.value(f"{PICTURE}.camera.position.toArray()") for one in (tab, other)]
    assert both[0] == pytest.approx(both[1], abs=1e-2), "a link has its own camera"


def test_walls_before_points_are_faint_until_a_user_wants_otherwise(view, new_tab, tmp_path):
    wall = Scene.from_meshes([box("Wall", (24, 24, 12))])  # around all points
    view.pictured = replace(view.pictured, scene=wall, hit_counts=np.zeros(12, np.int64))
    with page_server(view.answer, port=0) as page:
        tab = opened(new_tab, page, "#camera=0,-60,30;0,0,4&clip=,;,;,")
        tab.wait_for(lambda _: colorful(tab.picture(tmp_path / "a.png")) > 3000)
        set_opacity = (
            "const row = [...document.querySelectorAll('.row')].find(r =>"
            " r.firstChild.textContent === 'opacity').querySelector('input');"
        )
        tab.value(f"{{ {set_opacity} row.value = 1; row.oninput(); }}")
        tab.wait_for(lambda _: colorful(tab.picture(tmp_path / "b.png")) < 300)
        tab.value(f"{{ {set_opacity} row.value = 0; row.oninput(); }}")
        tab.wait_for(lambda _: colorful(tab.picture(tmp_path / "c.png")) > 3000)
        assert tab.errors == []


def test_in_a_narrow_window_the_panel_is_a_drawer_and_nothing_overlaps(served, new_tab):
    tab = opened(new_tab, served)
    hidden = "getComputedStyle(document.getElementById('panel')).display === 'none'"
    across = "(id => { const b = document.getElementById(id).getBoundingClientRect();"
    across += " return [b.left, b.right]; })"
    assert not tab.value(hidden)
    tab.key("h")
    assert tab.value(hidden) and tab.value(f"{across}('canvas')") == [0, 1280]
    tab.value("document.querySelector('#open button').click()")
    assert not tab.value(hidden) and tab.value(f"{across}('canvas')") == [0, 980]
    narrow = {"width": 420, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    tab.call("Emulation.setDeviceMetricsOverride", **narrow)
    tab.wait_for(lambda _: tab.value(hidden))
    assert tab.value(f"{across}('time')") == tab.value(f"{across}('canvas')") == [0, 420]
    wide = "[...document.querySelectorAll('#time *')].every(one =>"
    assert tab.value(f"{wide} one.getBoundingClientRect().right <= 420)")
    tab.key("h")
    assert tab.value(f"{across}('panel')") == [120, 420]
    top = "document.elementFromPoint(270, 780)"
    assert tab.value(f"document.getElementById('panel').contains({top})"), "it is above the player"
    tab.value("document.querySelector('#panel header button[title^=\"Hide\"]').click()")
    assert tab.value(hidden) and tab.errors == []


@pytest.fixture
def classed(view):
    """Serve the spiral with classes, of which 1 is known as a car, as is the van."""
    told = view.answer

    def answer(what, asked, gone):
        header, arrays = told(what, asked, gone)
        if what == "state":
            header["classes"] = {"1": "car"}
            header["actors"][0]["class"] = 1
        return header, arrays

    rows = view.points
    view.columns["class"] = TABLE["class"]
    # A spiral has no classes, and a view takes columns only from its file.
    view._colored["class"] = TABLE["class"]
    values = rows.values
    rows.values = lambda name, some: (
        (values("scan", some) > 179).astype(np.uint16) if name == "class" else values(name, some)
    )
    with page_server(answer, port=0) as page:
        yield page


def test_a_legend_of_classes_has_names_and_is_used_by_keyboard(classed, new_tab):
    tab = opened(new_tab, classed, "#color=class")
    tab.wait_for(lambda text: re.search(r"class 0\s+15,000\s+car\s", text))
    tab.value("document.querySelectorAll('.legend button')[1].focus({ focusVisible: true })")
    press = {"key": "Enter", "code": "Enter", "text": "\r", "windowsVirtualKeyCode": 13}
    for kind in ("keyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, **press)
    tab.wait_for(lambda text: "15,000 points of 30,000" in text)
    pressed = "document.querySelectorAll('.legend button[aria-pressed=true]').length"
    assert tab.wait_for(lambda _: tab.value(pressed)) == 1
    tab.value("document.querySelector('.legend button[aria-pressed=true]').click()")
    box = "document.querySelector('.legend input[aria-label=\"show car\"]')"
    tab.wait_for(lambda text: "30,000 points" in text and text.count("15,000") == 2)
    tab.value(f"{box}.click()")
    tab.wait_for(lambda text: "15,000 points of 30,000" in text)
    assert "class: without car" in tab.value("document.body.textContent")
    assert tab.value(f"{box}.checked") is False
    assert tab.value("document.querySelectorAll('.legend li').length") == 2
    tab.wait_for(lambda _: "filter=%21class%2C1%2C1" in tab.value("location.hash"))
    tab.value(f"{box}.click()")
    tab.wait_for(lambda text: "30,000 points\n" in text)
    assert tab.errors == []


def test_actors_have_boxes_and_names_at_the_time_until_they_are_switched_off(classed, new_tab):
    tab = opened(new_tab, classed)
    tab.key("t")
    tab.wait_for(lambda text: "Van · car" in text)
    box_of = f"{PICTURE}.actors[0].box"
    assert tab.value(f"{box_of}.visible && {box_of}.parent === {PICTURE}.actors[0].mesh")
    before = tab.value(f"{box_of}.getWorldPosition({PICTURE}.middle.clone()).x")
    tab.key("ArrowRight")
    moved = f"{box_of}.getWorldPosition({PICTURE}.middle.clone()).x"
    assert tab.wait_for(lambda _: tab.value(moved) - before) == pytest.approx(1.8, abs=0.1)
    tab.tick("boxes and names", on=False)
    tab.wait_for(lambda text: "Van" not in text)
    assert not tab.value(f"{box_of}.visible") and tab.errors == []


def test_several_results_have_a_switch(cloud, new_tab, tmp_path):
    (tmp_path / "other.ply").write_bytes(cloud.read_bytes())
    with page_server(open_results([cloud, tmp_path / "other.ply"]).answer, port=0) as page:
        tab = opened(new_tab, page)
        tab.wait_for(lambda text: "60,000 points" in text and "cloud.ply\nother.ply" in text)
        assert tab.value("lidarpool.chosen.color") == "result"
        for pressed in ("[true,false]", "[false,true]"):
            tab.key("r")
            tab.wait_for(lambda text: "30,000 points of 60,000" in text)
            on = "[...document.querySelectorAll('.legend button')].map(b => b.ariaPressed)"
            assert tab.value(f"JSON.stringify({on})").replace('"', "") == pressed
        tab.key("r")
        tab.wait_for(lambda text: "60,000 points" in text)
        tab.click("other.ply")
        tab.wait_for(lambda text: "30,000 points of 60,000" in text)
        assert tab.errors == []


def test_the_points_that_are_filtered_and_clipped_are_downloaded(view, new_tab, tmp_path):
    view.downloads = downloads()
    with page_server(view.answer, port=0) as page:
        check_download(new_tab, page, tmp_path)


def check_download(new_tab, page, tmp_path):
    tab = opened(new_tab, page, "#filter=scan,100,299&clip=,;,;,3&color=wetness")
    tab.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path / "kept"))
    summaries = "[...document.querySelectorAll('summary')]"
    tab.value(f"{summaries}.find(one => one.textContent === 'Export').click()")
    tab.choose("format", "ply")
    tab.click("Download")
    file = tmp_path / "kept" / "cloud.ply"
    tab.wait_for(lambda _: file.exists())
    kept = CloudFile(file, [WET])
    scans, z = (kept.values(name, slice(None)) for name in ("scan", "z"))
    assert len(kept) > 1000 and scans.min() == 100 and z.max() <= 3 < z.max() + 0.01
    assert tab.errors == []


def test_what_is_cut_off_is_not_drawn(served, new_tab, tmp_path):
    tab = opened(new_tab, served)
    before = tab.wait_for(lambda _: max(0, colorful(tab.picture(tmp_path / "a.png")) - 3000))
    tab.value(f"{PICTURE}.setClip([[null, null], [null, null], [null, -1]])")
    tab.wait_for(lambda _: colorful(tab.picture(tmp_path / "b.png")) < before / 2)


def test_each_browser_is_dark_where_its_system_is_until_its_user_wants_otherwise(
    served, new_tab, tmp_path
):
    theme = "document.documentElement.dataset.theme"
    for name, other in (("light", "dark"), ("dark", "light")):
        tab = new_tab("about:blank")
        media = [{"name": "prefers-color-scheme", "value": name}]
        tab.call("Emulation.setEmulatedMedia", features=media)
        tab.open(served.url)
        tab.wait_for(lambda text: "30,000 points" in text)
        assert tab.value(theme) == name
        tab.wait_for(lambda _, tab=tab: colorful(tab.picture(tmp_path / "a.png")) > 3000)
        corner = tab.picture(tmp_path / "a.png")[5:40, 300:335].mean()
        assert (corner > 200) == (name == "light")
        tab.value(
            "document.querySelector('button[title=\"Switch between light and dark mode\"]').click()"
        )
        assert tab.value(theme) == other
        tab.value("localStorage.clear()")


def test_the_page_says_that_its_server_has_ended(view, new_tab):
    with page_server(view.answer, port=0) as page:
        tab = opened(new_tab, page)
        tab.wait_for(lambda _: drawn(tab) == COUNT)
    tab.key("ArrowRight")
    tab.wait_for(lambda text: "server for this page has stopped" in text)


def test_actors_deform_with_the_time(view, new_tab, tmp_path):
    """Two of one mesh, each in its pose: of the server's page and of an exported one."""
    bar = box("Bar", (1, 1, 1))
    tall = np.stack([bar.vertices * [1, 1, high] for high in (1, 3, 2, 1)])
    animations = [Animation(tall, 0.2, repeat=repeat) for repeat in (True, True, False)]
    animations[1] = animations[0]
    ways = [Track([0, 2], [[x, 0, 0], [x + 4, 0, 0.0]]) for x in (-5, 0, 5)]
    actors = tuple(
        Actor(replace(bar, animation=animation), way, offset)
        for animation, way, offset in zip(animations, ways, (0, 0.25, 0), strict=True)
    )
    scene = replace(view.pictured.scene, actors=actors)
    cloud = CloudFile(spiral(tmp_path / "objects.ply", OBJECT))
    view = replace(view, points=cloud, pictured=replace(view.pictured, scene=scene))
    (tmp_path / "page.html").write_bytes(render_page(view))
    with page_server(view.answer, port=0) as page:
        for url in (page.url, (tmp_path / "page.html").as_uri()):
            tab = opened(new_tab, SimpleNamespace(url=url))
            for seconds in (0.1, 0.3, 0.65, 0.95):
                tab.value(f"{PICTURE}.setTime({seconds})")
                for number, actor in enumerate(actors):
                    mesh = f"{PICTURE}.actors[{number}].mesh"
                    found = tab.value(f"[...{mesh}.geometry.attributes.position.array]")
                    placed = np.reshape(found, (-1, 3)) + tab.value(f"{mesh}.position.toArray()")
                    shown = actor.mesh_at(1e9 * seconds)
                    np.testing.assert_allclose(
                        placed, shown.vertices[shown.faces].reshape(-1, 3), atol=1e-5
                    )
            assert tab.errors == []


def colorful(picture):
    """Count the pixels left of the panel that are of a color."""
    part = picture[60:560, 80:900].astype(int)
    return int((part.max(axis=2) - part.min(axis=2) > 60).sum())


class Foreign(BaseHTTPRequestHandler):
    """Serve an empty page without a content policy."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><body>")

    def log_message(self, *_):
        """Log nothing."""


@pytest.fixture
def foreign_page():
    """Serve a page of another server; return its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), Foreign) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


def test_no_page_of_another_server_frames_it_and_it_frames_no_other(served, foreign_page, new_tab):
    frame = "document.body.append(Object.assign(document.createElement('iframe'), {src: '%s'}))"
    for outer, inner, directive in (
        (foreign_page, served.url, "frame-ancestors"),
        (served.url, foreign_page, "frame-src"),
    ):
        tab = new_tab(outer)
        tab.wait_for(lambda _, tab=tab: tab.value("document.readyState") == "complete")
        tab.value(frame % inner)
        tab.wait_for(lambda _, tab=tab, name=directive: any(name in text for text in tab.errors))


def test_an_exported_page_opens_from_disk_and_asks_nobody(view, new_tab, tmp_path):
    path = tmp_path / "page.html"
    path.write_bytes(render_page(view))
    file = SimpleNamespace(url=path.as_uri())
    tab = opened(new_tab, file)
    tab.wait_for(lambda text: "30,000 points" in text and "z, m" in text)
    assert tab.value("lidarpool.state.actors[0].name") == "Van"
    tab.wait_for(lambda _: colorful(tab.picture(tmp_path / "a.png")) > 3000)
    own = (file.url, "data:", "blob:")
    assert [request for request in tab.requests if not request.startswith(own)] == []
    tab.key("ArrowRight")  # one sweep of ten
    tab.wait_for(lambda _: drawn(tab) == COUNT / 10)
    tab.key(" ")
    tab.wait_for(lambda _: tab.value("lidarpool.chosen.time") > 0.5)
    assert "Range image" not in tab.text
    link = "#filter=scan,100,149;z,2,2.5&color=wetness&scene=hits"
    other = opened(new_tab, file, link)
    kept = "1,21[56] points of 30,000"  # from z, 2 m to 2.5 m; the scans begin at 2.2 m
    other.wait_for(lambda text: re.search(kept, text) and "wetness, %" in text)
    other.wait_for(lambda _: other.value(f"{PICTURE}.surface?.material.vertexColors === true"))
    found = f"{PICTURE}.layers.base.told.arrays"
    other.value(f"{PICTURE}.pick = () => ({{ row: {found}.rows[0], place: [0, 0, 0] }})")
    other.press(400, 300)
    other.wait_for(lambda text: re.search(r"wetness\s\d+\.\d+ %", text) and "scan\t1" in text)
    assert tab.errors == other.errors == []
