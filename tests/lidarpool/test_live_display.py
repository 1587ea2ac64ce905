"""What is displayed: the choice of points, their colours, and when it is drawn."""

import threading
import time

import numpy as np
import pytest

from lidarpool import Column
from lidarpool.columns.table import CHANNEL, OBJECT, SCAN, TABLE, X
from lidarpool.live.colouring import TURBO, colours_of
from lidarpool.live.display import HEIGHT, POSITION, RANGE, PointSample, display_rows, quantities
from lidarpool.live.painter import Painter

INT = np.dtype(np.int64)


def fill(sample, count, piece):
    """Give a sample the points 0 to count - 1."""
    for first in range(0, count, piece):
        sample.put(first + sample.choose(min(piece, count - first)))


def test_sample_keeps_everything_as_long_as_there_is_room():
    sample = PointSample(1000, INT)
    fill(sample, 1000, 70)
    assert sample.rows.tolist() == list(range(1000))


@pytest.mark.parametrize("piece", [1, 999, 250_000])
def test_sample_stays_within_its_capacity_and_even(piece):
    sample = PointSample(1000, INT)
    count = 5_000 if piece == 1 else 250_000
    fill(sample, count, piece)
    kept = sample.rows
    assert sample.seen == count
    assert 450 <= len(kept) <= 1000
    parts = np.histogram(kept, bins=10, range=(0, count))[0]
    assert parts.min() > 0.9 * len(kept) / 10


@pytest.mark.parametrize("channels", [16, 32, 40, 64])
def test_sample_favours_no_channel(channels):
    sample = PointSample(2000, INT)
    fill(sample, 200_000, 4096)
    by_channel = np.bincount(sample.rows % channels, minlength=channels)
    assert by_channel.min() > 0.6 * by_channel.mean()
    assert by_channel.max() < 1.5 * by_channel.mean()


def test_sample_does_not_depend_on_the_pieces():
    one, many = PointSample(300, INT), PointSample(300, INT)
    fill(one, 10_000, 10_000)
    fill(many, 10_000, 7)
    assert one.rows.tolist() == many.rows.tolist()


def test_sample_wants_what_it_chose():
    sample = PointSample(10, INT)
    sample.choose(5)
    with pytest.raises(ValueError, match="4 rows were put where 5 were chosen"):
        sample.put(np.zeros(4))
    with pytest.raises(ValueError, match="at least 1"):
        PointSample(0, INT)


@pytest.mark.parametrize("share", [1, 3, 50])
def test_a_few_points_stand_for_many_that_are_not_at_hand(share):
    """Of each piece of 10,000 points one in so many is there; all pieces count alike."""
    sample = PointSample(1000, INT)
    for first in range(0, 500_000, 10_000):
        sample.put(first + share * sample.choose(10_000, held=10_000 // share))
    assert sample.seen == 500_000
    kept = sample.rows
    assert len(np.unique(kept)) == len(kept) > 450
    parts = np.histogram(kept, bins=10, range=(0, 500_000))[0]
    assert parts.min() > 0.8 * len(kept) / 10
    assert len(sample.choose(100, held=0)) == 0


def test_a_sample_of_very_many_points_at_once_takes_little_memory():
    sample = PointSample(1000, INT)
    assert 450 < len(sample.choose(20_000_000, held=5000)) <= 1000


MINE = Column("wetness", "float32", "%", "how wet it is", source="wetness")


def test_the_menu_follows_from_the_columns():
    menu = quantities([X, SCAN, CHANNEL, OBJECT, MINE])
    assert [q.name for q in menu] == ["height", "range", "scan", "channel", "object", "wetness"]
    assert RANGE not in quantities([SCAN], with_range=False)
    own = Column("height", "int16", "ft", "my height", source="x")
    assert quantities([own, TABLE["range"]]) == (own, TABLE["range"])


def test_rows_hold_columns_and_what_follows_from_them():
    world = np.array([[1000.0, 0, 12], [1000, 3, 4]])
    origin, sensors = np.array([1000.0, 0, 10]), np.array([1000.0, 0, 0])
    menu = quantities([SCAN, MINE])
    rows = display_rows(menu, world, origin, {"scan": [4, 5], "wetness": [1, 2]}, sensors)
    assert rows[POSITION].tolist() == [[0, 0, 2], [0, 3, -6]]
    assert rows["height"].tolist() == [12, 4]
    assert rows["range"].tolist() == [12, 5]
    assert rows["wetness"].tolist() == [1, 2]
    held = display_rows((RANGE,), world, origin, {"range": [7, 8]}, sensors)
    assert held["range"].tolist() == [7, 8]


HEIGHTS = np.linspace(0, 10, 200)


def test_numbers_go_up_the_colours():
    colours, legend = colours_of(HEIGHTS, HEIGHT)
    assert colours[0].tolist() == TURBO[0].tolist()
    assert colours[-1].tolist() == TURBO[255].tolist()
    assert "height, m: height above zero" in legend.html
    assert "linear-gradient" in legend.html
    assert 0 <= legend.low < legend.high <= 10


def test_the_middle_of_a_bar_about_zero_is_zero():
    assert ">0<" in colours_of(np.linspace(-8, 7.98, 200), HEIGHT)[1].html


def test_unknown_ranges_are_grey():
    values = np.full(200, np.nan, np.float32)
    values[:100] = np.linspace(5, 7, 100)
    colours, legend = colours_of(values, RANGE)
    assert (colours[100:] == 128).all()
    assert not (colours[:100] == 128).all(axis=1).any()
    assert 5 <= legend.low < legend.high <= 7


def test_times_of_a_long_survey_are_told_apart():
    """Nanoseconds of an hour: more digits than single precision has."""
    colours, _ = colours_of(3_600_000_000_000 + np.arange(200) * 1000, TABLE["time"])
    assert len(np.unique(colours, axis=0)) > 100


def test_objects_have_names_and_colours_of_their_own():
    colours, legend = colours_of(np.arange(200) % 3, OBJECT, ("Ball", "<b>Box</b>"))
    assert len(np.unique(colours, axis=0)) == 3
    assert "Ball" in legend.html
    assert "&lt;b&gt;Box" in legend.html
    assert "<b>" not in legend.html
    assert "object 2" in legend.html


def test_few_labels_are_named_and_many_are_on_a_scale():
    few, key = colours_of(np.uint8([0, 7, 7, 2]), TABLE["class"])
    assert len(np.unique(few, axis=0)) == 3
    assert [name in key.html for name in ("class 0", "class 1", "class 2", "class 7")] == [
        True, False, True, True,
    ]  # fmt: skip
    assert colours_of(np.uint8([7]), TABLE["class"])[0].tolist() == [few[1].tolist()]
    many, bar = colours_of(np.arange(64, dtype=np.uint16), CHANNEL)
    assert len(np.unique(many, axis=0)) == 64
    assert (bar.low, bar.high) == (0, 63)


@pytest.mark.parametrize("column", [HEIGHT, *TABLE.values()], ids=lambda column: column.name)
def test_every_column_takes_no_points_equal_ones_and_its_largest(column):
    dtype = np.dtype(column.dtype)
    assert colours_of(np.zeros(0, dtype), column)[0].shape == (0, 3)
    same, legend = colours_of(np.ones(5, dtype), column, ("Ball",))
    assert len(np.unique(same, axis=0)) == 1
    assert "nan" not in legend.html
    if dtype.kind in "iu":
        assert colours_of(np.array([0, np.iinfo(dtype).max], dtype), column)[0].shape == (2, 3)


def test_painter_draws_the_latest_once_however_often_it_is_asked():
    drawn, may = [], threading.Event()
    state = {"value": 0}

    def draw():
        drawn.append(state["value"])
        may.wait(120)

    painter = Painter(draw, every_s=0.0)
    thread = painter.start()
    painter.ask()
    while not drawn:
        time.sleep(0.001)
    for value in range(1, 1000):
        state["value"] = value
        painter.ask()
    may.set()
    painter.end()
    thread.join(120)
    assert not thread.is_alive()
    assert drawn[0] == 0
    assert drawn[-1] == 999
    assert len(drawn) <= 3


def test_painter_keeps_what_ended_it():
    def draw():
        raise OSError("no paint")

    painter = Painter(draw, every_s=0.0)
    thread = painter.start()
    painter.ask()
    thread.join(120)
    assert str(painter.error) == "no paint"
