"""What is displayed: the choice of points, their colours, and when it is drawn."""

import threading
import time

import numpy as np
import pytest

from lidarpool.live.colouring import QUANTITIES, TURBO, colours_of
from lidarpool.live.display import DISPLAY, PointSample
from lidarpool.live.painter import Painter


def fill(sample, count, piece):
    """Give a sample the points 0 to count - 1, whose scan is their number."""
    for first in range(0, count, piece):
        chosen = first + sample.choose(min(piece, count - first))
        rows = np.zeros(len(chosen), DISPLAY)
        rows["scan"] = chosen
        sample.put(rows)


def test_sample_keeps_everything_as_long_as_there_is_room():
    sample = PointSample(1000)
    fill(sample, 1000, 70)
    assert sample.rows["scan"].tolist() == list(range(1000))


@pytest.mark.parametrize("piece", [1, 999, 250_000])
def test_sample_stays_within_its_capacity_and_even(piece):
    sample = PointSample(1000)
    count = 5_000 if piece == 1 else 250_000
    fill(sample, count, piece)
    kept = sample.rows["scan"]
    assert sample.seen == count
    assert 450 <= len(kept) <= 1000
    parts = np.histogram(kept, bins=10, range=(0, count))[0]
    assert parts.min() > 0.9 * len(kept) / 10


@pytest.mark.parametrize("rings", [16, 32, 40, 64])
def test_sample_favours_no_ring(rings):
    sample = PointSample(2000)
    fill(sample, 200_000, 4096)
    by_ring = np.bincount(sample.rows["scan"] % rings, minlength=rings)
    assert by_ring.min() > 0.6 * by_ring.mean()
    assert by_ring.max() < 1.5 * by_ring.mean()


def test_sample_does_not_depend_on_the_pieces():
    one, many = PointSample(300), PointSample(300)
    fill(one, 10_000, 10_000)
    fill(many, 10_000, 7)
    assert one.rows["scan"].tolist() == many.rows["scan"].tolist()


def test_sample_wants_what_it_chose():
    sample = PointSample(10)
    sample.choose(5)
    with pytest.raises(ValueError, match="4 rows were put where 5 were chosen"):
        sample.put(np.zeros(4, DISPLAY))
    with pytest.raises(ValueError, match="at least 1"):
        PointSample(0)


@pytest.fixture
def rows():
    """Return 200 points that rise, in 20 scans, on three objects."""
    rows = np.zeros(200, DISPLAY)
    rows["position"][:, 2] = np.linspace(0, 10, 200)
    rows["scan"] = np.arange(200) // 10
    rows["ring"] = np.arange(200) % 16
    rows["object"] = np.arange(200) % 3
    rows["range"] = np.nan
    rows["range"][:100] = np.linspace(5, 7, 100)
    return rows


def test_heights_go_up_the_colours(rows):
    colours, legend = colours_of(rows, "height", ())
    assert colours[0].tolist() == TURBO[0].tolist()
    assert colours[-1].tolist() == TURBO[255].tolist()
    assert "height, m" in legend.html
    assert "linear-gradient" in legend.html
    assert 0 <= legend.low < legend.high <= 10


def test_the_middle_of_a_bar_about_zero_is_zero(rows):
    rows["position"][:, 2] = np.linspace(-8, 7.98, len(rows))
    assert ">0<" in colours_of(rows, "height", ())[1].html


def test_unknown_ranges_are_grey(rows):
    colours, legend = colours_of(rows, "range", ())
    assert (colours[100:] == 128).all()
    assert not (colours[:100] == 128).all(axis=1).any()
    assert 5 <= legend.low < legend.high <= 7


def test_objects_have_names_and_colours_of_their_own(rows):
    colours, legend = colours_of(rows, "object", ("Ball", "<b>Box</b>"))
    assert len(np.unique(colours, axis=0)) == 3
    assert "Ball" in legend.html
    assert "&lt;b&gt;Box" in legend.html
    assert "<b>" not in legend.html
    assert "object 2" in legend.html


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_every_quantity_takes_no_points_and_equal_ones(rows, quantity):
    assert colours_of(rows[:0], quantity, ())[0].shape == (0, 3)
    same, legend = colours_of(np.repeat(rows[:1], 5), quantity, ("Ball",))
    assert len(np.unique(same, axis=0)) == 1
    assert "nan" not in legend.html


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
