"""Films and pages of a result: what they show, and how large they are."""

from __future__ import annotations

import base64
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from tests.pages import unpacked

import lidarview.render.film
import lidarview.viewer.sharing
from lidarfiles.picture_file import PICTURE_FILE, PictureContent, sensor_positions
from lidarpool.cli.commands import cli
from lidarsim import Actor, LidarError, Scene, Sensor, Survey, Track, box
from lidarsim.columns.ply_format import header, row_type
from lidarsim.columns.table import CHANNEL, SCAN, TABLE
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarview.render.film import ACTOR, SURFACE, Film
from lidarview.render.theme import rgb
from lidarview.viewer.packing import pack_column
from lidarview.viewer.result_views import open_result
from lidarview.viewer.sharing import export_view, render_film, render_page

COUNT = 3600
SCANS = 360
RED = np.array([1.0, 0.0, 0.0, 1.0])
FLOOR = np.array([[[-50, -50, 0], [50, -50, 0], [0, 80, 0.0]]])


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Draw small pictures, which are fast."""
    monkeypatch.setattr(lidarview.render.film, "SIZE", (96, 54))
    monkeypatch.setattr(lidarview.render.film, "FOCAL_PX", 92.2)


def write(folder, moves):
    """Write a result: a floor scanned in ten turns from a sensor, while a van passes."""
    turn = np.linspace(0, 20 * np.pi, COUNT)
    rows = np.zeros(COUNT, row_type(np.dtype(np.float32), (SCAN, CHANNEL)))
    rows["x"] = 9 * np.cos(turn)
    rows["y"] = 9 * np.sin(turn)
    rows["z"] = turn / 30
    rows["scan"] = np.arange(COUNT) * SCANS // COUNT
    rows["ring"] = np.arange(COUNT) % 7
    (folder / "cloud.ply").write_bytes(header(rows.dtype, COUNT) + rows.tobytes())
    van = Actor(box("Van", (4, 2, 2)), Track([0, 1], [[-9, 0, 0.1], [9, 0, 0.1]]))
    scene = replace(Scene.from_meshes([box("Floor", (40, 40, 0.1))]), actors=(van,) * moves)
    path = Track([0, 2], [[0, -9, 2], [0, 9, 2.0]])
    given = {"trajectory": path} if moves else {"poses": [(0, 0, 2)]}
    survey = Survey(Sensor.grid(layers=4), steps=SCANS, **given)
    hits = np.zeros(scene.triangles, np.int64)
    rays = np.zeros((0, 2, 3), np.float32)
    ways = sensor_positions(survey)
    PictureContent(scene, ways, hits, rays, duration_ns=survey.duration_ns).save(
        folder / PICTURE_FILE
    )
    Sweeps.from_survey(survey, scene).save(folder / SWEEPS_FILE)
    return folder


@pytest.fixture
def drive(tmp_path):
    return write(tmp_path, moves=True)


def seen(points, actors, **given):
    """Frames of points that come one part after the other, seen from the south."""
    parts = [(np.array(p, float).reshape(-1, 3), np.tile(c, (len(p), 1))) for p, c in points]
    film = Film(
        np.linspace(0, 1e9, len(parts)), parts, 1.0, FLOOR, np.inf, actors,
        np.array([[-10, -10, 0], [10, 10, 0.0]]), **given,
    )  # fmt: skip
    return [frame.astype(int) for frame in film.frames()]


def reds(frame):
    return int((frame[..., 0] - frame[..., 1:].max(axis=2)).clip(0).sum())


def test_new_points_are_bright_and_old_ones_darker_unless_they_are_where_an_actor_was():
    floor = [(x, y, 0.0) for x in range(-3, 4) for y in range(-3, 4)]
    none = ([], RED)
    on, *_, later = seen([(floor, RED), none, none, none, none, none], ())
    assert reds(on) > reds(later) > 0.1 * reds(on)
    above = [(x, y, 4.0) for x, y, _ in floor]
    on, later = seen([(above, RED), none], ())
    assert reds(on) > 0 and reds(later) == 0
    below = [(x, y, -4.0) for x, y, _ in floor]
    assert reds(*seen([(below, RED)], ())) == 0  # the floor hides them


def test_actors_are_where_they_are_at_the_time_of_a_frame():
    way = Track([0, 1], [[-8, 0, 0], [8, 0, 0.0]])
    none = ([], RED)
    frames = seen([none, none], [Actor(box("Van", (4, 4, 4)), way)], platform_trajectory=None)
    warm = [frame[..., 0] - frame[..., 2] > 10 for frame in frames]
    assert all(mask.sum() > 30 for mask in warm) and not (warm[0] & warm[1]).all()
    absent = Track([5, 6], [[-8, 0, 0], [8, 0, 0.0]], start_s=0.0, beyond="absent")
    nobody = seen([none], [Actor(box("Van", (4, 4, 4)), absent)])
    assert not (nobody[0][..., 0] - nobody[0][..., 2] > 10).any()
    assert ACTOR[0] > ACTOR[2] and SURFACE[0] < SURFACE[2]


def test_the_camera_follows_a_carrier_whose_way_is_red():
    way = np.array([0, 1e9]), np.array([[0, -20, 2], [0, 20, 2.0]])
    frames = seen([([], RED)] * 3, (), platform_trajectory=way, range_m=8.0)
    dot = rgb("#ff4d5e") * 255
    for frame in frames:  # in the middle, below
        row, column = (np.abs(frame - dot).sum(axis=2) < 60).nonzero()
        assert 40 < column.mean() < 56 and row.min() > 27
    assert not np.array_equal(frames[0], frames[2])


def test_a_room_is_cut_open_at_its_top():
    room = box("Room", (12, 12, 6))
    points = np.array([(x, y, 0.1) for x in range(-3, 4) for y in range(-3, 4)])
    parts = [(points, np.tile(RED, (len(points), 1)))]
    box_ = np.array([[-6, -6, 0], [6, 6, 6.0]])
    closed, opened = (
        Film(np.ones(1), parts, 0.0, room.vertices[room.faces], top, (), box_)
        for top in (np.inf, 2.0)
    )
    assert reds(next(closed.frames()).astype(int)) == 0
    assert reds(next(opened.frames()).astype(int)) > 1000


@pytest.mark.extended
@pytest.mark.slow(every=2)
@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_film_moves_and_is_the_same_each_time(drive, tmp_path, suffix):
    film = tmp_path / f"film{suffix}"
    done = CliRunner().invoke(cli, ["view", str(drive), "--film", str(film)])
    assert done.stdout == f"{film}\n"
    assert re.match(rf"\d\d:\d\d:\d\d  writing film\{suffix}\n", done.stderr)
    with Image.open(film) as moving:
        moving.seek(29)
        moving.load()
        assert moving.n_frames == 30 and moving.info["duration"] == 100
        assert moving.size == (960, 540) and moving.info["loop"] == 0
    assert film.stat().st_size < 3_000_000
    assert render_film(open_result(drive), suffix) == film.read_bytes()


@pytest.mark.extended
def test_a_film_that_would_be_too_large_is_narrower(drive, monkeypatch):
    monkeypatch.setattr(lidarview.viewer.sharing, "FILM_BYTES", 400_000)
    made = render_film(open_result(drive), ".gif")
    assert len(made) < 400_000
    (drive / "a.gif").write_bytes(made)
    with Image.open(drive / "a.gif") as moving:
        assert 400 <= moving.size[0] < 960


@pytest.mark.extended
def test_each_point_of_a_drive_is_new_once_and_all_of_stations_are_there(drive, monkeypatch):
    counts = []

    def frames(film):
        counts[:] = [len(places) for places, _ in film.new_points]
        return iter([np.zeros((54, 96, 3), np.uint8)] * len(counts))

    monkeypatch.setattr(Film, "frames", frames)
    render_film(open_result(drive), ".gif")
    assert len(counts) == 30 and sum(counts) == COUNT and min(counts) > 0
    render_film(open_result(write(drive, moves=False)), ".gif")
    assert counts == [COUNT] * 30
    render_film(open_result(drive / "cloud.ply"), ".webp")  # nothing is known but points
    assert counts == [COUNT] * 30


def answers(page):
    """Answers that a page holds, {question: answer}."""
    found = re.findall(rb'<script type="text/plain" data-question="(.*?)">(.*?)</script>', page)
    return {name.decode(): unpacked(zlib.decompress(base64.b64decode(t))) for name, t in found}


def unpacked_column(cloud, name):
    """Return the values of a column, as the page computes them."""
    how = cloud["packed"][name]
    planes = cloud["arrays"][name].reshape(-1, cloud["count"]).astype(np.int64)
    zigzag = sum(plane << (8 * k) for k, plane in enumerate(planes))
    codes = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
    values = how["base"] + how["step"] * (codes - how["fractions"])
    values = np.exp(values) if how["logarithmic"] else values
    return np.where(codes == 0, np.nan, values) if how["fractions"] else values


def test_columns_are_packed_within_their_steps():
    random = np.random.default_rng(0)
    times = np.sort(random.integers(0, 2**40, 1000)) + 10**18
    for values, tolerance in (
        (random.integers(-5, 70_000, 1000), 0),
        (random.random(1000).astype(np.float32), 1 / 4000),
        (np.float32(10) ** random.uniform(-4, 4, 1000).astype(np.float32), 0),
        (np.full(1000, np.nan), 0),
        (np.r_[np.nan, np.ones(999)], 0),
        (times, 1024),
        (np.zeros(0), 0),
    ):
        column = pack_column(values)
        how = column._asdict()
        cloud = {"packed": {"a": how}, "arrays": {"a": how.pop("planes")}, "count": len(values)}
        found = unpacked_column(cloud, "a") if len(values) else np.zeros(0)
        np.testing.assert_allclose(
            found, values, atol=tolerance, rtol=3e-3 if column.logarithmic else 1e-12
        )


@pytest.mark.slow
def test_a_page_holds_three_million_points(tmp_path):
    """Of a noisy drive: a ground of many sweeps, with ranges, intensities and labels."""
    count = 3_300_000
    random = np.random.default_rng(0)
    columns = [SCAN, TABLE["channel"], TABLE["object"], TABLE["intensity"], TABLE["time"]]
    rows = np.zeros(count, row_type(np.dtype(np.float32), tuple(columns)))
    steps = np.arange(count)
    angle = 2 * np.pi * (steps // 32) / 1800
    ring = steps % 32
    rows[TABLE["channel"].in_files] = ring
    rows["scan"] = steps // 320
    distance = 3 + 1.5 * ring + random.normal(0, 0.01, count)
    rows["x"] = distance * np.cos(angle)
    rows["y"] = distance * np.sin(angle) + steps * 1e-5
    rows["z"] = random.normal(0, 0.01, count)
    rows["object"] = (angle % 6).astype(int)
    rows["intensity"] = random.random(count) / distance
    rows["time"] = steps * 600
    (tmp_path / "cloud.ply").write_bytes(header(rows.dtype, count) + rows.tobytes())
    page = render_page(open_result(tmp_path / "cloud.ply"))
    assert len(page) < 25_000_000
    assert answers(page)["cloud?"]["count"] >= 3_000_000


def test_a_page_holds_all_that_it_asks_for_and_names_no_other_file(drive):
    page = render_page(open_result(drive))
    held = answers(page)
    assert held["state?"]["points"] == COUNT and held["state?"]["offline"]
    assert {"column?name=z", "column?name=channel", "surface?color=gray"} < {*held}
    view = open_result(drive)
    for axis, name in enumerate("xyz"):
        exact = np.sort(view.points.values(name, slice(None)) - view.origin[axis])
        held_values = np.sort(unpacked_column(held["cloud?"], name))
        assert np.abs(held_values - exact).max() < 1e-4 * np.ptp(exact) + 1e-3
    scans = unpacked_column(held["cloud?"], "scan")
    assert np.array_equal(np.sort(scans), np.sort(view.points.values("scan", slice(None))))
    for name in held["state?"]["colors"]:
        assert held["cloud?"]["legends"][name]
        assert {f"{name} scale", f"{name} palette"} & {*held["cloud?"]["arrays"]}
    assert not re.search(rb'(src|href)="(?!data:)', page) and b'from "./' not in page
    assert render_page(open_result(drive)) == page


@pytest.mark.extended
def test_a_page_with_less_room_has_fewer_points_where_they_are_dense(drive, monkeypatch):
    dense = np.random.default_rng(0).normal(scale=[9, 9, 0.1], size=(40_000, 3))
    rows = np.zeros(40_000, row_type(np.dtype(np.float32), (SCAN,)))
    for axis, name in enumerate("xyz"):
        rows[name] = dense[:, axis]
    (drive / "cloud.ply").write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())
    whole = len(render_page(open_result(drive)))
    monkeypatch.setattr(lidarview.viewer.sharing, "PAGE_BYTES", whole - 200_000)
    page = render_page(open_result(drive))
    assert len(page) <= whole - 200_000
    cloud = answers(page)["cloud?"]
    places = np.stack([unpacked_column(cloud, axis) for axis in "xyz"], axis=1)
    far = [np.linalg.norm(some, axis=1) > 15 for some in (places, dense)]
    assert 1000 < len(places) < 40_000 and far[0].mean() > 1.02 * far[1].mean()
    monkeypatch.setattr(lidarview.viewer.sharing, "PAGE_BYTES", 500_000)
    with pytest.raises(LidarError, match="even without points"):
        render_page(open_result(drive))


def test_wrong_names_and_results_without_points_are_refused(drive, tmp_path):
    film = tmp_path / "film.mp4"
    page = tmp_path / "page.htm"
    with pytest.raises(
        LidarError, match=r"film.mp4 has an unsupported extension. Use .gif or .webp"
    ):
        export_view(open_result(drive), film, None)
    with pytest.raises(LidarError, match=r"page.htm has an unsupported extension. Use .html"):
        export_view(open_result(drive), None, page)
    with pytest.raises(LidarError, match="cannot be written"):
        export_view(open_result(drive), None, tmp_path / "none" / "page.html")
    rows = np.zeros(0, row_type(np.dtype(np.float32), (SCAN,)))
    (drive / "cloud.ply").write_bytes(header(rows.dtype, 0) + rows.tobytes())
    with pytest.raises(LidarError, match="no points to show"):
        export_view(open_result(drive), tmp_path / "film.gif", None)
    assert not film.exists() and not page.exists()
