"""Pictures of a survey: scene, hits, cloud and path."""

from __future__ import annotations

import base64
import io
import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import html
from matplotlib.collections import PatchCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image
from tests.shapes import block, level, quad

from lidarfiles.color_table import TURBO
from lidarpool.report.picture_content import planning_picture
from lidarpool.report.result_pictures import draw_path
from lidarscenario import Planning
from lidarscenario.plan import best, run_trial
from lidarsim import Cloud, Column, LidarError, Scene, SceneMesh, box
from lidarsim.columns.table import AXES, TABLE, X, Z
from lidarsim.scene.shapes import seed_objects
from lidarsim.words import shorten_name
from lidarview.render.coloring import make_coloring
from lidarview.render.hit_density import hit_density
from lidarview.render.picture_page import Page
from lidarview.render.pictures import draw_cloud, draw_hits, draw_points, draw_scene
from lidarview.render.shot import GROUND, SKY, take_shot
from lidarview.render.stage import make_axis, nice_step
from lidarview.render.surface import separate_objects
from lidarview.render.theme import SENSOR, object_colors

SIZE = (320, 200)
LEFT = slice(0, int(0.8 * SIZE[0]))  # columns beside the legend
POSES = np.array([[0, 0, 1], [0, 0, 2.0]])
NONE = np.empty((0, 2, 3))
NOWHERE = np.empty((0, 3))


@pytest.fixture(scope="module")
def scene():
    return Scene.from_meshes(seed_objects(rings=8, segments=12))


@pytest.fixture(scope="module")
def shot(scene):
    return take_shot(scene, POSES, size=SIZE, backend="numpy")


@pytest.fixture
def pixels(tmp_path):
    """Draw with a function; its picture as an array."""

    def pixels(draw, *arguments):
        draw(*arguments).save(tmp_path / "picture.png")
        with Image.open(tmp_path / "picture.png") as image:
            assert image.format == "PNG" and image.size == SIZE
            return np.asarray(image.convert("RGB"), dtype=int)

    return pixels


def colorful(image):
    """Number of pixels that are no shade of gray."""
    return int((np.ptp(image, axis=2) > 40).sum())


@pytest.mark.extended
def test_the_scene_shows_every_object_in_its_color(pixels, shot):
    image = pixels(draw_scene, shot, 9)
    for color in object_colors(6):
        hue = image / np.maximum(image.max(axis=2, keepdims=True), 1)
        alike = np.abs(hue - color / color.max()).max(axis=2) < 0.06
        assert alike[:, LEFT].sum() > 8


@pytest.mark.extended
def test_hits_color_what_was_hit_and_only_that(pixels, scene):
    shot = take_shot(scene, [], size=SIZE, backend="numpy")
    hits = np.zeros(len(scene.faces), np.int64)
    assert colorful(pixels(draw_hits, shot, hits, NOWHERE, NONE)[:, LEFT]) < 10
    hits[scene.face_object == 0] = 50
    plot = pixels(draw_hits, shot, hits, NOWHERE, NONE)[:, LEFT]
    right = shot.camera.project(scene.object_bounds[0])[0][:, 0].max()
    assert colorful(plot) > 30
    assert colorful(plot[:, int(right) + 20 :]) == 0, "the five other objects stay gray"


@pytest.mark.extended
def test_hits_on_a_wall_of_two_triangles_are_told_apart(pixels):
    """A floor of 8 by 4 meters, with hits on its left half alone: no diagonal between colors."""
    scene = Scene.from_meshes([quad("Floor", (0, 0, 0), (8, 0, 0), (8, 4, 0), (0, 4, 0))])
    shot = take_shot(scene, [], size=SIZE, backend="numpy")
    points = np.random.default_rng(0).uniform((0, 0, 0), (4, 4, 0), (2000, 3))
    image = pixels(draw_hits, shot, np.array([1000, 3000]), points, NONE)
    across = np.linspace(0.3, 7.7, 30)
    for y in (0.5, 2, 3.5):
        places = np.column_stack([across, np.full(30, y), np.zeros(30)])
        column, row = shot.camera.project(places)[0].astype(int).T
        vivid = np.ptp(image[row, column], axis=1) > 40
        assert vivid[across < 3.6].all() and not vivid[across > 5].any()


@pytest.mark.extended
def test_objects_that_touch_do_not_stipple(pixels):
    """A slab whose top lies in the plane of that of a block within it has one color there."""
    scene = Scene.from_meshes([box("Slab", (8, 8, 1)), box("Block", (4, 4, 1))])
    shot = take_shot(scene, [], size=(640, 400), backend="numpy")
    low, high = scene.object_bounds[1]
    x, y = np.meshgrid(*np.linspace(low[:2] + 0.2, high[:2] - 0.2, 40).T)
    top = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, high[2])])
    column, row = shot.camera.project(top)[0].astype(int).T
    owner = scene.face_object[shot.pixel_samples.triangle.reshape(400, 640)[row, column]]
    assert len(np.unique(owner)) == 1


def test_sides_move_inwards_together_though_their_triangles_share_no_vertices():
    """Each triangle of an .stl file has vertices of its own."""
    whole = block("Block", (2, 4, 6))
    corners = whole.vertices[whole.faces].reshape(-1, 3)
    loose = SceneMesh("Block", corners, np.arange(len(corners)).reshape(-1, 3))
    for mesh in (whole, loose):
        scene = Scene.from_meshes([mesh])
        moved = separate_objects(scene, scene.face_object, step=0.1)
        assert np.allclose(moved.vertices, np.sign(mesh.vertices) * [0.9, 1.9, 2.9])


def test_a_picture_within_a_page_takes_its_ink_from_there(shot):
    """Letters have colors of the page, which shows through the picture where nothing is."""
    text = draw_scene(shot, 9).svg()
    page = html.fromstring(f"<div>{text}</div>")
    assert [
        name for name in ("ink", "muted", "line", "sensor") if f"--picture-{name}," not in text
    ] == []
    assert not page.xpath("//style") and "http" not in text
    uris = [
        value for element in page.iter("image") for value in element.values() if "base64" in value
    ]
    data = base64.b64decode(uris[0].partition("base64,")[2])
    with Image.open(io.BytesIO(data)) as image:
        opacity = np.asarray(image.convert("RGBA"))[..., 3]
    assert image.size == SIZE and opacity[0, 0] == 0
    column, row = shot.camera.project([[5, 5, 0]])[0][0].astype(int)
    assert 0 < opacity[row, column] < 80, "the ground is a veil"
    assert (opacity == 255).sum() > 30, "objects hide what is behind them"


@pytest.mark.extended
def test_sample_rays_are_drawn(pixels, scene, shot):
    hits = np.zeros(len(scene.faces), np.int64)
    rays = np.array([[[0, 0, 2], [20, -20, 2]], [[0, 0, 2], [-9, 9, 2]]], np.float32)
    plain, drawn = (pixels(draw_hits, shot, hits, NOWHERE, some) for some in (NONE, rays))
    changed = np.abs(plain - drawn).max(axis=2) > 20
    column, line = shot.camera.project([[10, -10, 2]])[0][0].astype(int)
    assert changed[line - 2 : line + 3, column - 2 : column + 3].any()
    assert changed.sum() > 40


@pytest.mark.extended
def test_cloud_points_have_the_color_of_their_height(pixels, scene, shot):
    assert (
        colorful(pixels(draw_cloud, shot, Cloud(np.empty((0, 3)), {}), 0)[:, LEFT]) < 60
    )  # the sensors
    image = pixels(draw_cloud, shot, Cloud(scene.vertices, {}), 5)[:, LEFT]
    red, green, blue = np.moveaxis(image, -1, 0)
    assert ((blue > red + 60) & (blue > green)).sum() > 10  # low
    assert ((green > red + 60) & (green > blue + 60)).sum() > 10


ENERGIES = {"intensity", "signal", "amplitude"}
OF_FACTORS = np.geomspace(1, 1000, 999)  # most are small, and a few are large


@pytest.mark.parametrize("column", [*TABLE.values(), Column("a", "float32", "", "")], ids=str)
def test_only_energies_have_a_logarithmic_scale(column):
    values = OF_FACTORS.clip(max=255) if column.dtype == "uint8" else OF_FACTORS
    coloring = make_coloring(values.astype(column.dtype), column)
    assert coloring.logarithmic == (column.name in ENERGIES)
    assert coloring.logarithmic == (column.scale == "logarithmic")


def test_half_of_the_colors_are_for_half_of_the_heights():
    heights = np.append(np.full(9000, 0.1), np.linspace(0.1, 20.1, 1001))
    for column in (Z, X, TABLE["origin_z"], TABLE["range"]):
        coloring = make_coloring(heights, column)
        lower, upper = coloring.limits
        (middle,) = coloring.paint(np.array([(lower + upper) / 2]))
        assert np.array_equal(middle, TURBO[127])


@pytest.mark.extended
@pytest.mark.parametrize(
    ("lower", "upper", "marks"),
    [
        (496.985, 497.015, {"496.990", "497.000", "497.010"}),
        (0, 99_999, {"0", "20,000", "80,000"}),
        (-1, 1, {"−1.00", "0.00", "0.75"}),
        (5_400_000, 5_400_001, {"5,400,000.0", "5,400,000.2"}),
    ],
)
def test_numbers_beside_the_colors_are_whole(lower, upper, marks, scene, shot):
    points = scene.vertices.copy()
    points[:, 0] = np.linspace(lower, upper, len(points))
    figure = draw_cloud(shot, Cloud(points, {}), len(points), X).figure
    figure.draw_without_rendering()
    axis = figure.axes[0].yaxis
    assert marks <= {text.get_text() for text in axis.get_ticklabels()}
    assert not axis.get_offset_text().get_text()
    assert figure.axes[0].get_ylabel() == "x (m)"


LONGEST = max(TABLE.values(), key=lambda column: len(column.meaning) * (not column.unit)).name


@pytest.mark.extended
@pytest.mark.parametrize(
    "name", ["z", "amplitude", "normal_x", "triangle", "cause", "signal", LONGEST]
)
def test_words_of_a_column_are_complete_and_within_the_picture(name, scene, shot):
    column = TABLE[name]
    values = np.linspace(0, 250, len(scene.vertices)).astype(column.dtype)
    columns = {} if column in AXES else {column.name: values}
    figure = draw_cloud(shot, Cloud(scene.vertices, columns), len(values), column).figure
    figure.draw_without_rendering()
    texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
    assert not any("…" in text.get_text() for text in texts)
    for text in texts:
        box_px = text.get_window_extent()
        assert figure.bbox.x0 <= box_px.x0 and box_px.x1 <= figure.bbox.x1, text.get_text()
        assert figure.bbox.y0 <= box_px.y0 and box_px.y1 <= figure.bbox.y1, text.get_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("corners", "poses"),
    [
        ([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.03]], [[0, 0, 1]]),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0.3]], [[1e9, 0, 0]]),
        ([[0, 0, 0], [1e4, 0, 0], [0, 1e4, 3e3]], [[0.2, 0.2, 0.0]] * 1000),
        ([[0, 0, 0], [9, 0, 0], [0, 9, 0]], []),  # flat
        ([[0, 0, 0], [9, 0, 0], [0, 0, 9]], []),  # upright
    ],
)
def test_any_scene_and_poses_can_be_drawn(pixels, corners, poses):
    scene = Scene.from_meshes([SceneMesh("T", np.array(corners, float), np.array([[0, 1, 2]]))])
    shot = take_shot(scene, poses, size=SIZE, backend="numpy")
    assert colorful(pixels(draw_scene, shot, 9)) > 100
    assert colorful(pixels(draw_hits, shot, np.array([7]), scene.vertices, NONE)) > 100
    for points in (scene.vertices, scene.vertices[[0] * 500], np.array([[0, 0, 0], [1e7, 0, 0]])):
        pixels(draw_cloud, shot, Cloud(points, {}), 3)


def solid(k):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    place = np.array([2 * (k % 8), 2 * (k // 8), 0])
    return vertices + place, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("name", ["$\\frac{x$", "_hidden", "a\x1b]0;b\x07\nc", "\u202egnp", " "])
def test_names_from_files_are_words_and_nothing_else(name):
    scene = Scene.from_meshes([SceneMesh(name, *solid(0)), SceneMesh("plain", *solid(1))])
    page = draw_scene(take_shot(scene, [], size=SIZE, backend="numpy"), 9)
    assert html.fromstring(page.svg()).tag == "svg"
    first, second = (text.get_text() for text in page.figure.legends[0].get_texts())
    assert (len(first), second) == (len(name), "plain")
    assert first.isprintable()


@pytest.fixture(scope="module")
def planned():
    planning = Planning(
        (25, 25), (-30, -20), centers=[(5, 5), (-10, -5)], radii=2.0,
        trials=3, particles=60, iterations=40,
    )  # fmt: skip
    trials = [run_trial(planning, k) for k in range(3)]
    return planning_picture(planning, best(trials, planning), trials)


def test_the_path_plot_has_equal_axes_in_world_coordinates(planned):
    page = draw_path(planned, planned.best, np.array([500_003, 4_000_000]), (1600, 1000))
    (axes,) = page.figure.axes
    box = axes.get_window_extent()
    across = np.ptp(axes.get_xlim()) / box.width
    up = np.ptp(axes.get_ylim()) / box.height
    assert across == pytest.approx(up)
    assert axes.get_xlim()[0] <= -30 and axes.get_xlim()[1] >= 25
    offset = int(re.sub(r"\D", "", axes.get_xlabel()))  # x − 499 970 (m)
    labels = [offset + float(text.get_text()) for text in axes.get_xticklabels()]
    assert labels == (500_003 + axes.get_xticks()).tolist()


@pytest.mark.parametrize(("aside_m", "names"), [(0.0, 0), (0.01, 0), (8.0, 1)])
def test_only_paths_that_can_be_seen_beside_the_best_are_in_the_legend(planned, aside_m, names):
    best_corners = planned.best.corners
    trials = [best_corners[1:-1], best_corners[1:-1] + np.array([0, aside_m])]
    path = replace(planned.best, trials=trials)
    page = draw_path(planned, path, np.zeros(2), (1600, 1000))
    texts = [text.get_text() for text in page.figure.legends[0].get_texts()]
    assert texts == ["Best path", *["1 other trial"] * names, "Obstacle"]


def test_a_picture_that_cannot_be_written_is_named(tmp_path, shot, monkeypatch):
    with pytest.raises(LidarError, match=r"gone.*Choose an existing, writable folder"):
        draw_scene(shot, 9).save(tmp_path / "gone" / "scene.png")

    def full_disk(figure, file, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(LidarError, match=r"scene\.png.*No space left"):
        draw_scene(shot, 9).save(tmp_path / "scene.png")


def sheet(n):
    """A square of n x n cells, one meter wide."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    number = np.arange(x.size).reshape(n + 1, n + 1)
    a, b, c, d = (
        q.ravel() for q in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Scene.from_meshes([SceneMesh("Sheet", vertices, faces)])


SHEET = sheet(6)
AREA = 1 / len(SHEET.faces)


@pytest.mark.extended
@given(st.lists(st.integers(0, 40), min_size=72, max_size=72))
def test_sharing_hits_keeps_their_number(counts):
    density = hit_density(SHEET, np.array(counts))
    assert (density >= 0).all()
    assert (density * AREA).sum() == pytest.approx(sum(counts))


@given(
    low=st.floats(-1e4, 1e4), width=st.floats(0.01, 1e4), origin=st.integers(-6_000_000, 6_000_000)
)
def test_labels_and_offset_give_the_world_coordinate(low, width, origin):
    step = nice_step(width / 6)
    one = make_axis("x", low, low + width, step, float(origin))
    slack = 1e-2 * step
    said = re.fullmatch(r"x(?: ([−+]) ([\d\u2009]+))? \(m\)", one.title)
    offset = float((said[2] or "0").replace("\u2009", "")) * (-1 if said[1] == "+" else 1)
    assert ((one.ticks >= low - slack) & (one.ticks <= low + width + slack)).all()
    for tick, label in zip(one.ticks, one.labels, strict=True):
        assert float(label.replace("−", "-")) + offset == pytest.approx(
            tick + origin, abs=1e-5 + 1e-9 * abs(origin)
        )
        assert len(label) <= 8


@pytest.fixture(scope="module")
def row():
    """A near, a middle and a far box, one behind the other along the camera's view."""
    towards = np.array([np.cos(np.radians(-62)), np.sin(np.radians(-62)), 0.0])
    return Scene.from_meshes(
        [
            block(name, (2, 2, 2), k * 2.2 * towards)
            for name, k in (("near", 1), ("middle", 0), ("far", -1))
        ]
    )


@pytest.fixture(scope="module")
def row_shot(row):
    return take_shot(row, [], size=SIZE, backend="numpy")


def closest_hit(scene, eye, ray):
    """Distance and triangle by the textbook: every triangle's plane, then three half-planes."""
    best = (np.inf, -1)
    for number, (a, b, c) in enumerate(scene.vertices[scene.faces]):
        normal = np.cross(b - a, c - a)
        if abs(normal @ ray) < 1e-12:
            continue
        t = normal @ (a - eye) / (normal @ ray)
        p = eye + t * ray
        inside = all(np.cross(q - o, p - o) @ normal >= -1e-9 for o, q in ((a, b), (b, c), (c, a)))
        if t > 0 and inside and t < best[0]:
            best = (t, number)
    return best


@pytest.mark.extended
def test_each_pixel_shows_the_nearest_thing(row, row_shot):
    camera = row_shot.camera
    stage = row_shot.stage
    rng = np.random.default_rng(3)
    columns = rng.integers(0, SIZE[0], 150)
    rows = rng.integers(0, SIZE[1], 150)
    kinds = set()
    for column, line in zip(columns, rows, strict=True):
        ray = camera.rays([[column + 0.5, line + 0.5]])[0]
        distance, triangle = closest_hit(row, camera.eye, ray)
        flat = (stage.level - camera.eye[2]) / ray[2]
        place = camera.eye[:2] + flat * ray[:2]
        if flat < distance and ((place > stage.ground[0]) & (place < stage.ground[1])).all():
            distance = flat
            triangle = GROUND
        kinds.add(row.face_object[triangle] if triangle >= 0 else int(triangle))
        assert row_shot.depth[line, column] == pytest.approx(distance, rel=1e-5)
    assert kinds == {0, 1, 2, GROUND, SKY}


def test_points_behind_a_box_are_hidden_and_before_it_seen(row, row_shot):
    near = row.object_bounds[0].mean(axis=0)
    back = -row_shot.camera.axes[2]
    _, seen = row_shot.project_visible(np.stack([near + 3 * back, near - 3 * back, near]))
    assert seen.tolist() == [True, False, False]


def drawn(row_shot, points):
    """Whether points, each by itself, leave something in the picture."""
    blank = np.ones((*SIZE[::-1], 4), np.float32)
    return np.array(
        [(draw_points(blank, row_shot, p[None], np.zeros((1, 3))) < 1).any() for p in points]
    )


def room():
    """A closed hall with thick walls and a roof, a crate and a lamp in it."""
    shell = [
        block("Hall outside", (12, 20, 4), (0, 0, 2)),
        block("Hall inside", (11.4, 19.4, 3.4), (0, 0, 2)),
    ]
    return [*shell, block("Crate", (1.5, 1.5, 1.5), (2, -4, 1.05))]


def test_the_inside_of_a_closed_hall_is_shown():
    scene = Scene.from_meshes(room())
    poses = np.array([[0, 0.5, 1.5], [1, 6, 1.5]])
    row_shot = take_shot(scene, poses, size=SIZE, backend="numpy")
    _, seen = row_shot.project_visible(np.concatenate([poses, [[2, -4, 1.85], [-3, -5, 0.35]]]))
    assert seen.all(), "sensors, the crate's top and the floor"
    far_wall = row_shot.camera.axes[2] * 5
    near_wall = -row_shot.camera.axes[2] * 5
    wall = (
        np.array([np.sign(far_wall[0]) * 5.69, 3.0, 1.5]),
        np.array([np.sign(near_wall[0]) * 5.69, 3.0, 1.5]),
    )
    assert drawn(row_shot, np.array(wall)).tolist() == [True, False]


def test_the_hall_stays_closed_where_the_sensor_is_outside():
    scene = Scene.from_meshes(room())
    row_shot = take_shot(scene, [[0, 30, 1.5]], size=SIZE, backend="numpy")
    roof_seen = row_shot.project_visible([[0, 0, 4.0]])[1]
    floor_seen = row_shot.project_visible([[-3, -5, 0.3]])[1]
    assert roof_seen.all() and not floor_seen.any()


def test_the_legend_names_the_largest_twelve_groups_and_counts_the_others():
    boxes = [block(f"box {k}", (0.1 + 0.01 * k,) * 3, (k % 5, k // 5, 0.0)) for k in range(20)]
    page = draw_scene(take_shot(Scene.from_meshes(boxes), [], size=SIZE, backend="numpy"), 9)
    (legend,) = page.figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == [*(str(k) for k in range(8, 20)), "8 other objects"]
    faces = {tuple(np.round(to_rgb(h.get_color()), 3)) for h in legend.legend_handles}
    assert len(faces) == 13


def test_rays_have_a_row_in_the_legend_and_no_color_of_the_scale(scene):
    shot = take_shot(scene, [[0, 0, 2]], size=SIZE, backend="numpy")
    page = draw_hits(shot, np.ones(len(scene.faces), np.int64), NOWHERE, NONE)
    (legend,) = page.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "Sensor position", "Some of the rays",
    ]  # fmt: skip
    assert np.abs(TURBO - to_rgb(SENSOR)).max(axis=1).min() > 0.2


STREET = [
    level("ground", 0, 100),
    level("pavement", 0.1, 80),
    *(block(f"box {k}", (0.4 + 0.01 * k,) * 3, (k % 5, k // 5, 0.5)) for k in range(15)),
    block("far", (4, 4, 3), (-80, 0, 1.5)),
]
DRIVE = np.array([[-2.0, 0, 2], [2, 0, 2]])


@pytest.fixture(scope="module")
def driven():
    """A drive of 4 m, whose surroundings are shown: 54 by 50 m of 200 by 200 m."""
    scene = Scene.from_meshes(STREET)
    way = {"paths": [DRIVE], "trajectories": [DRIVE], "models": "A"}
    return take_shot(scene, DRIVE[:1], size=SIZE, backend="numpy", **way)


def texts(page):
    return [text.get_text() for text in page.figure.findobj(Text)]


def labels(page):
    (legend,) = page.figure.legends
    return dict(zip((t.get_text() for t in legend.get_texts()), legend.legend_handles, strict=True))


def test_rays_of_a_drive_do_not_cover_what_was_hit_most(driven, pixels):
    hits = np.zeros(int(driven.part.parents.max()) + 1, np.int64)
    rays = np.array([[[0, 0, 2], [9, -9, 0.1]]], np.float32)
    plain, drawn = (pixels(draw_hits, driven, hits, NOWHERE, some) for some in (NONE, rays))
    assert np.array_equal(plain, drawn)
    rows = labels(draw_hits(driven, hits, NOWHERE, rays))
    assert {name: handle.get_marker() for name, handle in rows.items()} == {
        "Sensor position": "o", "Sensor path": "_",
    }  # fmt: skip


def test_counts_say_how_much_of_them_is_in_the_part_shown(driven):
    """Of four points one is above the part, one beside it, and one below the ground of noise."""
    points = np.array([[1, 1, -0.01], [2, 2, 0], [3, 3, 60], [90, 0, 0.0]])
    hits = np.zeros(int(driven.part.parents.max()) + 1, np.int64)
    hits[0] = 8
    cloud = Cloud(points, {})
    assert "8 hits, 50% of them in the part shown · 1 sensor position" in texts(
        draw_hits(driven, hits, points, NONE)
    )
    assert "4 points, 50% of them in the part shown · 1 sensor position" in texts(
        draw_cloud(driven, cloud, 4)
    )
    lines = texts(draw_scene(driven, 9))
    assert "18 objects, 17 of them in the part shown · 9 triangles · 1 sensor position" in lines
    assert "part shown: 54 × 50 m around the trajectories, below z = 3 m · A" in lines


def test_counts_of_a_whole_scene_mention_no_part(scene, shot):
    hits = np.ones(len(scene.faces), np.int64)
    words = f"{len(hits):,} hits · {len(POSES)} sensor positions"
    assert words in texts(draw_hits(shot, hits, scene.vertices, NONE))


def test_fewer_points_than_hits_are_explained_on_both_pictures(scene, shot):
    hits = np.zeros(len(scene.faces), np.int64)
    hits[0] = 4926
    sensors = f"{len(POSES)} sensor positions"
    assert f"4,926 hits · one in 5 hits of each scan is in the cloud · {sensors}" in texts(
        draw_hits(shot, hits, NOWHERE, NONE, keep_every=5)
    )
    assert f"995 points · one in 5 hits of each scan · {sensors}" in texts(
        draw_cloud(shot, Cloud(scene.vertices, {}), 995, keep_every=5)
    )


def test_floors_and_other_objects_are_told_apart(driven):
    """Their colors differ by at least 0.1 in OKLab, ten times what is just noticeable."""
    rows = labels(draw_scene(driven, 9))
    named = ("ground", "pavement", "5 other objects", "Sensor path")
    colors = [oklab(to_rgb(rows[name].get_color())) for name in named]
    for a, b in itertools.combinations(colors, 2):
        assert np.linalg.norm(a - b) > 0.1


def oklab(color):
    """Convert an sRGB color from 0 to 1 to OKLab (Ottosson, 2020)."""
    srgb = np.asarray(color)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    lms = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ] @ linear
    return np.array([
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]) @ np.cbrt(lms)  # fmt: skip


@pytest.mark.parametrize("clearance_m", [0.0, -0.1])
def test_an_obstacle_is_whole_beside_a_path_without_collisions(planned, clearance_m):
    page = draw_path(
        planned, replace(planned.best, clearance_m=clearance_m), np.zeros(2), (1600, 1000)
    )
    (axes,) = page.figure.axes
    discs = next(c for c in axes.collections if isinstance(c, PatchCollection))
    path = next(line for line in axes.lines if len(line.get_xdata()) > 1)
    assert (discs.zorder > path.zorder) == (clearance_m >= 0)


LONG = "Warehouse shelf, left row"


def test_a_long_name_has_two_lines_in_the_legend_and_is_complete():
    scene = Scene.from_meshes([SceneMesh(LONG, *solid(0)), SceneMesh("x" * 60, *solid(1))])
    page = draw_scene(take_shot(scene, [], size=SIZE, backend="numpy"), 9)
    first, second = labels(page)
    assert first == "Warehouse shelf,\nleft row"
    assert second.replace("\n", "") == shorten_name("x" * 60, 36)


def test_long_details_are_divided_at_their_dots():
    page = Page((1600, 1000))
    details = [f"{letter * 50}" for letter in "abcd"]
    page.title("Title", " · ".join(details), "short")
    assert texts(page)[:4] == ["Title", " · ".join(details[:2]), " · ".join(details[2:]), "short"]


def test_title_and_legend_are_also_text_around_the_drawing(scene, shot):
    """Text of a phone's size; what it replaces in the drawing has a class of its own."""
    hits = np.ones(len(scene.faces), np.int64)
    page = html.fromstring(f"<main>{draw_hits(shot, hits, NOWHERE, NONE).html()}</main>")
    assert [child.get("class") for child in page] == ["picture-title", None, "picture-key"]
    title, drawing, key = page
    assert title.xpath("h2/text()") == ["Hits"]
    assert title.xpath("p/text()") == [f"{len(hits):,} hits · {len(POSES)} sensor positions"]
    scale, entries = key
    assert scale.xpath("p/text()")[0].startswith("hits per square meter (gray: fewer than ")
    low, middle, high = (float(text.replace(",", "")) for text in scale.xpath("span/text()"))
    assert middle == pytest.approx(np.sqrt(low * high), rel=0.02)  # the scale is logarithmic
    assert entries.xpath("li/i/@class") == ["dot", "line"]
    assert entries.xpath("li/text()") == ["Sensor positions", "Some of the rays"]
    classes = [element.get("class") for element in drawing.iter("g") if element.get("class")]
    assert classes.count("picture-margin") == 4  # title, details, color bar and legend
    assert classes.count("picture-label") >= 9  # three axes


def test_labels_of_a_map_are_enlarged_on_small_screens(planned):
    text = draw_path(planned, planned.best, np.zeros(2), (1600, 1000)).html()
    drawing = html.fromstring(f"<main>{text}</main>")[1]
    classes = [element.get("class") for element in drawing.iter("g") if element.get("class")]
    assert classes.count("picture-label") >= 12  # two titles and the ticks of two axes
    assert {"picture-label-left", "picture-label-right"} <= {*classes}  # start and target
