"""Colours of points by one of their columns, and legends."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats
from lidarsim.columns.table import COLOURS, NO_SURFACE, OBJECT, Column
from lidarsim.scene.colours import packed, unpacked

from .theme import mapped, object_colours

TURBO = mapped("turbo", np.linspace(0.07, 0.95, 256))  # (256, 3); its very ends are nearly black
DIVERGING = mapped("coolwarm", np.linspace(0, 1, 256))  # (256, 3); its middle is pale
MOST_ENTRIES = 12  # most labels without names that have a colour each
MOST_COLOURS = 1 << 16  # of labels

RGB = Column("rgb", "uint32", "", "colours of the surfaces")  # see `values_of`
_SPREAD = (0.5, 99.5)  # percentiles at the ends of a colour scale
_GREY = 0.5
# The scale is logarithmic if numbers differ by the first factor and the median is this low in their
# range, or if numbers without a unit, such as intensities, differ by the second factor.
_WIDE = 10.0
_SKEWED = 0.1
_MANIFOLD = 30.0
_TIMES = (("s", 1e9), ("ms", 1e6), ("µs", 1e3))  # units for nanoseconds


@dataclass(frozen=True, eq=False)
class Colouring:
    """How points are coloured, and a legend: a scale between two limits, or labels."""

    # Returns colours (n, 3) in 0 to 1 of values (n,).
    paint: Callable[[AnyArray], Floats]
    name: str  # of the column
    unit: str  # of the limits
    meaning: str
    limits: tuple[float, float] | None = None  # ends of the scale; None for labels
    logarithmic: bool = False
    # Name and colour of existing labels, those with most points first if there are many.
    labels: tuple[tuple[str, Floats], ...] = ()
    values: tuple[int, ...] = ()  # of the column, that the labels stand for
    scale: Floats = field(default_factory=lambda: TURBO)  # (256, 3)


def with_rgb(columns: Mapping[str, Column]) -> dict[str, Column]:
    """Add `RGB` to columns that have red, green and blue, for points in their own colours."""
    made = {*COLOURS} <= {*columns} and RGB.name not in columns
    return {**columns, **({RGB.name: RGB} if made else {})}


def values_of(column: Column, read: Callable[[str], AnyArray]) -> AnyArray:
    """Values of a column, by a function that reads those of a name; of `RGB` packed colours."""
    if column is RGB:
        return packed(np.stack([read(name) for name in COLOURS], axis=1))
    return read(column.name)


def word_of(value: int, column: Column, names: Sequence[str] = ()) -> str:
    """Word for a value of a label; `names` are those of the values 0, 1, 2, …."""
    if 0 <= value < len(names) and names[value]:
        return names[value]
    return NO_SURFACE if value < 0 and column.name == OBJECT.name else f"{column.name} {value}"


def colours_of(values: AnyArray, column: Column, names: Sequence[str] = ()) -> Colouring:
    """Choose colours for the values (n,) of a column; `names` are those of its values 0, 1, 2, ….

    Labels have a colour each; labels without names and with too many values for a legend are on a
    scale like numbers. Numbers that are mostly small with a few large ones, and intensities of a
    wide range, have a logarithmic scale. Velocities are blue below 0 and red above. NaN is grey,
    and so is what is no surface.
    """
    if column is RGB:
        return Colouring(lambda packs: unpacked(packs) / 255, column.name, "", column.meaning)
    spread = _SPREAD
    if column.kind == "label" and values.dtype.kind in "iu":
        values = values.astype(np.int64)
        found, counts = np.unique(values, return_counts=True)
        if names or len(found) <= MOST_ENTRIES:
            count = max(len(names), int(found.max(initial=0)) + 1)
            palette = object_colours(min(count, MOST_COLOURS))
            if len(found) > MOST_ENTRIES:
                found = found[np.argsort(-counts, kind="stable")]
            palette, none = np.vstack([palette, [_GREY] * 3]), len(palette)

            def label(values: AnyArray) -> Floats:
                numbers = values.astype(np.int64)
                surface = (numbers >= 0) | (column.name != OBJECT.name)
                return np.asarray(palette[np.where(surface, numbers % none, none)])

            words = [word_of(value, column, names) for value in found.tolist()]
            labels = tuple(zip(words, label(found), strict=True))

            kept = tuple(found.tolist())
            return Colouring(label, column.name, "", column.meaning, labels=labels, values=kept)
        spread = (0, 100)
    known = np.isfinite(values)
    unit = column.unit
    size = 1.0
    middle = 0.5
    low = 0.0
    high = 1.0
    if known.any():
        numbers = values[known].astype(np.float64)
        low, middle, high = np.percentile(numbers, [spread[0], 50, spread[1]])
    if unit == "ns":
        span = high - low
        unit, size = next((entry for entry in _TIMES if span >= 0.1 * entry[1]), ("ns", 1.0))
        low = low / size
        middle = middle / size
        high = high / size
    scale = TURBO
    if unit == "m/s" and values.dtype.kind == "f":
        high = max(-low, high)
        low = -high
        scale = DIVERGING
    skewed = high > _WIDE * low and middle - low < _SKEWED * (high - low)
    logarithmic = bool(low > 0 and (skewed or (not unit and high > _MANIFOLD * low)))
    ends = np.log([low, high]) if logarithmic else (low, high)

    def shade(values: AnyArray) -> Floats:
        known = np.isfinite(values)
        numbers = values.astype(np.float64) / size
        if logarithmic:
            numbers = np.log(np.clip(numbers, low, high))
        scaled = (numbers - ends[0]) * (255 / (ends[1] - ends[0] if high > low else 1.0))
        colours = scale[np.clip(np.where(known, scaled, 0), 0, 255).astype(np.uint8)]
        colours[~known] = _GREY
        return colours

    limits = float(low), float(high)
    return Colouring(shade, column.name, unit, column.meaning, limits, logarithmic, scale=scale)
