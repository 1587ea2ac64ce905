"""What a page shows of a finished result: its points, scene, sensors, sweeps and planning."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from matplotlib import colormaps

from lidarfiles.picture_file import (
    PICTURE_FILE,
    PictureContent,
    PlannedPath,
    PlanningPicture,
    SensorPositions,
    sensor_positions,
)
from lidarpool.pages.opened import open_views
from lidarsim import (
    Actor,
    Cloud,
    Column,
    LidarError,
    Material,
    Mounted,
    Pose,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Survey,
    Track,
    box,
)
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import header, row_type
from lidarsim.columns.table import CHANNEL, OBJECT, SCAN, TABLE, Z
from lidarsim.scene.colors import Colors, as_bytes
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarview.render.coloring import make_coloring
from lidarview.viewer import point_selection as points
from lidarview.viewer.display_mesh import DisplayMesh, available_colorings
from lidarview.viewer.legends import make_legend
from lidarview.viewer.point_selection import (
    TILES,
    BrowserCamera,
    ClientDisconnected,
    InMemoryPoints,
    PointFilter,
    PointFinder,
    parse_scans,
)
from lidarview.viewer.range_pictures import range_image
from lidarview.viewer.result_views import open_result, open_results, show_view
from lidarview.viewer.view import DownloadFormats, View

POSES = 25
NOWHERE = np.zeros((0, 3), np.float32)
ORIGIN = np.array([500_000.0, 100.0, 0.0])
ALL = 1_000_000


def write(path, positions, scans=100):
    """Write a cloud as a run does."""
    count = len(positions)
    row = row_type(np.dtype(np.float64), (SCAN, CHANNEL, OBJECT))
    rows = np.zeros(count, row)
    for axis, name in enumerate("xyz"):
        rows[name] = positions[:, axis]
    rows["scan"] = np.arange(count) * scans // max(1, count)
    rows["ring"] = np.arange(count) % 40
    path.write_bytes(header(row, count) + rows.tobytes())
    return path


def test_scans_are_chosen_and_thinned(tmp_path):
    x = np.arange(50_000) // 500
    file = CloudFile(write(tmp_path / "a.ply", np.column_stack([x, 0 * x, 0 * x])))
    assert (len(file), file.scans) == (50_000, (0, 99))
    first, stop = file.rows_of((20, 29))
    assert np.unique(x[first:stop]).tolist() == list(range(20, 30)) and stop - first == 5_000
    cloud = file.choose(4_000)
    assert len(cloud) == 4_000
    assert np.bincount(cloud["scan"]).min() >= 35
    assert np.bincount(cloud["channel"]).min() > 50
    assert np.array_equal(cloud.positions[:, 0], cloud["scan"])


def test_no_points_and_points_that_are_nowhere_are_no_reason_to_fail(tmp_path):
    nothing = CloudFile(write(tmp_path / "a.ply", np.zeros((0, 3))))
    assert (len(nothing), nothing.scans, len(nothing.choose(10))) == (0, (0, 0), 0)
    nowhere = CloudFile(write(tmp_path / "b.ply", np.full((1000, 3), np.nan)))
    assert len(nowhere.choose(1000)) == 0


def test_what_is_no_result_is_refused(tmp_path):
    for name, words in (
        ("", r"is not supported\..* Specify a result, data set"),
        ("nothing", "does not exist"),
        ("none.ply", "none.ply does not exist"),
        ("cut.ply", "cut.ply"),
        ("run", "Continue it with"),
    ):
        (tmp_path / "cut.ply").write_bytes(b"ply\n")
        (tmp_path / "run" / "run").mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / "run" / "run.db").touch()
        with pytest.raises(LidarError, match=words):
            show_view(open_views([tmp_path / name]), port=0, browser=False)


@pytest.fixture(scope="module")
def pictured():
    """Return a room with a roof, 6 by 8 by 3 meters, far from zero, scanned from 25 poses."""
    room = trimesh.creation.box(bounds=[(0, 0, 0), (6, 8, 3)])
    faces = np.int32(room.faces)
    scene = Scene(np.array(room.vertices), faces, np.zeros(12, np.int32), ("room",), ORIGIN)
    poses = np.column_stack([np.full(POSES, 3.0), np.linspace(1, 7, POSES), np.ones(POSES)])
    rays = np.stack([np.repeat(poses[:2], 9, axis=0), np.full((18, 3), 2.9)], axis=1)
    rays[:9, 1, 2] = 0.5
    return PictureContent(
        scene,
        (SensorPositions(np.arange(POSES), poses),),
        np.arange(12),
        rays.astype(np.float32),
        PlanningPicture(
            start=(1.0, 1.0),
            target=(5.0, 7.0),
            centers=np.array([[1.0, 6.0]]),
            radii=np.array([0.5]),
            best=PlannedPath(np.array([[1.0, 1.0], [5.0, 7.0]]), 7.2, 7.2, 1.0),
        ),
    )


def seen(scene, places, moves=False):
    """Return what is known of a survey of two seconds with one sensor."""
    way = SensorPositions(
        np.linspace(0, 2e9, len(places)), np.array(places, float), moves, "", "VLP-16"
    )
    hits = np.zeros(scene.triangles, np.int64)
    rays = np.zeros((0, 2, 3), np.float32)
    return PictureContent(scene, [way], hits, rays, duration_ns=2e9)


@pytest.fixture
def cloud(tmp_path):
    """Return a file of 10,000 points on the room's walls and ceiling."""
    local = np.random.default_rng(0).uniform((0, 0, 0), (6, 8, 3), (10_000, 3))
    local[::2, 0] = 0.0
    local[1::2, 2] = 3.0
    return write(tmp_path / "cloud.ply", local + ORIGIN)


def told(view, what, **asked):
    """Return what the page is told: (JSON, arrays)."""
    return view.answer(what, {name: str(value) for name, value in asked.items()}, lambda: False)


def places(view, **asked):
    """Positions (n, 3) of the points that the page is given, local."""
    return told(view, "points", **{"color": "z", "most": ALL, **asked})[1]["positions"]


def test_the_page_is_told_of_scene_sensors_rays_and_planning(cloud, pictured):
    view = View(CloudFile(cloud), pictured, title="a room")
    state, arrays = told(view, "state")
    assert (state["title"], state["points"]) == ("a room", 10_000)
    assert state["origin"] == ORIGIN.tolist()
    assert [*state["scene_colors"]] == ["gray", "hits", "object", "normals"]
    assert arrays["sensor0_places"].shape == (POSES, 3)
    assert arrays["rays"].shape == (18, 2, 3)
    assert state["path"] == {"corners": [[1, 1], [5, 7]], "discs": [[1, 6, 0.5]]}
    points, arrays = told(view, "points", color="object", most=ALL, filter="scan,10,19")
    assert (points["count"], len(arrays["rows"])) == (1000, 1000)
    assert [name for name, *_ in points["legend"]["labels"]] == ["room"]
    world = [view.points.values(axis, arrays["rows"]) for axis in "xyz"]
    assert np.allclose(arrays["positions"] + ORIGIN, np.stack(world, axis=1))


def test_colors_are_those_of_the_legend_whatever_is_shown(cloud, pictured):
    view = View(CloudFile(cloud), pictured)
    whole, arrays = told(view, "points", color="z", most=ALL)
    some, part = told(view, "points", color="z", most=ALL, scans="50-59")
    assert some["legend"] == whole["legend"]
    assert part["rows"].tolist() == list(range(5000, 6000))
    assert np.array_equal(part["colors"], arrays["colors"][5000:6000])
    low, *_, high = whole["legend"]["marks"]
    assert (low, high) == ("0.0", "3.0")


def test_points_are_shown_in_their_own_colors(tmp_path):
    rows = np.zeros(300, [*((a, "<f8") for a in "xyz"), *((c, "|u1") for c in ("red", "green"))])
    rows["x"] = np.arange(300)
    rows["red"] = np.arange(300) % 256
    rows["green"] = 9
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(rows.dtype, 300) + rows.tobytes())
    assert "rgb" not in told(open_result(path), "state")[0]["colors"], "blue is missing"
    rgb = np.dtype([*rows.dtype.descr, ("blue", "|u1")])
    more = np.zeros(300, rgb)
    for name in rows.dtype.names:
        more[name] = rows[name]
    more["blue"] = 200
    path.write_bytes(header(rgb, 300) + more.tobytes())
    view = open_result(path)
    state = told(view, "state")[0]
    assert state["colors"][0] == "z" and state["colors"][-1] == "rgb"
    assert "rgb" not in [column["name"] for column in state["columns"]], "no column to filter by"
    answer, arrays = told(view, "points", color="rgb", most=ALL, filter="x,10,19")
    assert arrays["colors"].tolist() == [[k, 9, 200, 255] for k in range(10, 20)]
    assert answer["legend"]["title"] == "surface colors"


def test_surfaces_have_the_colors_that_are_asked_for(cloud, pictured):
    view = View(CloudFile(cloud), pictured)
    gray, arrays = told(view, "surface", color="gray")
    assert arrays["corners"].shape == (12, 3, 3)
    assert "colors" not in arrays  # the page has its own, light or dark
    assert gray["legend"] is None
    assert gray["roof_cut"] == pytest.approx(2)  # halfway up from the sensors
    hits, arrays = told(view, "surface", color="hits")
    lower = hits["legend"]["marks"][0]
    assert hits["legend"]["title"] == f"hits per square meter (gray: fewer than {lower})"
    assert arrays["colors"].shape == arrays["corners"].shape
    objects, arrays = told(view, "surface", color="object")
    assert objects["legend"]["labels"][0][0] == "room"
    assert set(arrays["objects"].tolist()) == {0}


def test_sensors_around_an_object_leave_the_picture_to_it(cloud):
    scene = Scene.from_meshes([box("Block", (2, 4, 2))])
    views = []
    for poses in ([(9, 0, 1), (-9, 0, 1)], [(9, 0, 1), (0, 0, 0)]):
        survey = Survey(Sensor.grid(layers=4), steps=9, poses=[(*p,) for p in poses])
        content, _ = PictureContent.before_casting(scene, survey)
        header, arrays = View(CloudFile(cloud), content).answer("state", {}, bool)
        np.testing.assert_allclose(header["bounds"][1][0], 9)
        views.append(arrays["corners"])
    assert abs(views[0]).max() == 4 / 2 and abs(views[1]).max() == 9


def test_a_drive_through_a_large_scene_is_looked_at_from_near(cloud):
    """The camera is near the way, and towers are cut above it."""
    scene = Scene.from_meshes([box("Ground", (800, 800, 0.1)), box("Tower", (9, 9, 90))])
    drive = seen(scene, [[0, 5, 2], [20, 5, 2]], moves=True)
    state, _ = told(View(CloudFile(cloud), drive), "state")
    assert 20 < state["cut"] < 40
    assert np.ptp(state["box"], axis=0).max() < 200 < np.ptp(state["bounds"], axis=0).max()


def test_actors_are_told_with_their_poses_and_numbers(cloud):
    scene = Scene.from_meshes([box("Hall", (8, 8, 8)), box("Table", (2, 2, 2))])
    half = np.sqrt(0.5)
    track = Track([0, 2], [[1, 1, 0], [5, 1, 0]], [[0, 0, 0, 1], [0, 0, half, half]])
    cart = replace(box("Cart", (1, 1, 1)), colors=Colors.plain(np.uint8([[[9, 8, 7]]]), 12))
    scene = replace(scene, actors=(Actor(cart, track),))
    view = View(CloudFile(cloud), seen(scene, [[20, 0, 1]]))
    state, arrays = told(view, "state")
    assert (state["actors"], state["statics"]) == ([{"name": "Cart", "class": None}], 2)
    assert len(state["actor_colors"]) == 1
    assert arrays["mesh0_colors"].tolist() == [[9, 8, 7]] * 36 and "color" in state["scene_colors"]
    assert (arrays["actor0_times"][0], arrays["actor0_times"][-1]) == (0, 2)
    assert arrays["actor0_places"][[0, -1]] == pytest.approx(np.array([[1, 1, 0], [5, 1, 0]]))
    assert np.abs(arrays["actor0_turns"][-1]) == pytest.approx([0, 0, half, half])


@pytest.fixture(scope="module")
def spun():
    """Return the sweeps of a survey of a turn at each of two poses."""
    scene = Scene.from_meshes([box("Room", (6, 8, 3))])
    survey = Survey(
        Sensor.grid(rays_per_revolution=360, layers=8), [Pose((0, 0, 1)), Pose((1, 0, 1))]
    )
    return Sweeps.from_survey(survey, scene)


def sweeping(path, sweeps):
    """Write a cloud of each sweep's number as its points' x, ten points a sweep."""
    scans = np.repeat(sweeps.scans[:-1], 10)
    rows = np.zeros(len(scans), row_type(np.dtype(np.float32), (SCAN, CHANNEL, OBJECT)))
    rows["scan"] = scans
    rows["ring"] = np.tile(np.arange(10) % 8, len(sweeps))
    rows["x"] = np.repeat(np.arange(len(sweeps)), 10) + 2
    path.write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())


def test_without_pictures_sensors_and_sweeps_are_still_shown(tmp_path, spun):
    sweeping(tmp_path / "cloud.ply", spun)
    spun.save(tmp_path / SWEEPS_FILE)
    view = open_result(tmp_path)
    state, arrays = told(view, "state")
    assert state["title"].startswith(tmp_path.name)
    assert (len(state["sensors"]), state["scene_colors"]) == (1, None)
    assert arrays["sensor0_places"] == pytest.approx(spun.pose.positions)
    assert arrays["sweep_begins"] == pytest.approx(spun.begins_ns / 1e9)
    first, last = arrays["sweep_scans"][1:3]
    of_second = places(view, scans=f"{first:.0f}-{last - 1:.0f}")
    assert set(of_second[:, 0].tolist()) == {3}
    image = told(view, "range", sweep=1)[1]["image"]
    assert image.shape[0] == 8  # channels
    with pytest.raises(KeyError):
        told(view, "range", sweep=len(spun))


@pytest.mark.parametrize(
    ("name", "places", "labels"),
    [
        ("", [(0, 0, 1), (2, 0, 1), (0, 3, 1)], ["1", "2", "3"]),
        ("", [(0, 0, 1), (2, 0, 1), (0, 0, 1), (1, 1, 1)], ["1", "2", "1", "3"]),  # it returns
        ("roof", [(0, 0, 1), (-2, 0, 1)], ["roof 1", "roof 2"]),
        ("roof", [(0, 0, 1)], ["roof"]),
    ],
)
def test_stations_have_the_numbers_of_the_picture_of_stations(name, places, labels, cloud):
    scene = Scene.from_meshes([box("Room", (6, 8, 3))])
    content = seen(scene, places)
    content = replace(content, sensors=[replace(content.sensors[0], name=name)])
    (sensor,) = told(View(CloudFile(cloud), content), "state")[0]["sensors"]
    assert sensor["labels"] == labels
    (moving,) = told(View(CloudFile(cloud), seen(scene, places, moves=True)), "state")[0]["sensors"]
    assert moving["labels"] == []


def test_points_are_colored_filtered_and_played_by_station(tmp_path, spun):
    view = open_result(result_in(tmp_path / "one", spun))
    state, arrays = told(view, "state")
    assert state["stations"] == ["", "station 1", "station 2"]
    assert arrays["sweep_station"].tolist() == [1, 2]
    legend = told(view, "points", color="station", most=ALL)[0]["legend"]
    assert [(name, value) for name, _, value in legend["labels"]] == [
        ("station 1", 1), ("station 2", 2),
    ]  # fmt: skip
    assert set(places(view, filter="station,2,2")[:, 0].tolist()) == {3}
    assert told(view, "counts", name="station")[0]["counts"] == [(1, 10), (2, 10)]
    named = replace(view, names={"station": ("", "gate", "")})
    assert told(named, "state")[0]["stations"] == ["", "gate", "station 2"]
    one = replace(view, sweeps=replace(spun, stations=1))  # of a carrier
    assert "station" not in one.columns and not told(one, "state")[0]["stations"]


def test_the_first_picture_of_a_cloud_has_its_sides_but_no_outliers():
    rng = np.random.default_rng(2)
    places = rng.uniform((-60, -20, 0), (60, 20, 8), (20_000, 3))
    places[0] = (-70, 0, 0)  # beyond most, but not an outlier
    places[1] = (0, 0, -500)
    state, arrays = told(View(InMemoryPoints(Cloud(places, {}))), "state")
    inside = np.delete(places, 1, axis=0)
    assert np.allclose(state["box"], [inside.min(axis=0), inside.max(axis=0)])
    corners = arrays["corners"]
    assert len(corners) <= 200
    for direction in rng.normal(size=(50, 3)):
        direction /= np.linalg.norm(direction)
        missing = (inside @ direction).max() - (corners @ direction).max()
        assert 0 <= missing < 0.01 * 140, direction


def test_the_page_is_told_of_the_coordinate_system(tmp_path, spun):
    of_zone = replace(spun, epsg=25832)
    one = open_result(result_in(tmp_path / "one", of_zone))
    two = open_result(result_in(tmp_path / "two", of_zone))
    assert told(one, "state")[0]["epsg"] == 25832
    assert told(open_results([tmp_path / "one", tmp_path / "two"]), "state")[0]["epsg"] == 25832
    later = replace(spun, begins_ns=spun.begins_ns + 1, epsg=25833)
    result_in(tmp_path / "three", later)
    of_both = open_results([tmp_path / "one", tmp_path / "three"])
    assert told(of_both, "state")[0]["epsg"] is None  # of which one?
    local = replace(two, sweeps=replace(of_zone, coordinates="sensor"))
    assert told(local, "state")[0]["epsg"] is None
    assert told(replace(one, sweeps=spun), "state")[0]["epsg"] is None


def result_in(folder, sweeps):
    """Write a result without pictures."""
    folder.mkdir()
    sweeping(folder / "cloud.ply", sweeps)
    sweeps.save(folder / SWEEPS_FILE)
    return folder


def test_several_results_are_one_view_with_a_color_each_and_are_played_together(tmp_path, spun):
    both = [result_in(tmp_path / name, spun) for name in ("before", "after")]
    view = open_results(both)
    state, _ = told(view, "state")
    assert [name for name, *_ in state["results"]] == ["before", "after"]
    assert state["title"].startswith("before and after")
    legend = told(view, "points", color="result", most=ALL)[0]["legend"]
    assert legend["labels"] == state["results"]
    one = open_result(both[0])
    assert len(view.points) == 2 * len(one.points)
    for asked in ({}, {"scans": "0-3,40-44"}, {"filter": "x,3,3"}):
        of_one = places(one, **asked)
        of_both = places(view, **asked)
        assert sorted(of_both.tolist()) == sorted(2 * of_one.tolist()), asked
        last = f"{asked.get('filter', 'x,-9,9')};result,1,1"
        assert places(view, **(asked | {"filter": last})).tolist() == of_one.tolist(), asked
    rows = told(view, "points", color="scan", most=ALL)[1]["rows"]
    again = [one.points.values("scan", slice(None))] * 2
    assert view.points.values("scan", rows).tolist() == np.concatenate(again).tolist()
    point = told(view, "point", row=len(view.points) - 1)[0]["columns"]
    assert point[-2:] == [["result", "after"], ["station", "station 2"]]
    assert not told(one, "state")[0]["results"]


def test_results_of_unlike_sweeps_are_not_played_and_those_in_sensor_axes_are_refused(
    tmp_path, spun
):
    later = replace(spun, begins_ns=spun.begins_ns + 1)
    unlike = [result_in(tmp_path / name, of) for name, of in (("a", spun), ("b", later))]
    assert open_results(unlike).sweeps is None
    in_axes = result_in(tmp_path / "c", replace(spun, coordinates="sensor"))
    with pytest.raises(LidarError, match=r"c contains points in sensor coordinates"):
        open_results([unlike[0], in_axes])


@pytest.mark.parametrize("kind", ["ply", "las", "parquet"])
def test_the_points_that_are_shown_are_written_to_a_file(tmp_path, spun, kind, monkeypatch):
    pytest.importorskip({"las": "laspy", "parquet": "pyarrow"}.get(kind, "numpy"))
    result = result_in(tmp_path / "one", spun)
    with monkeypatch.context() as without:
        without.setattr("lidarfiles.clouds.format_row.find_spec", lambda package: None)
        view = open_views([result])
        assert told(view, "state")[0]["exports"] == ["ply"]  # which needs no extra
    view = open_views([result])
    assert kind in told(view, "state")[0]["exports"]
    asked = {"scans": "0-3,36-71", "filter": "ring,0,4;channel,0,4;x,3,3e38"}
    told_, arrays = told(view, "export", format=kind, **asked)
    assert told_ == {"name": f"cloud.{kind}"}
    file = tmp_path / told_["name"]
    file.write_bytes(arrays["file"].tobytes())
    if kind == "ply":
        x = CloudFile(file).values("x", slice(None))
    elif kind == "las":
        x = np.array(importlib.import_module("laspy").read(file).x)
    else:
        x = importlib.import_module("pyarrow.parquet").read_table(file)["x"].to_numpy()
    assert len(x) and sorted(x) == pytest.approx(sorted(places(view, **asked)[:, 0]))


def test_what_cannot_be_written_is_told(tmp_path, spun, monkeypatch):
    missing = Mock(side_effect=LidarError("it needs laspy"))
    formats = DownloadFormats(["ply", "las"], missing)
    view = open_result(result_in(tmp_path / "one", spun), formats)
    with pytest.raises(KeyError):
        told(view, "export", format="exe")
    monkeypatch.setattr("lidarview.viewer.view.MAX_POINTS", 3)
    assert "20 points; the limit is 3" in told(view, "export", format="ply")[0]["error"]
    held = View(InMemoryPoints(Cloud(np.zeros((1, 3)), {})), downloads=formats)
    assert not told(held, "state")[0]["exports"], "of a run, some parts are read"
    monkeypatch.undo()
    assert told(view, "export", format="las")[0] == {"error": "it needs laspy"}


def test_a_range_image_has_channels_from_above_and_azimuth_from_left_to_right():
    turn = np.radians(np.arange(180, -180, -1.0))
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    spots = np.concatenate([5 * ring, 9 * ring + [0, 0, 1]])
    away = np.linalg.norm(spots, axis=1)
    channels = np.repeat([0, 7], 360)
    image = range_image(spots, away, channels, (5.0, 9.0))
    assert image.shape[0] == 8 and 300 < image.shape[1] <= 432
    assert (image[[0, 7], :, 3] > 0).mean() > 0.8
    assert not image[1:7].any()
    yellow, violet = as_bytes(colormaps["viridis"](np.array([1.0, 0.0]))[:, :3])
    near, far = image[7, 100, :3], image[0, 100, :3]  # the upper is farther
    assert np.array_equal(near, yellow) and np.array_equal(far, violet)
    left = spots[:, 1] > 1  # y is to the left
    half = range_image(spots[left], away[left], channels[left], (5.0, 9.0))
    assert half[[0, 7]].any(axis=2).any(axis=0).mean() > 0.8  # it fills its picture
    few = range_image(spots, away, np.repeat([0, 1], 360), (5.0, 9.0))
    assert few.shape[0] == 128  # by elevation


def test_a_range_image_of_a_sensor_that_looks_down_is_a_row_across_its_way():
    across = np.radians(np.linspace(20, -20, 200))
    places = 500 * np.stack([0 * across, np.sin(across), -np.cos(across)], axis=1)
    ranges = np.linspace(500, 520, 200)
    image = range_image(places, ranges, np.zeros(200, np.int64), (500.0, 520.0))
    assert image.shape[0] == 1 and 150 < image.shape[1] <= 200
    assert image[0, :, 3].all()
    green = image[0, :, 1].astype(int)  # falls from near to far
    assert (np.diff(green) <= 0).all()
    assert green[0] - green[-1] > 200  # the left is near


def test_points_in_the_axes_of_their_sensor_are_shown_without_the_scene(cloud, pictured):
    scene = Scene.from_meshes([box("Wall", (1, 8, 8))])
    survey = Survey(Sensor.grid(layers=4), poses=[(-5, 0, 1)], coordinates="sensor")
    view = View(CloudFile(cloud), pictured, Sweeps.from_survey(survey, scene))
    state, arrays = told(view, "state")
    assert (state["scene_colors"], "in sensor coordinates" in state["note"]) == (None, True)
    assert not arrays["sensor0_places"].any()  # each sensor is at its own origin
    assert len(pictured.sample_rays) and not len(arrays["rays"]), "which are in the scene's axes"
    assert ["Wall", 0] in told(view, "column", name="object")[0]["labels"]


def test_columns_of_other_programs_can_be_colored_and_filtered_by(tmp_path):
    """A cloud without scans, far from zero, with columns of one value or none."""
    rows = np.zeros(20, [*((a, "<f8") for a in "xyz"), ("their", "<f4"), ("2-a", "|u1"),
                         ("nothing", "<f4"), ("big", "<f8")])  # fmt: skip
    rows["x"] = 5e6
    rows["nothing"] = np.nan
    rows["big"] = 1e18
    rows["their"] = np.arange(20)
    lines = [*(f"property double {a}" for a in "xyz"), "property float their", "property uchar 2-a",
             "property float nothing", "property double big"]  # fmt: skip
    head = ["ply", "format binary_little_endian 1.0", "element vertex 20", *lines, "end_header", ""]
    (tmp_path / "theirs.ply").write_bytes("\n".join(head).encode() + rows.tobytes())
    view = open_result(tmp_path / "theirs.ply")
    state, arrays = told(view, "state")
    names = [column["name"] for column in state["columns"]]
    assert names == ["z", "x", "y", "their", "nothing", "big"]
    assert "sweep_scans" not in arrays
    for name in names:
        limits, _ = told(view, "column", name=name)
        assert limits["low"] <= limits["high"]
        points, arrays = told(view, "points", color=name, most=ALL)
        assert (points["count"], len(arrays["positions"])) == (20, 20)
        assert np.abs(arrays["positions"]).max() < 1
    assert len(places(view, filter="their,3,5")) == 3


def test_causes_and_no_surface_are_told_in_words(tmp_path, pictured):
    row = row_type(np.dtype(np.float64), (SCAN, CHANNEL, OBJECT, TABLE["cause"]))
    rows = np.zeros(6, row)
    rows["object"] = np.arange(6) % 2 - 1
    rows["cause"] = 1 - np.arange(6) % 2
    (tmp_path / "air.ply").write_bytes(header(row, 6) + rows.tobytes())
    file = CloudFile(tmp_path / "air.ply")
    for view in (View(file, pictured), open_result(tmp_path / "air.ply")):
        causes = [["surface", 0], ["air", 1]]
        assert told(view, "column", name="cause")[0] == {"labels": causes}
        assert told(view, "column", name="object")[0]["labels"][0] == ["no surface", -1]
        legend = told(view, "points", color="cause", most=ALL)[0]["legend"]
        assert [[name, value] for name, _, value in legend["labels"]] == causes
        words = dict(told(view, "point", row=0)[0]["columns"])
        assert (words["object"], words["cause"]) == ("no surface", "air")


def test_a_point_is_told_in_words_and_world_coordinates(cloud, pictured):
    view = View(CloudFile(cloud), pictured)
    point, _ = told(view, "point", row=2)
    assert point["place"] == [view.points.values(axis, np.array([2]))[0] for axis in "xyz"]
    assert point["columns"] == [["scan", "0"], ["channel", "2"], ["object", "room"]]
    with pytest.raises(KeyError):
        told(view, "point", row=10_000)


def test_labels_are_counted_and_switched_off(tmp_path, monkeypatch):
    rows = np.zeros(9000, row_type(np.dtype(np.float32), (SCAN, TABLE["class"])))
    rows["x"] = np.arange(9000)
    rows["class"] = np.arange(9000) % 3
    (tmp_path / "c.ply").write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())
    view = View(CloudFile(tmp_path / "c.ply"))
    counts, _ = view.answer("counts", {"name": "class"}, bool)
    assert counts == {"counts": [(0, 3000), (1, 3000), (2, 3000)], "exact": True}
    asked = {"color": "class", "most": "9000", "filter": "!class,1,1;!class,2,2;x,0,2999"}
    told, arrays = view.answer("points", asked, bool)
    assert told["count"] == 1000 and set(arrays["rows"] % 3) == {0}
    assert [label[2] for label in told["legend"]["labels"]] == [0, 1, 2], "all can be switched on"
    monkeypatch.setattr("lidarview.viewer.view._MAX_COUNTED", 8000)
    counts, _ = View(view.points).answer("counts", {"name": "class"}, bool)
    assert not counts["exact"] and sum(n for _, n in counts["counts"]) == 9000
    with pytest.raises(KeyError):
        view.answer("counts", {"name": "x"}, bool)


def test_normals_are_colors_of_points_and_of_the_scene(tmp_path, cloud, pictured):
    names = ("normal_x", "normal_y", "normal_z")
    normals = [[1, 0, 0], [0, -1, 0], [0, 0, 1], [np.nan] * 3]
    columns = dict(zip(names, np.array(normals, np.float32).T, strict=True))
    view = View(InMemoryPoints(Cloud(np.zeros((4, 3)), columns)))
    told, arrays = view.answer("points", {"color": "normals", "most": "9"}, bool)
    shown = arrays["colors"][:, :3].tolist()
    assert shown == [[255, 128, 128], [128, 0, 128], [128, 128, 255], [128, 128, 128]]
    assert "x is red, y is green, z is blue" in told["legend"]["title"]
    surface = View(CloudFile(cloud), pictured).answer("surface", {"color": "normals"}, bool)[1]
    assert not surface["colors"].std(axis=1).any(), "of flat faces"
    edges = np.diff(surface["corners"][:, [0, 1, 2]], axis=1)
    across = np.abs(np.cross(edges[:, 0], edges[:, 1])).argmax(axis=1)
    far_from_gray = np.abs(surface["colors"][:, 0].astype(int) - 128).argmax(axis=1)
    assert (across == far_from_gray).all()


def test_damaged_pictures_are_noted_and_the_cloud_is_shown(cloud, capsys, monkeypatch):
    asked = []

    def look():
        captured = capsys.readouterr()
        assert captured.out.startswith("http://127.0.0.1:")  # the address is the result
        asked.append(captured.err + captured.out)

    monkeypatch.setattr("lidarview.viewer.result_views.wait_for_interrupt", look)
    (cloud.parent / PICTURE_FILE).write_bytes(b"PK\x03\x04junk")
    show_view(open_result(cloud.parent), port=0, browser=False)
    (said,) = asked
    assert PICTURE_FILE in said.splitlines()[0]
    assert "shows 10,000 points" in said


def test_many_triangles_become_few_that_keep_shape_and_hits():
    scene = Scene.seed()
    surface = DisplayMesh(scene, max_triangles=5000)
    corners = surface.corners.reshape(-1, 3)
    assert 500 < len(surface.corners) <= 5000
    assert np.allclose(corners.min(axis=0), scene.vertices.min(axis=0), atol=0.5)
    assert np.allclose(corners.max(axis=0), scene.vertices.max(axis=0), atol=0.5)
    first = scene.face_object == 0  # of six objects, far from each other
    arrays, legend = surface.color_by("hits", np.where(first, 3, 0), NOWHERE)
    corners = arrays["corners"]
    colors = arrays["colors"]
    middles = corners.mean(axis=1)
    low, high = scene.object_bounds[0]
    there = ((middles > low - 1) & (middles < high + 1)).all(axis=1)
    vivid = (np.ptp(colors.astype(int), axis=2) > 40).any(axis=1)
    assert vivid[there].mean() > 0.9
    assert not vivid[~there].any()
    assert "hits per square meter" in legend["title"]
    assert len(DisplayMesh(scene).corners) == len(scene.faces)  # few enough


def test_a_scene_is_colored_by_the_materials_of_its_faces(tmp_path):
    """Those of faces and of instances, also simplified, and read back from a result."""
    square, faces = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]]), [[0, 1, 2], [0, 2, 3]]
    named = FaceMaterials(("Brick", "Glass"), np.array([0, 1], np.int32))
    wall = SceneMesh("wall", square, faces, materials=named)
    floor = SceneMesh("floor", square - [0, 0, 1], faces)
    pane = SceneMesh("pane", square, faces, materials=FaceMaterials(("Glass",)))
    copy = SceneInstance(wall, Pose((9, 0, 0)), "copy")
    scene = Scene.from_meshes([floor, wall, pane, copy])
    survey = Survey(Sensor.grid(100, 4), [(0, 0, 1)])
    content, _ = PictureContent.before_casting(scene, survey)
    expected = [-1, -1, 0, 1, 1, 1, 0, 1]
    assert content.face_materials.tolist() == expected
    content = replace(content, hit_counts=np.zeros(content.scene.triangles, np.int64))
    content.save(tmp_path / "pictures.npz")
    content = PictureContent.load(tmp_path / "pictures.npz")
    view = View(InMemoryPoints(Cloud(np.ones((3, 3)), {})), content)
    header, _ = view.answer("state", {}, bool)
    assert "material" in header["scene_colors"]
    header, arrays = view.answer("surface", {"color": "material"}, bool)
    assert [name for name, *_ in header["legend"]["labels"]] == ["no material", "Brick", "Glass"]
    colors = {value: color for _, color, value in header["legend"]["labels"]}
    shown = arrays["colors"][:, 0].tolist()
    assert shown == [colors[material] for material in expected]
    assert len({*map(tuple, colors.values())}) == 3
    plain = Scene.from_meshes([floor])
    content, _ = PictureContent.before_casting(plain, survey)
    assert content.face_materials is None
    assert "material" not in available_colorings(plain, None, content.face_materials)


def test_a_scene_is_colored_by_the_reflectance_of_its_objects():
    scene = Scene.from_meshes([box("White", (1, 1, 1)), box("Black", (2, 2, 2))])
    share = np.array([1.0, 0.0])
    assert available_colorings(scene, share) == ("gray", "hits", "object", "normals", "reflectance")
    assert available_colorings(scene, np.array([0.5, 0.5])) == ("gray", "hits", "object", "normals")
    arrays, legend = DisplayMesh(scene, share).color_by("reflectance", share, NOWHERE)
    colors = arrays["colors"]
    assert np.unique(colors[scene.face_object == 0]).tolist() == [255]
    assert colors[scene.face_object == 1].max() < 40
    assert legend["title"] == "reflectance"


def coloring_and_legend(*arguments):
    """Colors (n, 3) as bytes, and the legend as JSON."""
    colored = make_coloring(*arguments)
    return as_bytes(colored.paint(arguments[0])), json.dumps(
        make_legend(colored), ensure_ascii=False
    )


def test_the_middle_of_a_bar_about_zero_is_zero_without_a_sign():
    legend = coloring_and_legend(np.linspace(-8, 7.98, 200), Z)[1]
    assert json.loads(legend)["marks"] == ["-8", "0", "8"]


@pytest.mark.parametrize(
    ("span_ns", "told"), [(2e9, "time, s:"), (3e7, "time, ms:"), (50, "time, ns:")]
)
def test_times_are_told_in_a_unit_that_can_be_read(span_ns, told):
    legend = coloring_and_legend(np.linspace(0, span_ns, 200).astype(np.int64), TABLE["time"])[1]
    assert told in legend
    assert ('"1.0"' in legend) == (span_ns == 2e9)


def test_what_is_no_surface_is_gray_and_has_no_object_s_color():
    values = np.arange(200, dtype=np.int32) % 3 - 1
    colors, legend = coloring_and_legend(values, OBJECT, ("Ball", "Box"))
    assert (colors[values < 0] == 128).all()
    assert not (colors[values >= 0] == 128).all(axis=1).any()
    assert '["no surface", [128, 128, 128], -1]' in legend
    own = Column("zone", "int32", "", "zone", kind="label")
    assert "no surface" not in coloring_and_legend(values, own)[1]
    many = tuple(f"thing {number}" for number in range(1100))
    assert '"thing 99"' in coloring_and_legend(np.arange(100), OBJECT, many)[1]
    assert '"more": 100' in coloring_and_legend(np.arange(1100), OBJECT, many)[1]
    often = np.append(np.arange(100), np.full(9, 73))
    assert "thing 73" in coloring_and_legend(often, OBJECT, many)[1]


@pytest.mark.extended(every=6)
@pytest.mark.parametrize("column", TABLE.values(), ids=lambda column: column.name)
def test_every_column_takes_no_points_equal_ones_and_its_largest(column):
    dtype = np.dtype(column.dtype)
    assert coloring_and_legend(np.zeros(0, dtype), column)[0].shape == (0, 3)
    same, legend = coloring_and_legend(np.ones(5, dtype), column, ("Ball",))
    assert len(np.unique(same, axis=0)) == 1
    assert "nan" not in legend
    if dtype.kind in "iu":
        assert coloring_and_legend(np.array([0, np.iinfo(dtype).max], dtype), column)[0].shape == (
            2,
            3,
        )


ALL_ROWS = slice(None)


def along_y(y=0.0, parallel=False):
    """Return a camera at (0, y, 0) that looks along y, 90° high and twice as wide; z is up."""
    view = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, y], [0, 0, 0, 1]])
    near = 0.1
    far = 1000.0
    if parallel:  # 10 meters high
        lens = np.diag([1 / 10, 1 / 5, -2 / (far - near), 1.0])
        lens[2, 3] = -(far + near) / (far - near)
    else:
        lens = np.diag([0.5, 1.0, -(far + near) / (far - near), 0.0])
        lens[2, 3] = -2 * far * near / (far - near)
        lens[3, 2] = -1.0
    columns = (lens @ view).T.ravel()
    return BrowserCamera.parse(",".join(map(repr, columns.tolist())))


EYE = along_y()


def test_a_camera_sees_what_is_before_it():
    places = np.array([[0, 5, 0], [9, 5, 0], [-11, 5, 0], [0, 5, 4], [0, 5, -6], [0, -5, 0.0]])
    at, inside = EYE.project(places)
    assert inside.tolist() == [True, True, False, True, False, False]
    assert at[:2] == pytest.approx(np.array([[0, 0], [0.9, 0]]))
    assert at[3, 1] == pytest.approx(0.8)  # up
    tiles = EYE.tiles(places)
    assert (tiles >= 0).tolist() == inside.tolist()
    assert tiles.max() < TILES
    assert len(set(tiles[inside].tolist())) == 3


def test_a_filter_keeps_what_is_within_all_limits():
    cloud = Cloud(
        np.arange(12.0).reshape(4, 3),
        {"range": np.float32([1, 2, np.nan, 4]), "class": np.uint16([0, 1, 1, 1])},
    )
    held = InMemoryPoints(cloud)
    wanted = PointFilter.parse("class,1,1;range,0,9;nothing,1,2", ["class", "range"])
    assert wanted.limits == (("class", 1, 1), ("range", 0, 9))
    assert wanted.mask(held, ALL_ROWS).tolist() == [False, True, False, True]
    assert PointFilter((("z", 3, 8),)).mask(held, ALL_ROWS).tolist() == [False, True, True, False]
    assert PointFilter().mask(held, np.array([0, 3])).all()
    text = ";".join(f"range,{n / 1e4},{9 - n / 1e4}" for n in range(5000))
    assert PointFilter.parse(text, ["range"]).limits == (("range", 0.4999, 8.5001),)
    for bad in ("range,nan,3", "range,1", "range,x,2"):
        with pytest.raises(ValueError, match=r"."):
            PointFilter.parse(bad, ["range"])
    assert parse_scans("4-6,0-1,5-9,,2-2,8-7") == ((0, 2), (4, 9))


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Return a file of 100,000 points along y, from 1 to 100 meters, in blocks of 1,000."""
    monkeypatch.setattr(points, "BLOCK_ROWS", 1000)
    rows = np.zeros(100_000, row_type(np.dtype(np.float32), (SCAN, TABLE["intensity"])))
    random = np.random.default_rng(0)
    rows["y"] = np.linspace(1, 100, 100_000)
    rows["x"], rows["z"] = random.uniform(-0.3, 0.3, (2, 100_000))
    rows["scan"] = np.arange(100_000) // 100
    rows["intensity"] = rows["scan"] % 100
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())
    return CloudFile(path)


class Read:
    """A file that notes the blocks that are read of it."""

    def __init__(self, file):
        self._file = file
        self.table = file.table
        self.rows_of = file.rows_of
        self.blocks = set()

    def __len__(self):
        return len(self._file)

    def values(self, name, rows):
        if isinstance(rows, slice):
            self.blocks.add(rows.start // 1000)
        return self._file.values(name, rows)


def test_without_a_filter_an_even_choice_of_all_is_found(file):
    rows, count = PointFinder(file, np.zeros(3)).find_points(5000)
    assert (len(rows), count) == (5000, 100_000)
    assert np.histogram(rows, 10, (0, 100_000))[0].tolist() == [500] * 10
    rows, count = PointFinder(file, np.zeros(3)).find_points(5000, scans=((10, 19), (500, 504)))
    assert rows.tolist() == [*range(1000, 2000), *range(50_000, 50_500)]
    assert count == 1500


def test_all_points_that_a_filter_keeps_are_found_or_an_even_choice_of_them(file):
    finder = PointFinder(read := Read(file), np.zeros(3))
    rows, count = finder.find_points(5000, PointFilter((("intensity", 7, 7),)))
    assert len(rows) == count == 1000
    assert set(file.values("intensity", rows).tolist()) == {7}
    assert len(read.blocks) == 100
    rows, count = finder.find_points(5000, PointFilter((("intensity", 0, 49),)))
    assert count == 50_000
    assert 2000 < len(rows) <= 5000
    assert (np.diff(rows) > 0).all()
    assert np.histogram(rows, 10, (0, 100_000))[0].min() > 150
    read.blocks.clear()
    rows, count = finder.find_points(5000, PointFilter((("intensity", 95, 99),)), ((995, 2000),))
    assert (len(rows), count, read.blocks) == (500, 500, {99})  # nothing else is read
    assert len(finder.find_points(5000, PointFilter((("intensity", 200, 300),)))[0]) == 0


@pytest.mark.parametrize("parallel", [False, True])
def test_a_camera_finds_what_is_before_it_and_reads_no_block_behind_it_again(file, parallel):
    finder = PointFinder(read := Read(file), np.zeros(3))
    eye = along_y(90.0, parallel)
    rows, count = finder.find_points(20_000, camera=eye)
    assert count == 100_000
    assert len(read.blocks) == 100
    assert file.values("y", rows).min() > 90
    assert 9000 < len(rows) < 10_200
    read.blocks.clear()
    fewer, _ = finder.find_points(4000, camera=eye)
    assert len(read.blocks) < 12
    assert 2000 < len(fewer) <= 4000


def test_a_search_that_nobody_waits_for_is_given_up(file):
    asked = iter([False] * 5 + [True])
    finder = PointFinder(read := Read(file), np.zeros(3))
    with pytest.raises(ClientDisconnected):
        finder.find_points(
            5000, PointFilter((("intensity", 7, 7),)), is_disconnected=lambda: next(asked)
        )
    assert len(read.blocks) == 5


def test_points_that_are_nowhere_are_not_found(tmp_path):
    local = np.ones((1000, 3))
    local[::2, 0] = np.nan
    finder = PointFinder(CloudFile(write(tmp_path / "a.ply", local)), np.zeros(3))
    assert finder.find_points(1000)[0].tolist() == list(range(1, 1000, 2))


def phased_survey(**options):
    """Return a survey of a drive with two sensors, the second of which starts 0.3 ms later."""
    late = replace(Sensor.grid(layers=4), start_ns=300_000.0)
    sensors = [
        Mounted(Sensor.grid(layers=4), Pose((1, 0, 0)), name="front"),
        Mounted(late, Pose((-1, 0.5, 0), yaw_deg=180), name="rear"),
    ]
    track = Track([0, 2], [[0, 0, 2], [8, 0, 2.0]], [[0, 0, 0, 1], [0, 0, 1, 0.0]])
    return Survey(sensors=sensors, trajectory=track, **options)


def test_the_duration_ends_with_the_last_sweep_of_any_sensor(tmp_path):
    scene = Scene.from_meshes([box("Floor", (20, 20, 0.1))])
    sweeps = Sweeps.from_survey(phased_survey(steps=360), scene)
    positions = np.zeros((10, 3))
    view = View(CloudFile(write(tmp_path / "cloud.ply", positions), ()), None, sweeps)
    assert view.duration_ns == pytest.approx(1e9 + 300_000)


@pytest.mark.parametrize("moves", [True, False])
def test_positions_of_sensors_are_those_of_their_scans(moves):
    survey = phased_survey(steps=360)
    if not moves:
        poses = [Pose((0, 0, 2), yaw_deg=30), Pose((4, 0, 1), pitch_deg=20)]
        survey = replace(survey, trajectory=None, poses=poses)
    rear = sensor_positions(survey)[1]
    first = survey.scan_count // 2  # of the second sensor
    scans = [first, first + 360] if not moves else [first, first + 180, first + 359]
    rows = [0, 1] if not moves else [0, 180, 359]
    assert len(rear.positions) == (360 if moves else 2) and rear.name == "rear"
    expected = [survey.pose(scan).position for scan in scans]
    assert np.allclose(rear.positions[rows], expected, atol=1e-12)
    assert np.allclose(rear.times_ns[rows], [survey.begins_ns(scan) for scan in scans])


def test_classes_of_actors_are_known_before_they_have_points(tmp_path):
    van = Actor(box("Van", (4, 2, 2)), Track([0, 1], [[5, 0, 0], [9, 0, 0.0]]))
    scene = Scene.from_meshes([box("Floor", (20, 20, 0.1))])
    scene = replace(scene, actors=(van,))
    materials = [Material("Van", semantic_class=7), Material("*", semantic_class=2)]
    survey = replace(phased_survey(steps=36), materials=materials, columns=["class"])
    content, _ = PictureContent.before_casting(scene, survey)
    content = replace(content, hit_counts=np.zeros(content.scene.triangles, np.int64))
    content.save(tmp_path / PICTURE_FILE)
    kind = np.uint16 if TABLE["class"].dtype == "uint16" else np.uint8
    empty = Cloud(np.zeros((0, 3)), {"object": np.zeros(0, np.int32), "class": np.zeros(0, kind)})
    for pictured in (content, PictureContent.load(tmp_path / PICTURE_FILE)):
        header, _ = View(InMemoryPoints(empty), pictured).answer("state", {}, lambda: False)
        assert header["actors"] == [{"name": "Van", "class": 7}]
