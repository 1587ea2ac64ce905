"""Pictures of sensors: a frame, and the directions that are covered over time."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lidarsim import Sensor, load_sensor
from lidarsim.schema.model_names import model_names
from lidarview.render.pattern_picture import pattern_page

DOCS = Path(__file__).parents[2] / "docs"


def headings(page):
    """Headings of the charts of a page, without its color bar."""
    return [text for axes in page.figure.axes if (text := axes.get_title(loc="left"))]


def texts(page):
    """Texts of a page outside of its charts."""
    return [text.get_text() for text in page.figure.texts]


def test_shares_of_the_field_are_those_of_the_maker():
    """Of a Mid-40, Livox states 19.5 and 68 % after 0.1 and 0.5 s."""
    page = pattern_page(load_sensor("livox/mid40"))
    frame, *covered = headings(page)
    shares = [re.fullmatch(r"after ([\d.]+) s: (\d+) %", words).groups() for words in covered]
    assert frame == "one frame" and [time for time, _ in shares] == ["0.1", "0.5", "2"]
    assert [int(share) for _, share in shares] == pytest.approx([19.5, 68, 100], abs=5)
    assert any("azimuth in degrees from x (forward) to y (left)" in text for text in texts(page))


def test_a_pattern_that_repeats_is_drawn_once():
    page = pattern_page(Sensor.grid(360, 4, 20, rate_hz=10))
    assert headings(page) == [
        "one revolution",
        "first 8 firings, 1,944 µs, with the full color range",
        "after 0.1, 0.5, 2 s: identical coverage",
    ]


def test_a_slow_head_covers_more_and_more():
    page = pattern_page(Sensor.grid(360, 1, 0, rate_hz=0.25))
    assert headings(page) == ["one revolution", "after 0.1 s", "after 0.5 s", "after 2 s"]


def test_a_sensor_that_looks_down_states_its_angle():
    page = pattern_page(load_sensor("airborne/riegl-vq780i"))
    assert any(text.startswith("angle: 0 points down") for text in texts(page))


def test_the_documentation_shows_each_model_in_a_small_picture():
    page = (DOCS / "how-to/sensor-pictures.md").read_text("utf-8")
    shown = re.findall(r"\(\.\./images/sensors/(.*?)\.webp\)", page)
    assert sorted(shown) == sorted(name.replace("/", "-") for name in model_names())
    files = [*(DOCS / "images/sensors").iterdir()]
    assert sorted(file.stem for file in files) == sorted(shown)
    assert sum(file.stat().st_size for file in files) < 1_500_000
