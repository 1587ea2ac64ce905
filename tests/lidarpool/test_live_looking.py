"""Cameras, filters, and the point under the mouse; points of a file that are looked for."""

import numpy as np
import pytest
from viser.transforms import SO3

from lidarpool.columns.cloud import Cloud
from lidarpool.columns.table import SCAN, TABLE
from lidarpool.export.cloud_file import CloudFile
from lidarpool.export.ply_format import header, row_type
from lidarpool.live import blocks
from lidarpool.live.blocks import Blocks
from lidarpool.live.labels import without_overlap
from lidarpool.live.looking import TILES, Eye, Filter, even_shares, picked

# Looks along y, with z up: its own axes are x to the right, y down, z ahead.
ALONG_Y = tuple(SO3.from_matrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])).wxyz.tolist())
EYE = Eye((0.0, 0.0, 0.0), ALONG_Y, np.pi / 2, 2.0)
AHEAD = (0.0, 1.0, 0.0)


def test_a_camera_sees_what_is_before_it():
    places = np.array([[0, 5, 0], [9, 5, 0], [-11, 5, 0], [0, 5, 4], [0, 5, -6], [0, -5, 0.0]])
    at, inside = EYE.seen(places)
    assert inside.tolist() == [True, True, False, True, False, False]
    assert at[:2] == pytest.approx(np.array([[0, 0], [0.9, 0]]))
    assert at[3, 1] == pytest.approx(-0.8)  # up
    tiles = EYE.tiles(places)
    assert (tiles >= 0).tolist() == inside.tolist()
    assert tiles.max() < TILES
    assert len(set(tiles[inside].tolist())) == 3


@pytest.mark.parametrize(
    ("low", "seen"),
    [((-1, 5, -1), True), ((20, 5, 0), False), ((-1, -9, -1), False), ((-50, 5, 30), False)],
)
def test_a_box_is_left_out_only_where_none_of_it_is_seen(low, seen):
    assert EYE.may_see(np.array([low, np.array(low) + 2.0])) == seen
    assert EYE.may_see(np.array([[-100.0] * 3, [100.0] * 3]))  # the camera is in it


def test_all_parts_of_a_picture_show_as_many_points_unless_they_have_fewer():
    counts = np.array([1000, 10, 0, 500])
    shares = even_shares(counts, 210)
    assert shares[1] == 1
    assert counts @ shares == pytest.approx(210)
    assert counts[0] * shares[0] == pytest.approx(counts[3] * shares[3])
    assert even_shares(counts, 5000).tolist() == [1, 1, 1, 1]


def test_the_point_under_the_mouse_is_the_nearest_to_the_ray_on_the_first_surface():
    places = np.array([[0.05, 10, 0], [0.01, 10, 0], [0, 30, 0], [0, -5, 0], [3, 10, 0]])
    assert picked(places, (0, 0, 0), AHEAD, 1e-3) == 1
    assert picked(places, (0, 0, 0), (0.0, 0.0, 1.0), 1e-3) is None
    assert picked(np.zeros((0, 3)), (0, 0, 0), AHEAD, 1e-3) is None


def test_a_filter_keeps_what_is_within_all_limits():
    cloud = Cloud(
        np.arange(12.0).reshape(4, 3),
        {"range": np.float32([1, 2, np.nan, 4]), "class": np.uint16([0, 1, 1, 1])},
    )
    wanted = Filter().with_limits("class", (1, 1)).with_limits("range", (0, 9))
    assert wanted.keeps(cloud).tolist() == [False, True, False, True]
    assert wanted.of("range") == (0, 9)
    assert wanted.with_limits("range", None) == Filter((("class", 1, 1),))
    assert Filter((("z", 3, 8),)).keeps(cloud).tolist() == [False, True, True, False]
    assert Filter().keeps(cloud).all()


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Return a file of 100,000 points along y, from 1 to 100 metres, in blocks of 1,000."""
    monkeypatch.setattr(blocks, "BLOCK", 1000)
    rows = np.zeros(100_000, row_type(np.dtype(np.float32), (SCAN, TABLE["intensity"])))
    random = np.random.default_rng(0)
    rows["y"] = np.linspace(1, 100, 100_000)
    rows["x"], rows["z"] = random.uniform(-0.3, 0.3, (2, 100_000))
    rows["scan"] = np.arange(100_000) // 100
    rows["intensity"] = rows["scan"] % 100
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())
    return CloudFile(path)


def searched(search):
    """Return all that a search found, and how often it let others do something."""
    steps = []
    try:
        while True:
            steps.append(next(search))
    except StopIteration as end:
        return *end.value, steps


def test_all_points_that_a_filter_keeps_are_found_or_an_even_choice_of_them(file):
    look = Blocks(file, np.zeros(3), 5000)
    cloud, count, steps = searched(look.search(Filter((("intensity", 7, 7),)), 5000))
    assert len(cloud) == count == 1000
    assert set(cloud["intensity"].tolist()) == {7}
    assert steps == sorted(steps)
    assert (len(steps), steps[0], steps[-1]) == (100, 0.0, 0.99)
    cloud, count, _ = searched(look.search(Filter((("intensity", 0, 49),)), 5000))
    assert count == 50_000
    assert 2000 < len(cloud) <= 5000
    assert (np.diff(cloud["scan"]) >= 0).all()
    assert np.histogram(cloud["scan"], 10, (0, 1000))[0].min() > 150
    cloud, count, steps = searched(look.search(Filter((("scan", 995, 2000),)), 5000))
    assert (len(cloud), count, len(steps)) == (500, 500, 1)  # nothing else is read
    assert len(searched(look.search(Filter((("intensity", 200, 300),)), 5000))[0]) == 0


def test_from_near_more_is_found_and_blocks_outside_the_picture_are_not_read_again(file):
    look = Blocks(file, np.zeros(3), 5000)
    eye = Eye((0.0, 90.0, 0.0), ALONG_Y, np.pi / 2, 2.0)
    cloud, _, steps = searched(look.search(Filter(), 20_000, eye, np.ones(TILES)))
    assert len(steps) == 100
    assert cloud.positions[:, 1].min() > 90
    assert 9000 < len(cloud) < 10_200
    again, _, steps = searched(look.search(Filter(), 20_000, eye, np.full(TILES, 0.5)))
    assert len(steps) < 12
    assert len(again) == pytest.approx(len(cloud) / 2, rel=0.1)


def test_of_labels_that_would_overlap_the_first_is_shown():
    """Pictures are 1,000 pixels high; a metre is 50 of them ten metres away."""
    texts = ["sensor", "Van", "Pedestrian", "Behind"]
    places = np.array([[0, 10, 0], [0.5, 10, 0.2], [0.5, 10, -1], [0, -10, 0.0]])
    assert without_overlap(texts, places, EYE, 1000).tolist() == [True, False, True, False]
    assert without_overlap(texts[1:], places[1:], EYE, 1000).tolist() == [True, True, False]
    assert len(without_overlap([], np.zeros((0, 3)), EYE, 1000)) == 0
