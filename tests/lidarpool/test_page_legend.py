"""Colours of points by their columns, and what a legend says of them."""

import json

import numpy as np
import pytest

from lidarpool.columns.table import CHANNEL, OBJECT, TABLE, Column, Z
from lidarpool.live.view import as_bytes, legend_of
from lidarpool.render.colouring import TURBO
from lidarpool.render.colouring import colours_of as colouring_of

HEIGHTS = np.linspace(0, 10, 200)


def colours_of(*arguments):
    """Colours (n, 3) as bytes, and the legend as JSON."""
    coloured = colouring_of(*arguments)
    return as_bytes(coloured.paint(arguments[0])), json.dumps(
        legend_of(coloured), ensure_ascii=False
    )


def test_numbers_go_up_the_colours():
    colours, legend = colours_of(HEIGHTS, Z)
    assert colours[0].tolist() == as_bytes(TURBO)[0].tolist()
    assert colours[-1].tolist() == as_bytes(TURBO)[255].tolist()
    assert "z, m: position along z, up" in legend
    assert "marks" in legend


def test_what_is_unknown_is_grey():
    values = np.full(200, np.nan, np.float32)
    values[:100] = np.linspace(5, 7, 100)
    colours, _ = colours_of(values, TABLE["range"])
    assert (colours[100:] == 128).all()
    assert not (colours[:100] == 128).all(axis=1).any()


def test_times_of_a_long_survey_are_told_apart():
    """Nanoseconds of an hour: more digits than single precision has."""
    colours, _ = colours_of(3_600_000_000_000 + np.arange(200) * 1000, TABLE["time"])
    assert len(np.unique(colours, axis=0)) > 100


@pytest.mark.parametrize(
    ("span_ns", "told"), [(2e9, "time, s:"), (3e7, "time, ms:"), (50, "time, ns:")]
)
def test_times_are_told_in_a_unit_that_can_be_read(span_ns, told):
    legend = colours_of(np.linspace(0, span_ns, 200).astype(np.int64), TABLE["time"])[1]
    assert told in legend
    assert ('"1.0"' in legend) == (span_ns == 2e9)


def test_objects_have_names_and_colours_of_their_own():
    colours, legend = colours_of(np.arange(200) % 3, OBJECT, ("Ball", "<b>Box</b>"))
    assert len(np.unique(colours, axis=0)) == 3
    assert "Ball" in legend
    assert "<b>Box" in legend  # the page writes it as text
    assert "object 2" in legend


def test_what_is_no_surface_is_grey_and_has_no_object_s_colour():
    values = np.arange(200, dtype=np.int32) % 3 - 1
    colours, legend = colours_of(values, OBJECT, ("Ball", "Box"))
    assert (colours[values < 0] == 128).all()
    assert not (colours[values >= 0] == 128).all(axis=1).any()
    assert '["no surface", [128, 128, 128], -1]' in legend
    own = Column("zone", "int32", "", "zone", kind="label")
    assert "no surface" not in colours_of(values, own)[1]
    many = tuple(f"thing {number}" for number in range(1100))
    assert '"thing 99"' in colours_of(np.arange(100), OBJECT, many)[1]
    assert '"more": 100' in colours_of(np.arange(1100), OBJECT, many)[1]
    often = np.append(np.arange(100), np.full(9, 73))
    assert "thing 73" in colours_of(often, OBJECT, many)[1]


def test_few_labels_are_named_and_many_are_on_a_scale():
    few, key = colours_of(np.uint8([0, 7, 7, 2]), TABLE["class"])
    assert len(np.unique(few, axis=0)) == 3
    assert [name in key for name in ("class 0", "class 1", "class 2", "class 7")] == [
        True, False, True, True,
    ]  # fmt: skip
    assert colours_of(np.uint8([7]), TABLE["class"])[0].tolist() == [few[1].tolist()]
    many, bar = colours_of(np.arange(64, dtype=np.uint16), CHANNEL)
    assert len(np.unique(many, axis=0)) == 64
    assert "marks" in bar


@pytest.mark.parametrize("column", TABLE.values(), ids=lambda column: column.name)
def test_every_column_takes_no_points_equal_ones_and_its_largest(column):
    dtype = np.dtype(column.dtype)
    assert colours_of(np.zeros(0, dtype), column)[0].shape == (0, 3)
    same, legend = colours_of(np.ones(5, dtype), column, ("Ball",))
    assert len(np.unique(same, axis=0)) == 1
    assert "nan" not in legend
    if dtype.kind in "iu":
        assert colours_of(np.array([0, np.iinfo(dtype).max], dtype), column)[0].shape == (2, 3)
