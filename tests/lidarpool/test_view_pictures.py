import inspect
import re

import numpy as np
import pytest
from PIL import Image

from lidarpool import LidarpoolError
from lidarpool.plan import Plan, Planning, best, run_trial
from lidarpool.render.captions import facts, without_common_prefix
from lidarpool.render.cloud_picture import draw_cloud
from lidarpool.render.intensity_picture import draw_intensity
from lidarpool.render.page import shortened
from lidarpool.render.scene_picture import draw_scene
from lidarpool.render.shot import take_shot
from lidarpool.render.theme import object_colours
from lidarpool.report.path_picture import draw_path
from lidarpool.scene.mesh import Mesh
from lidarpool.scene.scene import Scene
from lidarpool.scene.shapes import seed_objects

SIZE = (320, 200)
SMALL = {"size": SIZE, "backend": "numpy"}
POSES = np.array([[0, 0, 1], [0, 0, 2.0]])


@pytest.fixture(scope="module")
def scene():
    return Scene.from_meshes(seed_objects(rings=8, segments=12))


@pytest.fixture(scope="module")
def shot(scene):
    return take_shot(scene, POSES, **SMALL)


def triangle(size=1.0, at=(0.0, 0.0, 0.0)):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.3]])
    return Scene.from_meshes(
        [Mesh("Triangle", corners * size + np.array(at), np.array([[0, 1, 2]]))]
    )


def pixels(path, size=SIZE):
    with Image.open(path) as image:
        image.load()
        assert image.format == "PNG" and image.size == size
        return np.asarray(image.convert("RGB"), dtype=int)


def colourful(image):
    """Number of pixels that are no shade of grey."""
    return int((np.ptp(image, axis=2) > 40).sum())


def test_the_scene_shows_every_object_in_its_colour(tmp_path, scene, shot):
    path = draw_scene(tmp_path / "scene.png", scene, POSES, shot=shot, size=SIZE)
    image = pixels(path)
    for colour in object_colours(6):
        hue = image / np.maximum(image.max(axis=2, keepdims=True), 1)
        alike = np.abs(hue - colour / colour.max()).max(axis=2) < 0.06
        assert alike[:, : int(0.8 * SIZE[0])].sum() > 8, "beside its entry in the legend"
    assert list(tmp_path.iterdir()) == [path], "no temporary file is left"


def test_intensity_colours_what_was_hit_and_only_that(tmp_path, scene, shot):
    hits = np.zeros(len(scene.faces))
    none = pixels(draw_intensity(tmp_path / "none.png", scene, hits, shot=shot, size=SIZE))
    assert colourful(none) == 0
    hits[scene.face_object == 0] = 50
    some = pixels(draw_intensity(tmp_path / "some.png", scene, hits, shot=shot, size=SIZE))
    right = shot.camera.project(scene.object_bounds[0])[0][:, 0].max()
    plot = some[:, : int(0.8 * SIZE[0])]
    assert colourful(plot) > 30
    assert colourful(plot[:, int(right) + 20 :]) == 0, "the five other objects stay grey"


def test_sample_rays_are_drawn(tmp_path, scene, shot):
    hits = np.zeros(len(scene.faces))
    rays = np.array(
        [[[0, 0, 2], [20, -20, 2]], [[0, 0, 2], [np.inf, 0, 0]], [[0, 0, 2], [-9, 9, 2]]]
    )
    plain = pixels(draw_intensity(tmp_path / "a.png", scene, hits, shot=shot, size=SIZE))
    drawn = pixels(draw_intensity(tmp_path / "b.png", scene, hits, (), rays, shot=shot, size=SIZE))
    changed = np.abs(plain - drawn).max(axis=2) > 20
    middle = shot.camera.project([[10, -10, 2]])[0][0].astype(int)
    assert changed[middle[1] - 2 : middle[1] + 3, middle[0] - 2 : middle[0] + 3].any()
    assert changed.sum() > 60


def test_cloud_points_have_the_colour_of_their_height_or_object(tmp_path, scene, shot):
    points = scene.vertices[::5]
    owners = np.zeros(len(points), dtype=np.int32)
    height = pixels(draw_cloud(tmp_path / "h.png", points, scene=scene, shot=shot, size=SIZE))
    by_object = draw_cloud(
        tmp_path / "o.png", points, POSES, objects=owners, scene=scene, shot=shot, size=SIZE
    )
    left = slice(0, int(0.8 * SIZE[0]))
    assert colourful(height[:, left]) > 50
    assert colourful(pixels(by_object)[:, left]) > 50
    assert (height != pixels(by_object)).any()


def test_a_cloud_needs_no_scene(tmp_path):
    points = np.random.default_rng(0).uniform(-5, 5, (3000, 3))
    points += np.array([500_000, 5_400_000, 200])
    image = pixels(draw_cloud(tmp_path / "c.png", points, size=SIZE))
    assert colourful(image[:, : int(0.8 * SIZE[0])]) > 1000


def test_far_coordinates_give_the_same_picture_but_for_the_labels(tmp_path):
    far = np.array([500_000.0, 5_400_000.0, 250.0])
    near_scene, far_scene = triangle(40), triangle(40, far)
    near_poses = np.array([[5.0, 5.0, 2.0]])
    near = take_shot(near_scene, near_poses, **SMALL)
    there = take_shot(far_scene, far + near_poses, **SMALL)
    a, b = near.depth, there.depth
    assert (np.isfinite(a) == np.isfinite(b)).mean() > 0.99
    both = np.isfinite(a) & np.isfinite(b)
    np.testing.assert_allclose(np.median(np.abs(a[both] - b[both])), 0, atol=0.04)


def test_the_same_input_gives_the_same_bytes(tmp_path, scene):
    rays = np.array([[[0, 0, 2], [20, -20, 2]]])
    hits = np.arange(len(scene.faces)) % 7
    for name in ("a", "b"):
        draw_scene(tmp_path / f"{name}1.png", scene, POSES, **SMALL)
        draw_intensity(tmp_path / f"{name}2.png", scene, hits, POSES, rays, **SMALL)
        draw_cloud(tmp_path / f"{name}3.png", scene.vertices, POSES, scene=scene, **SMALL)
    for k in "123":
        assert (tmp_path / f"a{k}.png").read_bytes() == (tmp_path / f"b{k}.png").read_bytes()


def test_a_dark_page_is_dark(tmp_path, scene, shot):
    light = pixels(draw_scene(tmp_path / "l.png", scene, POSES, shot=shot, size=SIZE))
    dark = pixels(draw_scene(tmp_path / "d.png", scene, POSES, shot=shot, size=SIZE, dark=True))
    assert light[0, 0].min() > 240 and dark[0, 0].max() < 40


def test_backends_draw_the_same_picture(scene):
    pytest.importorskip("open3d", reason="the embree backend needs Open3D")
    one, other = (take_shot(scene, POSES, size=SIZE, backend=b) for b in ("numpy", "embree"))
    same = np.isclose(one.depth, other.depth, rtol=1e-4) | (
        np.isinf(one.depth) & np.isinf(other.depth)
    )
    assert one.depth.shape == other.depth.shape and same.mean() > 0.998


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("size", "poses"),
    [
        (0.1, [[0, 0, 1]]),
        (1.0, []),
        (1.0, [[NAN, 0, 0], [0, INF, 0]]),
        (1.0, [[1e9, 0, 0]]),
        (10_000.0, [[0.2, 0.2, 0.0]] * 1000),
    ],
)
def test_any_scene_and_poses_can_be_drawn(tmp_path, size, poses):
    scene = triangle(size)
    draw_scene(tmp_path / "s.png", scene, poses, **SMALL)
    draw_intensity(tmp_path / "i.png", scene, [7], poses, [[[0, 0, NAN], [1, 1, 1]]], **SMALL)
    draw_cloud(tmp_path / "c.png", [[0, 0, 0], [NAN, 0, INF]], poses, scene=scene, **SMALL)
    assert colourful(pixels(tmp_path / "s.png")) > 100
    assert colourful(pixels(tmp_path / "i.png")) > 100
    pixels(tmp_path / "c.png")


@pytest.mark.parametrize(
    "points",
    [[], np.empty((0, 3)), [[1, 2, 3]], [[NAN] * 3], [[5, 5, 5]] * 500, [[0, 0, 0], [1e7, 0, 0]]],
)
def test_any_cloud_can_be_drawn(tmp_path, points):
    pixels(draw_cloud(tmp_path / "c.png", points, size=SIZE))
    owners = np.zeros(len(points), dtype=int)
    pixels(draw_cloud(tmp_path / "o.png", points, objects=owners, size=SIZE))


def test_flat_and_upright_scenes_can_be_drawn(tmp_path):
    for k, corners in enumerate(
        ([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 0, 0], [9, 0, 0], [0, 0, 9]])
    ):
        scene = Scene.from_meshes(
            [Mesh("Sheet", np.array(corners, dtype=float), np.array([[0, 1, 2]]))]
        )
        assert colourful(pixels(draw_scene(tmp_path / f"{k}.png", scene, **SMALL))) > 100


def test_many_objects_fit_the_legend(tmp_path):
    meshes = [Mesh(f"site_{k}_object_with_a_long_name", *solid(k)) for k in range(60)]
    pixels(draw_scene(tmp_path / "s.png", Scene.from_meshes(meshes), **SMALL))


@pytest.mark.parametrize("name", ["$\\frac{x$", "_hidden", "a\x1b]0;b\x07\nc", "\u202egnp", " "])
def test_names_from_files_are_words_and_nothing_else(tmp_path, monkeypatch, name):
    from lidarpool.render.page import Page

    kept = []
    save = Page.save
    monkeypatch.setattr(Page, "save", lambda page, path: kept.append(page) or save(page, path))
    scene = Scene.from_meshes([Mesh(name, *solid(0)), Mesh("plain", *solid(1))])
    pixels(draw_scene(tmp_path / "s.png", scene, **SMALL))
    (legend,) = kept[0].figure.legends
    first, second = (text.get_text() for text in legend.get_texts())
    assert (len(first), second) == (len(name), "plain")
    assert first.isprintable()


def solid(k):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    place = np.array([2 * (k % 8), 2 * (k // 8), 0])
    return vertices + place, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.fixture(scope="module")
def planned():
    planning = Planning(
        (25, 25), (-30, -20), centres=[(5, 5), (-10, -5)], radii=2.0,
        trials=3, particles=60, iterations=40,
    )  # fmt: skip
    trials = [run_trial(planning, k) for k in range(3)]
    return planning, best(trials, planning), trials


def test_the_path_is_drawn_with_its_discs_and_trials(tmp_path, planned):
    planning, plan, trials = planned
    bare = pixels(draw_path(tmp_path / "a.png", planning, plan, size=SIZE))
    full = pixels(draw_path(tmp_path / "b.png", planning, plan, trials, size=SIZE))
    assert colourful(bare) > 100 and (bare != full).any()


def test_the_path_plot_has_equal_axes(tmp_path, planned, monkeypatch):
    from lidarpool.render.page import Page

    kept = []
    monkeypatch.setattr(Page, "save", lambda page, path: kept.append(page.figure))
    draw_path(tmp_path / "a.png", *planned)
    (axes,) = kept[0].axes
    box = axes.get_window_extent()
    assert np.ptp(axes.get_xlim()) / box.width == pytest.approx(
        np.ptp(axes.get_ylim()) / box.height
    )
    shown = axes.get_xlim()[0] <= -30 and axes.get_xlim()[1] >= 25
    assert shown and axes.get_xlabel() == "x (m)" and axes.get_ylabel() == "y (m)"


def test_the_path_plot_tells_world_coordinates(tmp_path, planned, monkeypatch):
    from lidarpool.render.page import Page

    kept = []
    monkeypatch.setattr(Page, "save", lambda page, path: kept.append(page.figure))
    draw_path(tmp_path / "a.png", *planned, origin=(500_003, 4_000_000))
    (axes,) = kept[0].axes
    ticks = axes.xaxis.get_ticklocs()
    labels = [axes.xaxis.get_major_formatter()(tick, k) for k, tick in enumerate(ticks)]
    offset = int(re.sub(r"\D", "", axes.get_xlabel()))  # x − 499 970 (m)
    assert [offset + float(label) for label in labels] == (500_003 + ticks).tolist()
    assert axes.get_xlim()[0] <= -30 and axes.get_xlim()[1] >= 25


@pytest.mark.parametrize("length", [NAN, INF, 0.0])
def test_hopeless_plans_can_be_drawn(tmp_path, planned, length):
    path = np.array([[25, 25], [NAN, 0], [-30, -20.0]])
    plan = Plan(path=path, length=length, shortest_possible=INF, clearance=-1.0, trial=0, trials=1)
    free = Planning((25, 25), (-30, -20), centres=np.empty((0, 2)), radii=np.empty(0))
    pixels(draw_path(tmp_path / "p.png", free, plan, size=SIZE, dark=True))


def test_a_missing_folder_is_named_and_nothing_is_left(tmp_path, scene, shot):
    with pytest.raises(LidarpoolError, match=r"gone.*Choose a folder"):
        draw_scene(tmp_path / "gone" / "scene.png", scene, shot=shot, size=SIZE)
    assert not list(tmp_path.iterdir())


def test_a_picture_that_fails_leaves_the_old_one(tmp_path, scene, shot, monkeypatch):
    from matplotlib.figure import Figure

    def full_disk(figure, file, **options):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    target = tmp_path / "scene.png"
    target.write_bytes(b"old")
    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(LidarpoolError, match="No space left"):
        draw_scene(target, scene, shot=shot, size=SIZE)
    assert list(tmp_path.iterdir()) == [target] and target.read_bytes() == b"old"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p, s: draw_scene(p, s, [[1, 2]], **SMALL), r"\(n, 3\)"),
        (lambda p, s: draw_scene(p, s, size=(4, 4)), "too small"),
        (lambda p, s: draw_intensity(p, s, [1, 2, 3], **SMALL), "triangles"),
        (lambda p, s: draw_intensity(p, s, s.faces[:, 0], (), [[1, 2]], **SMALL), r"2, 3\)"),
        (lambda p, s: draw_cloud(p, [[1, 2]], **SMALL), r"\(n, 3\)"),
        (lambda p, s: draw_cloud(p, [[1, 2, 3]], objects=[1, 2], **SMALL), "one whole number"),
        (lambda p, s: draw_cloud(p, [[1, 2, 3]], objects=[0.5], **SMALL), "one whole number"),
        (lambda p, s: draw_cloud(p, [[1, 2, 3]], objects=[9], scene=s, **SMALL), "there are 6"),
    ],
)  # fmt: skip
def test_input_that_does_not_fit_is_refused(tmp_path, scene, call, message):
    with pytest.raises(LidarpoolError, match=message):
        call(tmp_path / "x.png", scene)
    assert not list(tmp_path.iterdir())


def test_no_global_figure_is_made(tmp_path, scene, shot):
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    draw_scene(tmp_path / "s.png", scene, shot=shot, size=SIZE)
    assert plt.get_fignums() == before


def test_captions():
    assert facts((6, "object"), (1, "hit"), (0, "ray")) == "6 objects · 1 hit"
    assert facts((0, "point"), (0, "ray")) == "0 points"
    names = [f"warehouse_Shelf{k}" for k in "ABC"]
    assert without_common_prefix(names) == ["ShelfA", "ShelfB", "ShelfC"]
    assert without_common_prefix(["a_1", "a_2"]) == ["a_1", "a_2"]
    assert without_common_prefix(["ab", "ab_c", "ab_d"]) == ["ab", "ab_c", "ab_d"]
    assert without_common_prefix(["x"]) == ["x"]
    assert len(shortened("a" * 100)) == len(shortened("b" * 18)) == 18


@pytest.mark.parametrize("function", [draw_scene, draw_intensity, draw_cloud, draw_path])
def test_every_picture_takes_the_same_options(function):
    options = inspect.signature(function).parameters
    assert {"path", "size", "dark"} <= set(options)
