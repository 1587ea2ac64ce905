import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from lidarpool import Cloud, LidarpoolError
from lidarpool.plan import Planning, best, run_trial
from lidarpool.render.page import Page
from lidarpool.render.pictures import draw_cloud, draw_intensity, draw_scene
from lidarpool.render.shot import take_shot
from lidarpool.render.theme import object_colours
from lidarpool.report.path_picture import draw_path
from lidarpool.scene.mesh import Mesh
from lidarpool.scene.scene import Scene
from lidarpool.scene.shapes import seed_objects

SIZE = (320, 200)
LEFT = slice(0, int(0.8 * SIZE[0]))  # columns beside the legend
POSES = np.array([[0, 0, 1], [0, 0, 2.0]])
NONE = np.empty((0, 2, 3))


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
        draw(tmp_path / "picture.png", *arguments)
        with Image.open(tmp_path / "picture.png") as image:
            assert image.format == "PNG" and image.size == SIZE
            return np.asarray(image.convert("RGB"), dtype=int)

    return pixels


@pytest.fixture
def figures(monkeypatch):
    """Figures of the pages that are saved."""
    kept = []
    monkeypatch.setattr(Page, "save", lambda page, path: kept.append(page.figure))
    return kept


def colourful(image):
    """Number of pixels that are no shade of grey."""
    return int((np.ptp(image, axis=2) > 40).sum())


def test_the_scene_shows_every_object_in_its_colour(pixels, shot):
    image = pixels(draw_scene, shot, 9)
    for colour in object_colours(6):
        hue = image / np.maximum(image.max(axis=2, keepdims=True), 1)
        alike = np.abs(hue - colour / colour.max()).max(axis=2) < 0.06
        assert alike[:, LEFT].sum() > 8


def test_intensity_colours_what_was_hit_and_only_that(pixels, scene):
    shot = take_shot(scene, [], size=SIZE, backend="numpy")
    hits = np.zeros(len(scene.faces), np.int64)
    assert colourful(pixels(draw_intensity, shot, hits, NONE, 9)[:, LEFT]) < 10
    hits[scene.face_object == 0] = 50
    plot = pixels(draw_intensity, shot, hits, NONE, 9)[:, LEFT]
    right = shot.camera.project(scene.object_bounds[0])[0][:, 0].max()
    assert colourful(plot) > 30
    assert colourful(plot[:, int(right) + 20 :]) == 0, "the five other objects stay grey"


def test_sample_rays_are_drawn(pixels, scene, shot):
    hits = np.zeros(len(scene.faces), np.int64)
    rays = np.array([[[0, 0, 2], [20, -20, 2]], [[0, 0, 2], [-9, 9, 2]]], np.float32)
    plain, drawn = (pixels(draw_intensity, shot, hits, some, 9) for some in (NONE, rays))
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
    assert colourful(pixels(draw_intensity, shot, np.array([7]), NONE, 9)) > 100
    for points in (scene.vertices, scene.vertices[[0] * 500], np.array([[0, 0, 0], [1e7, 0, 0]])):
        pixels(draw_cloud, shot, Cloud(points, {}), 3)


def solid(k):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    place = np.array([2 * (k % 8), 2 * (k // 8), 0])
    return vertices + place, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_many_objects_fit_the_legend(figures, tmp_path):
    meshes = [Mesh(f"site_{k}_object_with_a_long_name", *solid(k)) for k in range(60)]
    shot = take_shot(Scene.from_meshes(meshes), [], size=SIZE, backend="numpy")
    draw_scene(tmp_path, shot, 9)
    names = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert len(names) == 32 and names[-1] == "and 30 more"
    assert max(map(len, names)) <= 18


@pytest.mark.parametrize("name", ["$\\frac{x$", "_hidden", "a\x1b]0;b\x07\nc", "\u202egnp", " "])
def test_names_from_files_are_words_and_nothing_else(tmp_path, figures, name):
    scene = Scene.from_meshes([Mesh(name, *solid(0)), Mesh("plain", *solid(1))])
    draw_scene(tmp_path, take_shot(scene, [], size=SIZE, backend="numpy"), 9)
    figures[0].draw_without_rendering()
    first, second, _ = (text.get_text() for text in figures[0].legends[0].get_texts())
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


def test_the_path_plot_has_equal_axes_in_world_coordinates(tmp_path, planned, figures):
    draw_path(tmp_path, *planned, np.array([500_003, 4_000_000]), (1600, 1000))
    (axes,) = figures[0].axes
    box = axes.get_window_extent()
    across, up = np.ptp(axes.get_xlim()) / box.width, np.ptp(axes.get_ylim()) / box.height
    assert across == pytest.approx(up)
    assert axes.get_xlim()[0] <= -30 and axes.get_xlim()[1] >= 25
    offset = int(re.sub(r"\D", "", axes.get_xlabel()))  # x − 499 970 (m)
    labels = [offset + float(text.get_text()) for text in axes.get_xticklabels()]
    assert labels == (500_003 + axes.get_xticks()).tolist()


def test_a_picture_that_cannot_be_written_is_named(tmp_path, shot, monkeypatch):
    with pytest.raises(LidarpoolError, match=r"gone.*Choose a folder"):
        draw_scene(tmp_path / "gone" / "scene.png", shot, 9)

    def full_disk(figure, file, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(LidarpoolError, match=r"scene\.png.*No space left"):
        draw_scene(tmp_path / "scene.png", shot, 9)
