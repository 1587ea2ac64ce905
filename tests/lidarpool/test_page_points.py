"""Cameras and filters of a page, and the points of a file that are looked for."""

import numpy as np
import pytest

from lidarpool.columns.cloud import Cloud
from lidarpool.columns.cloud_file import CloudFile
from lidarpool.columns.ply_format import header, row_type
from lidarpool.columns.table import SCAN, TABLE
from lidarpool.live import points
from lidarpool.live.points import (
    TILES,
    Abandoned,
    Eye,
    Filter,
    HeldPoints,
    PointFinder,
    even_shares,
)

ALL = slice(None)


def along_y(y=0.0, parallel=False):
    """Return a camera at (0, y, 0) that looks along y, 90° high and twice as wide; z is up."""
    view = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, y], [0, 0, 0, 1]])
    near, far = 0.1, 1000.0
    if parallel:  # 10 metres high
        lens = np.diag([1 / 10, 1 / 5, -2 / (far - near), 1.0])
        lens[2, 3] = -(far + near) / (far - near)
    else:
        lens = np.diag([0.5, 1.0, -(far + near) / (far - near), 0.0])
        lens[2, 3], lens[3, 2] = -2 * far * near / (far - near), -1.0
    columns = (lens @ view).T.ravel()
    return Eye.read(",".join(map(repr, columns.tolist())))


EYE = along_y()


def test_a_camera_sees_what_is_before_it():
    places = np.array([[0, 5, 0], [9, 5, 0], [-11, 5, 0], [0, 5, 4], [0, 5, -6], [0, -5, 0.0]])
    at, inside = EYE.seen(places)
    assert inside.tolist() == [True, True, False, True, False, False]
    assert at[:2] == pytest.approx(np.array([[0, 0], [0.9, 0]]))
    assert at[3, 1] == pytest.approx(0.8)  # up
    tiles = EYE.tiles(places)
    assert (tiles >= 0).tolist() == inside.tolist()
    assert tiles.max() < TILES
    assert len(set(tiles[inside].tolist())) == 3


def test_all_parts_of_a_picture_show_as_many_points_unless_they_have_fewer():
    counts = np.array([1000, 10, 0, 500])
    shares = even_shares(counts, 210)
    assert shares[1] == 1
    assert counts @ shares == pytest.approx(210)
    assert counts[0] * shares[0] == pytest.approx(counts[3] * shares[3])
    assert even_shares(counts, 5000).tolist() == [1, 1, 1, 1]


def test_a_filter_keeps_what_is_within_all_limits():
    cloud = Cloud(
        np.arange(12.0).reshape(4, 3),
        {"range": np.float32([1, 2, np.nan, 4]), "class": np.uint16([0, 1, 1, 1])},
    )
    held = HeldPoints(cloud)
    wanted = Filter.read("class,1,1;range,0,9;nothing,1,2", ["class", "range"])
    assert wanted.limits == (("class", 1, 1), ("range", 0, 9))
    assert wanted.keeps(held, ALL).tolist() == [False, True, False, True]
    assert Filter((("z", 3, 8),)).keeps(held, ALL).tolist() == [False, True, True, False]
    assert Filter().keeps(held, np.array([0, 3])).all()


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Return a file of 100,000 points along y, from 1 to 100 metres, in blocks of 1,000."""
    monkeypatch.setattr(points, "BLOCK", 1000)
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
        self._file, self.table, self.rows_of, self.blocks = file, file.table, file.rows_of, set()

    def __len__(self):
        return len(self._file)

    def values(self, name, rows):
        if isinstance(rows, slice):
            self.blocks.add(rows.start // 1000)
        return self._file.values(name, rows)


def test_without_a_filter_an_even_choice_of_all_is_found(file):
    rows, count = PointFinder(file, np.zeros(3)).find(5000)
    assert (len(rows), count) == (5000, 100_000)
    assert np.histogram(rows, 10, (0, 100_000))[0].tolist() == [500] * 10
    rows, count = PointFinder(file, np.zeros(3)).find(5000, scans=((10, 19), (500, 504)))
    assert rows.tolist() == [*range(1000, 2000), *range(50_000, 50_500)]
    assert count == 1500


def test_all_points_that_a_filter_keeps_are_found_or_an_even_choice_of_them(file):
    finder = PointFinder(read := Read(file), np.zeros(3))
    rows, count = finder.find(5000, Filter((("intensity", 7, 7),)))
    assert len(rows) == count == 1000
    assert set(file.values("intensity", rows).tolist()) == {7}
    assert len(read.blocks) == 100
    rows, count = finder.find(5000, Filter((("intensity", 0, 49),)))
    assert count == 50_000
    assert 2000 < len(rows) <= 5000
    assert (np.diff(rows) > 0).all()
    assert np.histogram(rows, 10, (0, 100_000))[0].min() > 150
    read.blocks.clear()
    rows, count = finder.find(5000, Filter((("intensity", 95, 99),)), ((995, 2000),))
    assert (len(rows), count, read.blocks) == (500, 500, {99})  # nothing else is read
    assert len(finder.find(5000, Filter((("intensity", 200, 300),)))[0]) == 0


@pytest.mark.parametrize("parallel", [False, True])
def test_a_camera_finds_what_is_before_it_and_reads_no_block_behind_it_again(file, parallel):
    finder = PointFinder(read := Read(file), np.zeros(3))
    eye = along_y(90.0, parallel)
    rows, count = finder.find(20_000, eye=eye)
    assert count == 100_000
    assert len(read.blocks) == 100
    assert file.values("y", rows).min() > 90
    assert 9000 < len(rows) < 10_200
    read.blocks.clear()
    fewer, _ = finder.find(4000, eye=eye)
    assert len(read.blocks) < 12
    assert 2000 < len(fewer) <= 4000


def test_a_search_that_nobody_waits_for_is_given_up(file):
    asked = iter([False] * 5 + [True])
    finder = PointFinder(read := Read(file), np.zeros(3))
    with pytest.raises(Abandoned):
        finder.find(5000, Filter((("intensity", 7, 7),)), abandoned=lambda: next(asked))
    assert len(read.blocks) == 5


def test_points_that_are_nowhere_are_left_out(tmp_path):
    rows = np.zeros(1000, row_type(np.dtype(np.float32), (SCAN,)))
    rows["x"][::2] = np.nan
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(rows.dtype, len(rows)) + rows.tobytes())
    finder = PointFinder(CloudFile(path), np.zeros(3))
    found, _ = finder.find(1000)
    assert found.tolist() == list(range(1, 1000, 2))
    assert len(finder.find(100, Filter((("scan", 0, 0),)))[0]) <= 100
