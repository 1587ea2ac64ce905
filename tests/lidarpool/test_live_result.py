"""A finished result on a page: its points, scene, sensors, rays and planning; nobody looks yet."""

import io
import time
from dataclasses import replace
from importlib.metadata import version
from types import SimpleNamespace
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import trimesh
from benchmarks.live import looking
from websockets.sync.client import connect

from lidarpool import LidarpoolError, Planning, Scene, Track
from lidarpool.columns.table import CHANNEL, OBJECT, SCAN
from lidarpool.export.cloud_file import CloudFile
from lidarpool.export.ply_format import header, row_type
from lidarpool.live.cloud_view import HIDDEN
from lidarpool.live.looking import Filter
from lidarpool.live.page import live_page
from lidarpool.live.result_page import ResultView, view_result
from lidarpool.live.surface import Surface, coloured_mesh, colours_for
from lidarpool.plan import Plan
from lidarpool.render.hits import hit_colours
from lidarpool.run.picture_file import PICTURE_FILE, Pictured, SensorWay
from lidarpool.scene.actors import Actor, box
from lidarpool.scene.mesh import Mesh

POSES = 25
NOWHERE = np.zeros((0, 3), np.float32)
ORIGIN = np.array([500_000.0, 100.0, 0.0])


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
    cloud, count = file.choose(10_000, (20, 29))
    assert count == len(cloud) == 5_000
    assert np.unique(cloud["scan"]).tolist() == list(range(20, 30))
    cloud, count = file.choose(4_000, (0, 99))
    assert (count, len(cloud)) == (50_000, 4_000)
    assert np.bincount(cloud["scan"]).min() >= 35
    assert np.bincount(cloud["channel"]).min() > 50
    assert np.array_equal(cloud.positions[:, 0], cloud["scan"])


def test_no_points_and_points_that_are_nowhere_are_no_reason_to_fail(tmp_path):
    nothing = CloudFile(write(tmp_path / "a.ply", np.zeros((0, 3))))
    assert (len(nothing), nothing.scans, nothing.choose(10, (0, 0))[1]) == (0, (0, 0), 0)
    nowhere = CloudFile(write(tmp_path / "b.ply", np.full((1000, 3), np.nan)))
    assert len(nowhere.choose(1000, (0, 99))[0]) == 0


def test_columns_that_nobody_knows_are_in_the_menu(tmp_path, page):
    """A cloud of another program, without scans."""
    rows = np.zeros(20, [*((a, "<f4") for a in ("x", "y", "z", "nx")), ("2-a", "|u1")])
    rows["x"] = rows["nx"] = np.arange(20)
    lines = [*(f"property float {a}" for a in ("x", "y", "z", "nx")), "property uchar 2-a"]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 20", *lines, "end_header", ""]
    (tmp_path / "theirs.ply").write_bytes("\n".join(head).encode() + rows.tobytes())
    file = CloudFile(tmp_path / "theirs.ply")
    view = ResultView(page, file)
    view.draw()
    assert view._view.cloud.colour.options == ("z", "x", "y", "nx", HIDDEN)
    assert file.choose(100)[0]["nx"].tolist() == list(range(20))


def test_what_is_no_result_is_refused(tmp_path):
    for name, words in (
        ("", r"holds no cloud\.ply: give the folder"),
        ("none.ply", "cannot be read"),
        ("cut.ply", "is not a point cloud of lidarpool"),
    ):
        (tmp_path / "cut.ply").write_bytes(b"ply\n")
        with pytest.raises(LidarpoolError, match=words):
            view_result(tmp_path / name, port=0, browser=False)


@pytest.fixture(scope="module")
def pictured():
    """Return a room with a roof, 6 by 8 by 3 metres, far from zero, scanned from 25 poses."""
    room = trimesh.creation.box(bounds=[(0, 0, 0), (6, 8, 3)])
    faces = np.int32(room.faces)
    scene = Scene(np.array(room.vertices), faces, np.zeros(12, np.int32), ("room",), ORIGIN)
    poses = np.column_stack([np.full(POSES, 3.0), np.linspace(1, 7, POSES), np.ones(POSES)])
    rays = np.stack([np.repeat(poses[:2], 9, axis=0), np.full((18, 3), 2.9)], axis=1)
    rays[:9, 1, 2] = 0.5
    return Pictured(
        scene,
        (SensorWay(np.arange(POSES), poses),),
        np.arange(12),
        rays.astype(np.float32),
        Planning((1, 1), (5, 7), [(1, 6)], 0.5),
        Plan(np.array([[1.0, 1.0], [5.0, 7.0]]), 7.2, 7.2, 1.0, 0, 1),
        (),
    )


@pytest.fixture
def cloud(tmp_path):
    """Return a file of 10,000 points on the room's walls and ceiling."""
    local = np.random.default_rng(0).uniform((0, 0, 0), (6, 8, 3), (10_000, 3))
    local[::2, 0], local[1::2, 2] = 0.0, 3.0
    return write(tmp_path / "cloud.ply", local + ORIGIN)


@pytest.fixture
def page():
    """Return a page that nobody looks at."""
    with live_page("a result", port=0) as page:
        yield page


def points(page):
    """Positions of the points that are shown."""
    node = page.scene.get_handle_by_name("/cloud")
    return node.points if node is not None and node.visible else np.empty((0, 3))


def scenes(view):
    """Meshes that are shown."""
    return [node for node in view._view._mesh._nodes if node.visible]


def test_the_page_shows_scene_sensors_rays_and_planning(cloud, pictured, page):
    view = ResultView(page, CloudFile(cloud), pictured)
    view.draw()
    for name in ("/poses", "/rays", "/path", "/discs/0"):
        assert page.scene.get_handle_by_name(name) is not None, name
    assert len(scenes(view)) == 1
    assert not view._view._scene_legend.content  # grey
    view._view._scene_colour.value = "hits"
    view.draw()
    assert "hits per square metre" in view._view._scene_legend.content
    view._view._scene_colour.value = "object"
    view.draw()
    assert "room" in view._view._scene_legend.content
    assert len(page.scene.get_handle_by_name("/poses").batched_positions) == POSES
    assert "10,000 of 10,000 points" in view._facts.content
    view._view.cloud.set_filter(Filter((("scan", 10, 19),)))
    view.draw()
    assert "1,000 of 10,000 points" in view._facts.content


def test_under_a_roof_the_page_is_cut_and_can_be_made_whole(cloud, pictured, page):
    view = ResultView(page, CloudFile(cloud), pictured)
    view.draw()
    assert view._view.cut == pytest.approx(2)  # halfway up from the sensors
    assert 0 < len(points(page)) < 4000
    assert points(page)[:, 2].max() <= 2
    assert len(page.scene.get_handle_by_name("/rays").points) == 9
    view._view._cut.value = view._view._cut.max
    view.draw()
    assert view._view.cut is None
    assert len(points(page)) == 10_000
    assert len(page.scene.get_handle_by_name("/rays").points) == 18
    assert len(scenes(view)) == 2
    view._view._cut.value = -1.0  # not even the floor is left
    view.draw()
    assert len(points(page)) == len(scenes(view)) == 0


def test_a_colour_that_is_chosen_is_drawn_and_what_is_hidden_is_not(cloud, pictured, page):
    view = ResultView(page, CloudFile(cloud), pictured)
    view._view.cloud.colour.value = "object"
    view.draw()
    assert "room" in view._view.cloud._legend.content
    view._view.cloud.colour.value, view._view._show_rays.value = HIDDEN, False
    view._view._scene_colour.value = HIDDEN
    view.draw()
    assert len(points(page)) == 0
    assert not page.scene.get_handle_by_name("/rays").visible
    assert len(scenes(view)) == 0


def test_what_moves_is_where_it_is_at_the_time_that_is_chosen_or_played(cloud, pictured, page):
    """A sensor along y, and an actor that turns to the left on its way along x."""
    way = SensorWay(np.array([0, 2e9]), np.array([[3, 1, 1], [3, 7, 1]]), True, "nose", "VLP-16")
    half = np.sqrt(0.5)
    track = Track([0, 2], [[1, 1, 0], [5, 1, 0]], [[0, 0, 0, 1], [0, 0, half, half]])
    scene = replace(pictured.scene, actors=(Actor(box("Cart", (1, 1, 1)), track),))
    moving = replace(pictured, scene=scene, sensors=[way], duration_ns=2e9)
    view = ResultView(page, CloudFile(cloud), moving)
    view.draw()
    assert "nose: VLP-16" in view._facts.content
    assert page.scene.get_handle_by_name("/ways/0") is not None
    view._view._time.value = 1.0
    view.draw()
    sensor, cart = (page.scene.get_handle_by_name(f"/{kind}/0") for kind in ("sensors", "actors"))
    assert sensor.position == pytest.approx((3, 4, 1))
    assert cart.position == pytest.approx((3, 1, 0))
    assert cart.wxyz == pytest.approx((np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)))
    view._view.cloud.colour.value = "object"
    view._view._start_or_stop()
    while sensor.position[1] < 4.1:  # from the end, it plays from the beginning again
        view.draw()
    assert "room" in view._view.cloud._legend.content


def test_a_drive_through_a_large_scene_is_looked_at_from_near(cloud, page):
    """The camera is near the way, and towers are cut above it."""
    scene = Scene.from_meshes([box("Ground", (800, 800, 0.1)), box("Tower", (9, 9, 90))])
    way = SensorWay(np.array([0, 2e9]), np.array([[0, 5, 2.0], [20, 5, 2]]), True, "", "VLP-16")
    hits, rays = np.full(scene.triangles, 9, np.int64), np.zeros((0, 2, 3), np.float32)
    view = ResultView(
        page, CloudFile(cloud), Pictured(scene, [way], hits, rays, None, None, (), 2e9)
    )
    view.draw()
    assert 20 < view._view.cut < 40
    assert np.linalg.norm(page.initial_camera.position) < 200


def test_of_an_object_that_is_looked_at_alone_all_else_is_hidden(cloud, page):
    scene = Scene.from_meshes([box("Hall", (8, 8, 8)), box("Table", (2, 2, 2))])
    track = Track([0, 2], [[1, 1, 0], [5, 1, 0]])
    scene = replace(scene, actors=(Actor(box("Cart", (1, 1, 1)), track),))
    hits = np.arange(scene.triangles)
    rays = np.ones((4, 2, 3), np.float32)
    way = SensorWay(np.zeros(1), np.array([[20.0, 0, 1]]))  # beside the hall
    seen = Pictured(scene, [way], hits, rays, None, None, (), 2e9)
    view = ResultView(page, CloudFile(cloud), seen)
    shown, cart = view._view, page.scene.get_handle_by_name("/actors/0")
    for colour in ("grey", "hits"):
        shown._scene_colour.value = colour
        for name, sides, moving in ((None, 24, True), ("Table", 12, False), ("Cart", 0, True)):
            only = None if name is None else (scene.all_names.index(name),) * 2
            shown.cloud.set_filter(Filter().with_limits("object", only))
            view.draw()
            if sides:
                mesh = trimesh.load(io.BytesIO(scenes(view)[-1].glb_data), file_type="glb")
                assert mesh.to_mesh().extents == pytest.approx([2 if name else 8] * 3, abs=0.01)
            else:
                assert not scenes(view)
            assert cart.visible == moving
            assert ("Cart" in shown._labels._places) == moving
            assert page.scene.get_handle_by_name("/rays").visible == (name is None)
    shown._scene_colour.value = HIDDEN
    shown.cloud.set_filter(Filter())
    view.draw()
    assert not scenes(view)
    assert not cart.visible


def test_a_drive_under_a_wide_roof_is_cut_below_the_roof(cloud, page):
    roof = box("Roof", (800, 800, 1))
    roof = replace(roof, vertices=roof.vertices + np.array([0, 0, 10]))
    scene = Scene.from_meshes([box("Ground", (800, 800, 0.1)), roof, box("Mast", (1, 1, 90))])
    way = SensorWay(np.array([0, 2e9]), np.array([[3, 5, 2.0], [20, 5, 2]]), True, "", "VLP-16")
    hits, rays = np.zeros(scene.triangles, np.int64), np.zeros((0, 2, 3), np.float32)
    view = ResultView(
        page, CloudFile(cloud), Pictured(scene, [way], hits, rays, None, None, (), 2e9)
    )
    view.draw()
    assert view._view.cut == pytest.approx(6, abs=0.5)


def test_without_a_scene_the_cloud_is_shown_alone_near_zero(cloud, page):
    view = ResultView(page, CloudFile(cloud), None, "why & what")
    view.draw()
    assert len(points(page)) == 10_000
    assert np.abs(points(page)).max() < 200
    assert "why &amp; what" in view._facts.content


def test_damaged_pictures_are_noted_and_the_cloud_is_shown(cloud, capsys, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("lidarpool.live.result_page.time.sleep", interrupt)
    (cloud.parent / PICTURE_FILE).write_bytes(b"PK\x03\x04junk")
    view_result(cloud.parent, port=0, browser=False)
    said = capsys.readouterr().err
    assert "note: The cloud is shown without the scene." in said
    assert "shows 10,000 points" in said


def test_triangles_come_back_from_their_file_in_their_colours():
    corners = np.random.default_rng(0).random((7, 3, 3)).astype(np.float32)
    colours = np.arange(63, dtype=np.uint8).reshape(7, 3, 3) * 4
    data = coloured_mesh(corners, colours)
    mesh = trimesh.load(io.BytesIO(data), file_type="glb", process=False).to_mesh()
    assert np.array_equal(mesh.vertices[mesh.faces].astype(np.float32), corners)
    linear = np.frombuffer(data[-4 * 21 :], np.uint8).reshape(7, 3, 4)[:, :, :3] / 255
    screen = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.allclose(255 * screen, colours, atol=7)  # dark ones are coarse, linear


def test_many_triangles_become_few_that_keep_shape_and_hits():
    scene = Scene.seed()
    surface = Surface(scene, most=5000)
    corners = surface.corners.reshape(-1, 3)
    assert 500 < len(surface.corners) <= 5000
    assert np.allclose(corners.min(axis=0), scene.vertices.min(axis=0), atol=0.5)
    assert np.allclose(corners.max(axis=0), scene.vertices.max(axis=0), atol=0.5)
    first = scene.face_object == 0  # of six objects, far from each other
    corners, colours, legend = surface.coloured("hits", np.where(first, 3, 0), NOWHERE)
    middles = corners.mean(axis=1)
    low, high = scene.object_bounds[0]
    there = ((middles > low - 1) & (middles < high + 1)).all(axis=1)
    vivid = (np.ptp(colours.astype(int), axis=2) > 40).any(axis=1)
    assert vivid[there].mean() > 0.9
    assert not vivid[~there].any()
    assert "hits per square metre" in legend
    assert len(Surface(scene).corners) == len(scene.faces)  # few enough


def test_hits_of_a_wall_of_two_triangles_are_told_apart_on_a_grid():
    """A wall of 8 by 4 metres: 100 hits per square metre on its left half, none on the other."""
    wall = trimesh.Trimesh([[0, 0, 0], [8, 0, 0], [8, 0, 4], [0, 0, 4]], [[0, 1, 2], [0, 2, 3]])
    scene = Scene.from_meshes([Mesh("wall", wall.vertices, wall.faces)])
    random = np.random.default_rng(0)
    points = random.uniform((0, 0, 0), (4, 0, 4), (800, 3)).astype(np.float32)  # every other hit
    corners = scene.vertices[scene.faces].astype(np.float32)
    hits = np.array([800.0, 800.0])
    pieces, _, colours, limits = hit_colours(scene, corners, hits, points, 5000)
    sides = pieces[:, 1:] - pieces[:, :1]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    assert areas.sum() == pytest.approx(32, rel=1e-4)
    assert limits[0] < 100 < limits[1] < 300
    vivid = np.ptp(colours, axis=2) > 0.2
    assert vivid[pieces[..., 0] < 3.5].all()
    assert not vivid[pieces[..., 0] > 5.5].any()
    assert len(hit_colours(scene, corners, np.array([800.0, 0.0]), points, 3)[0]) <= 3
    untouched, _, colours, _ = hit_colours(scene, corners, np.zeros(2), points, 5000)
    assert len(untouched) == 2 and (np.ptp(colours, axis=2) < 0.1).all()


def test_what_touches_does_not_show_through():
    """Each side of a box is moved inwards, so that those of two that touch are apart."""
    scene = Scene.from_meshes([box("Wall", (8, 1, 3)), box("Ceiling", (8, 8, 1))])
    surface = Surface(scene)
    moved = surface.corners - scene.vertices[scene.faces]
    sides = surface.corners[:, 1:] - surface.corners[:, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    assert ((moved.mean(axis=1) * normals).sum(axis=1) < 0).all()
    assert np.abs(moved).max() < 0.01


def test_a_scene_is_coloured_by_the_reflectance_of_its_objects():
    scene = Scene.from_meshes([box("White", (1, 1, 1)), box("Black", (2, 2, 2))])
    share = np.array([1.0, 0.0])
    assert colours_for(scene, share) == ("grey", "hits", "object", "reflectance")
    assert colours_for(scene, np.array([0.5, 0.5])) == ("grey", "hits", "object")
    _, colours, legend = Surface(scene, share).coloured("reflectance", share, NOWHERE)
    assert np.unique(colours[scene.face_object == 0]).tolist() == [255]
    assert colours[scene.face_object == 1].max() < 40
    assert "reflectance" in legend


def test_a_filter_is_chosen_by_its_controls_and_told(cloud, pictured, page):
    view = ResultView(page, CloudFile(cloud), pictured, most=4000)
    view.draw()
    shown = view._view.cloud
    assert "10,000 points, 4,000 shown" in view._facts.content
    shown._filter_by.value = "z"
    view.draw()
    assert shown._input.label == "z, m"
    shown._input.value = (shown._input.min, 2.0)
    drawn_until(view, lambda: "reading" not in view._facts.content)
    assert "z 0 to 2 m" in shown._filter_text.content
    count = np.count_nonzero(CloudFile(cloud).piece(0, 10_000).positions[:, 2] <= 2.0)
    assert f"{count:,} of 10,000 points, all shown" in view._facts.content
    assert points(page)[:, 2].max() <= 2
    shown._filter_by.value = "object"
    view.draw()
    assert shown._input.options == ("all", "room")
    shown._input.value = "room"
    view.draw()
    assert "only room" in shown._filter_text.content
    shown.set_filter(Filter())
    view.draw()
    assert "4,000 shown" in view._facts.content
    assert shown._input.value == "all"
    assert not shown._all.visible


def drawn_until(view, true):
    """Draw as often as it takes."""
    deadline = time.monotonic() + 120
    while True:
        view.draw()
        if true():
            return
        assert time.monotonic() < deadline, view._facts.content


def test_a_point_that_is_clicked_at_is_told_and_measured_from(cloud, pictured, page):
    view = ResultView(page, CloudFile(cloud), pictured)
    view.draw()
    shown = view._view.cloud
    assert "Click a point" in shown.picked._text.content
    wall, eye = shown._even.part(slice(0, 1)), np.array([3.0, 4.0, 1.0])
    for part, measure in ((wall, False), (shown._even.part(slice(2, 3)), True)):
        place = part.positions[0] - ORIGIN
        click = SimpleNamespace(
            client_id=1,
            client=SimpleNamespace(camera=SimpleNamespace(fov=0.8, image_height=800)),
            ray_origin=eye,
            ray_direction=place - eye,
            modifier="shift" if measure else None,
        )
        view._view._cut.value = view._view._cut.max
        shown._clicks.put(click)
        view.draw()
    told = shown.picked._text.content
    first, second = shown._even.positions[0], shown._even.positions[2]
    assert f"{np.linalg.norm(second - first):,.3f} m" in told
    for words in ("scan <b>0<", "channel <b>2<", "object <b>room<", f"y <b>{second[1]:,.3f} m"):
        assert words in told
    assert page.scene.get_handle_by_name("/picked/way") is not None
    shown.picked.take(None, False, eye)
    assert page.scene.get_handle_by_name("/picked/0") is None


def test_a_link_brings_back_what_was_chosen(cloud, pictured, page):
    view = ResultView(page, CloudFile(cloud), pictured)
    view.draw()
    shown = view._view
    shown.cloud.colour.value, shown._scene_colour.value = "object", "hits"
    shown._cut.value = 1.5
    wanted = Filter((("scan", 10.0, 20.0), ("z", 0.25, 1.0)))
    shown.cloud.set_filter(wanted)
    view.draw()
    choices = shown.choices
    with looking(page.url):
        while not page.get_clients():
            time.sleep(0.01)
        link = page.link(next(iter(page.get_clients().values())), choices)
    query = parse_qs(urlsplit(link).query)
    assert query["initialCameraPosition"] == ["40,-40,30"]
    shown.cloud.colour.value, shown._scene_colour.value = "z", "grey"
    shown._cut.value = shown._cut.max
    shown.cloud.set_filter(Filter())
    view.draw()
    with connect(query["websocket"][0], subprotocols=[f"viser-v{version('viser')}"]):
        drawn_until(view, lambda: shown.cloud.filter == wanted)
    assert shown.choices == choices
    shown.choose(
        [
            ("colour", "nothing"),
            ("cut", "high"),
            ("time", "nan"),
            ("only", "z,1"),
            ("only", "w,1,2"),
        ]
    )
    assert shown.choices == [entry for entry in choices if entry[0] != "only"]


def test_columns_of_one_value_or_none_can_be_filtered_by(tmp_path, page):
    """Far from zero, where a slider has few digits left."""
    rows = np.zeros(20, [*((a, "<f8") for a in "xyz"), ("nothing", "<f4"), ("big", "<f8")])
    rows["x"], rows["nothing"], rows["big"] = 5e6, np.nan, 1e18
    lines = [*(f"property double {a}" for a in "xyz"), "property float nothing"]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 20", *lines]
    head += ["property double big", "end_header", ""]
    (tmp_path / "one.ply").write_bytes("\n".join(head).encode() + rows.tobytes())
    view = ResultView(page, CloudFile(tmp_path / "one.ply"))
    for name in ("x", "y", "nothing", "big"):
        view._view.cloud._filter_by.value = name
        view.draw()
        assert view._view.cloud._input.min < view._view.cloud._input.max
        assert not view._view.cloud.filter.limits
