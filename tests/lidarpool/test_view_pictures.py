import base64
import io
import re

import numpy as np
import pytest
from lxml import html
from matplotlib.figure import Figure
from PIL import Image

from lidarpool import Cloud, LidarpoolError
from lidarpool.plan import Planning, best, run_trial
from lidarpool.render.pictures import draw_cloud, draw_hits, draw_scene
from lidarpool.render.shot import take_shot
from lidarpool.render.theme import object_colours
from lidarpool.report.pictures import draw_path
from lidarpool.scene.actors import box
from lidarpool.scene.mesh import Mesh
from lidarpool.scene.scene import Scene
from lidarpool.scene.shapes import seed_objects

SIZE = (320, 200)
LEFT = slice(0, int(0.8 * SIZE[0]))  # columns beside the legend
POSES = np.array([[0, 0, 1], [0, 0, 2.0]])
NONE, NOWHERE = np.empty((0, 2, 3)), np.empty((0, 3))


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


def colourful(image):
    """Number of pixels that are no shade of grey."""
    return int((np.ptp(image, axis=2) > 40).sum())


def test_the_scene_shows_every_object_in_its_colour(pixels, shot):
    image = pixels(draw_scene, shot, 9)
    for colour in object_colours(6):
        hue = image / np.maximum(image.max(axis=2, keepdims=True), 1)
        alike = np.abs(hue - colour / colour.max()).max(axis=2) < 0.06
        assert alike[:, LEFT].sum() > 8


def test_hits_colour_what_was_hit_and_only_that(pixels, scene):
    shot = take_shot(scene, [], size=SIZE, backend="numpy")
    hits = np.zeros(len(scene.faces), np.int64)
    assert colourful(pixels(draw_hits, shot, hits, NOWHERE, NONE)[:, LEFT]) < 10
    hits[scene.face_object == 0] = 50
    plot = pixels(draw_hits, shot, hits, NOWHERE, NONE)[:, LEFT]
    right = shot.camera.project(scene.object_bounds[0])[0][:, 0].max()
    assert colourful(plot) > 30
    assert colourful(plot[:, int(right) + 20 :]) == 0, "the five other objects stay grey"


def test_shares_of_hits_are_counted_whole(scene):
    """Counts of instances are shared among their triangles, so their sum may be just below."""
    shot = take_shot(scene, [], size=SIZE, backend="numpy")
    hits = np.zeros(len(scene.faces))
    hits[:3] = 1 / 3 - 1e-12
    texts = [text.get_text() for text in draw_hits(shot, hits, NOWHERE, NONE).figure.texts]
    assert any(text.startswith("1 hit ") for text in texts)


def test_hits_on_a_wall_of_two_triangles_are_told_apart(pixels):
    """A floor of 8 by 4 metres, with hits on its left half alone: no diagonal between colours."""
    corners = np.array([[0, 0, 0], [8, 0, 0], [8, 4, 0], [0, 4, 0]], float)
    scene = Scene.from_meshes([Mesh("Floor", corners, np.array([[0, 1, 2], [0, 2, 3]]))])
    shot = take_shot(scene, [], size=SIZE, backend="numpy")
    points = np.random.default_rng(0).uniform((0, 0, 0), (4, 4, 0), (2000, 3))
    image = pixels(draw_hits, shot, np.array([1000, 3000]), points, NONE)
    across = np.linspace(0.3, 7.7, 30)
    for y in (0.5, 2, 3.5):
        places = np.column_stack([across, np.full(30, y), np.zeros(30)])
        column, row = shot.camera.project(places)[0].astype(int).T
        vivid = np.ptp(image[row, column], axis=1) > 40
        assert vivid[across < 3.6].all() and not vivid[across > 5].any()


def test_objects_that_touch_do_not_stipple(pixels):
    """A slab whose top lies in the plane of that of a block within it has one colour there."""
    scene = Scene.from_meshes([box("Slab", (8, 8, 1)), box("Block", (4, 4, 1))])
    shot = take_shot(scene, [], size=(640, 400), backend="numpy")
    low, high = scene.object_bounds[1]
    x, y = np.meshgrid(*np.linspace(low[:2] + 0.2, high[:2] - 0.2, 40).T)
    top = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, high[2])])
    column, row = shot.camera.project(top)[0].astype(int).T
    owner = scene.face_object[shot.whole.triangle.reshape(400, 640)[row, column]]
    assert len(np.unique(owner)) == 1


def test_a_picture_within_a_page_takes_its_ink_from_there(shot):
    """Letters have colours of the page, which shows through the picture where nothing is."""
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


def test_sample_rays_are_drawn(pixels, scene, shot):
    hits = np.zeros(len(scene.faces), np.int64)
    rays = np.array([[[0, 0, 2], [20, -20, 2]], [[0, 0, 2], [-9, 9, 2]]], np.float32)
    plain, drawn = (pixels(draw_hits, shot, hits, NOWHERE, some) for some in (NONE, rays))
    changed = np.abs(plain - drawn).max(axis=2) > 20
    column, line = shot.camera.project([[10, -10, 2]])[0][0].astype(int)
    assert changed[line - 2 : line + 3, column - 2 : column + 3].any()
    assert changed.sum() > 40


def test_cloud_points_have_the_colour_of_their_height(pixels, scene, shot):
    assert (
        colourful(pixels(draw_cloud, shot, Cloud(np.empty((0, 3)), {}), 0)[:, LEFT]) < 60
    )  # the sensors
    image = pixels(draw_cloud, shot, Cloud(scene.vertices, {}), 5)[:, LEFT]
    red, green, blue = np.moveaxis(image, -1, 0)
    assert ((blue > red + 60) & (blue > green)).sum() > 10  # low
    assert ((green > red + 60) & (green > blue + 60)).sum() > 10


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
    scene = Scene.from_meshes([Mesh("T", np.array(corners, float), np.array([[0, 1, 2]]))])
    shot = take_shot(scene, poses, size=SIZE, backend="numpy")
    assert colourful(pixels(draw_scene, shot, 9)) > 100
    assert colourful(pixels(draw_hits, shot, np.array([7]), scene.vertices, NONE)) > 100
    for points in (scene.vertices, scene.vertices[[0] * 500], np.array([[0, 0, 0], [1e7, 0, 0]])):
        pixels(draw_cloud, shot, Cloud(points, {}), 3)


def solid(k):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    place = np.array([2 * (k % 8), 2 * (k // 8), 0])
    return vertices + place, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_many_objects_fit_the_legend():
    meshes = [Mesh(f"site_{k}_object_with_a_long_name", *solid(k)) for k in range(60)]
    shot = take_shot(Scene.from_meshes(meshes), [], size=SIZE, backend="numpy")
    (legend,) = draw_scene(shot, 9).figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert len(names) == 32 and names[-1] == "and 30 more"
    assert max(map(len, names)) <= 18


def test_copies_share_a_row_of_the_legend_and_a_colour():
    """But actors have one each."""
    names = ["Hall", *["Crate"] * 57, "Crate", "Van"]
    meshes = [Mesh(name, *solid(k)) for k, name in enumerate(names)]
    shot = take_shot(Scene.from_meshes(meshes), [], actors=2, size=SIZE, backend="numpy")
    (legend,) = draw_scene(shot, 9).figure.legends
    rows = [text.get_text() for text in legend.get_texts()]
    assert rows == ["Crate.58", "Van", "Hall", "Crate (57)", "Sensor"]
    houses = [f"House {k}" for k in range(50)]
    meshes = [Mesh(name, *solid(k)) for k, name in enumerate([*houses, *["Oak"] * 9, "Van"])]
    shot = take_shot(Scene.from_meshes(meshes), [], actors=1, size=SIZE, backend="numpy")
    rows = [text.get_text() for text in draw_scene(shot, 9).figure.legends[0].get_texts()]
    assert rows[:3] == ["Van", "Oak (9)", "House 0"] and rows[-1] == "and 22 more"


@pytest.mark.parametrize("name", ["$\\frac{x$", "_hidden", "a\x1b]0;b\x07\nc", "\u202egnp", " "])
def test_names_from_files_are_words_and_nothing_else(name):
    scene = Scene.from_meshes([Mesh(name, *solid(0)), Mesh("plain", *solid(1))])
    page = draw_scene(take_shot(scene, [], size=SIZE, backend="numpy"), 9)
    assert html.fromstring(page.svg()).tag == "svg"
    first, second, _ = (text.get_text() for text in page.figure.legends[0].get_texts())
    assert (len(first), second) == (len(name), "plain")
    assert first.isprintable()


@pytest.fixture(scope="module")
def planned():
    planning = Planning(
        (25, 25), (-30, -20), centres=[(5, 5), (-10, -5)], radii=2.0,
        trials=3, particles=60, iterations=40,
    )  # fmt: skip
    trials = [run_trial(planning, k) for k in range(3)]
    return planning, best(trials, planning), [trial.waypoints for trial in trials]


def test_the_path_plot_has_equal_axes_in_world_coordinates(planned):
    page = draw_path(*planned, np.array([500_003, 4_000_000]), (1600, 1000))
    (axes,) = page.figure.axes
    box = axes.get_window_extent()
    across, up = np.ptp(axes.get_xlim()) / box.width, np.ptp(axes.get_ylim()) / box.height
    assert across == pytest.approx(up)
    assert axes.get_xlim()[0] <= -30 and axes.get_xlim()[1] >= 25
    offset = int(re.sub(r"\D", "", axes.get_xlabel()))  # x − 499 970 (m)
    labels = [offset + float(text.get_text()) for text in axes.get_xticklabels()]
    assert labels == (500_003 + axes.get_xticks()).tolist()


def test_a_picture_that_cannot_be_written_is_named(tmp_path, shot, monkeypatch):
    with pytest.raises(LidarpoolError, match=r"gone.*choose a folder"):
        draw_scene(shot, 9).save(tmp_path / "gone" / "scene.png")

    def full_disk(figure, file, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(LidarpoolError, match=r"scene\.png.*No space left"):
        draw_scene(shot, 9).save(tmp_path / "scene.png")
