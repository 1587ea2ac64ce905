"""Choose point colors and a matching legend for a column."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lidarfiles.color_table import TURBO
from lidarsim.columns.table import COLORS, NO_SURFACE, NORMAL, OBJECT, Column
from lidarsim.numerics.arrays import AnyArray, Bytes, Floats, Ints
from lidarsim.scene.colors import pack_colors, unpack_colors

from .theme import apply_colormap, object_colors

DIVERGING = apply_colormap("coolwarm", np.linspace(0, 1, 256))  # (256, 3), pale at the center
MAX_UNNAMED_LABELS = 12  # more labels without names are shown on a scale
MAX_COLORS = 1 << 16  # maximum number of distinct label colors

# Columns that are composed of other columns by `column_values`.
RGB = Column("rgb", "uint32", "", "surface colors")
NORMALS = Column(
    "normals",
    "uint32",
    "",
    "surface normals: x is red, y is green, z is blue; dark is -1, bright is 1",
)
_COMPOSED = {RGB.name: (RGB, COLORS), NORMALS.name: (NORMALS, NORMAL)}  # {name: (column, parts)}
MATERIAL = "material"  # name of the column
NO_MATERIAL = "no material"
_SPREAD = (0.5, 99.5)  # percentiles at the ends of a color scale
_GRAY = 0.5
# The scale of a column is logarithmic if the column allows it and either the values differ by the
# first factor and the median is in this lowest fraction of their range, or the values differ by the
# last factor. Columns such as heights do not allow it, because for heights from 0.1 to 20 m, half
# of a logarithmic scale would cover the lowest 1.4 m.
_SKEWED_RATIO = 10.0
_SKEWED_MEDIAN = 0.1
_WIDE_RATIO = 30.0
_TIME_UNITS = (("s", 1e9), ("ms", 1e6), ("µs", 1e3))  # units for nanoseconds


@dataclass(frozen=True, eq=False)
class Coloring:
    """Colors for the values of a column.

    They are a scale between two limits, or one color per label.
    """

    # Function that returns the colors (n, 3), from 0 to 1, of values (n,).
    paint: Callable[[AnyArray], Floats]
    name: str  # name of the column
    unit: str  # unit of the limits
    meaning: str
    limits: tuple[float, float] | None = None  # ends of the scale, or None for labels
    logarithmic: bool = False
    # Name and color of each existing label, with the most frequent first if there are many.
    labels: tuple[tuple[str, Floats], ...] = ()
    values: tuple[int, ...] = ()  # value of each label
    scale: Floats = field(default_factory=lambda: TURBO)  # (256, 3)
    divisor: float = 1.0  # divisor that converts values to the unit of the limits


def add_composed_columns(columns: Mapping[str, Column]) -> dict[str, Column]:
    """Add `RGB` and `NORMALS` to columns that contain all of their components."""
    composed = {
        name: column
        for name, (column, parts) in _COMPOSED.items()
        if {*parts} <= {*columns} and name not in columns
    }
    return {**columns, **composed}


def column_values(column: Column, read: Callable[[str], AnyArray]) -> AnyArray:
    """Return the values of a column, or packed colors for `RGB` and `NORMALS`.

    `read` returns the values of a column by its name.
    """
    if column is RGB:
        return pack_colors(np.stack([read(name) for name in COLORS], axis=1))
    if column is NORMALS:
        return pack_colors(normal_colors(np.stack([read(name) for name in NORMAL], axis=1)))
    return read(column.name)


def normal_colors(normals: AnyArray) -> Bytes:
    """Return the colors of unit normals, with gray for NaN.

    Points that are not on a surface have NaN as their normal.
    """
    known = np.isfinite(normals).all(axis=1, keepdims=True)
    return np.asarray(np.where(known, 127.5 * (1 + normals), 127.5).round().astype(np.uint8))


def label_text(value: int, column: Column, names: Sequence[str] = ()) -> str:
    """Format a label value as text.

    `names` are the names of the values 0, 1, 2, ….
    """
    if 0 <= value < len(names) and names[value]:
        return names[value]
    if value < 0 and column.name == MATERIAL:
        return NO_MATERIAL
    return NO_SURFACE if value < 0 and column.name == OBJECT.name else f"{column.name} {value}"


def make_coloring(
    values: AnyArray,
    column: Column,
    names: Sequence[str] = (),
    limits: tuple[float, float] | None = None,
) -> Coloring:
    """Choose colors for the values of a column.

    Each label gets its own color. If there are too many labels without names for a legend, they are
    shown on a scale, like numbers. A scale is logarithmic if `Column.scale` is "logarithmic" and
    the values differ by large factors. Velocities are blue below 0 and red above. NaN is gray, and
    so are labels of points that are not on a surface.

    Parameters
    ----------
    values
        (n,) values of the column, or a sample of them.
    column
        The column.
    names
        Names of the values 0, 1, 2, … of a label column.
    limits
        Limits of the scale, in its unit. By default, they are percentiles of the values.
    """
    if column in (RGB, NORMALS):
        return Coloring(lambda packs: unpack_colors(packs) / 255, column.name, "", column.meaning)
    spread: tuple[float, float] = _SPREAD
    if column.kind == "label" and values.dtype.kind in "iu":
        values = values.astype(np.int64)
        labels, counts = np.unique(values, return_counts=True)
        if names or len(labels) <= MAX_UNNAMED_LABELS:
            if len(labels) > MAX_UNNAMED_LABELS:
                labels = labels[np.argsort(-counts, kind="stable")]
            return _label_coloring(labels, column, names)
        spread = (0, 100)
    return _number_coloring(values, column, spread, limits)


def _label_coloring(labels: Ints, column: Column, names: Sequence[str]) -> Coloring:
    """Choose a color for each label, in legend order."""
    count = max(len(names), int(labels.max(initial=0)) + 1)
    colors = object_colors(min(count, MAX_COLORS))
    gray = len(colors)
    palette = np.vstack([colors, [_GRAY] * 3])
    has_none = column.name in (OBJECT.name, MATERIAL)  # negative values mean none

    def paint(values: AnyArray) -> Floats:
        numbers = values.astype(np.int64)
        is_surface = (numbers >= 0) | (not has_none)
        return np.asarray(palette[np.where(is_surface, numbers % gray, gray)])

    values = tuple(labels.tolist())
    words = [label_text(value, column, names) for value in values]
    entries = tuple(zip(words, paint(labels), strict=True))
    return Coloring(paint, column.name, "", column.meaning, labels=entries, values=values)


class _Range(NamedTuple):
    """The range of numbers on a scale."""

    lower: float
    middle: float  # median
    upper: float

    @property
    def has_large_factors(self) -> bool:
        """Whether a linear scale would hide differences between the numbers.

        This is the case if the numbers are positive and differ by large factors.
        """
        is_low = self.middle - self.lower < _SKEWED_MEDIAN * (self.upper - self.lower)
        is_skewed = self.upper > _SKEWED_RATIO * self.lower and is_low
        is_wide = self.upper > _WIDE_RATIO * self.lower
        return bool(self.lower > 0 and (is_skewed or is_wide))


def _number_coloring(
    values: AnyArray,
    column: Column,
    percentiles: tuple[float, float],
    chosen_limits: tuple[float, float] | None,
) -> Coloring:
    """Create a scale for values between two percentiles or between given limits."""
    finite = np.isfinite(values)
    lower = 0.0
    middle = 0.5
    upper = 1.0
    if finite.any():
        numbers = values[finite].astype(np.float64)
        lower, middle, upper = np.percentile(numbers, [percentiles[0], 50, percentiles[1]])
    unit = column.unit
    divisor = 1.0
    if unit == "ns":
        span = upper - lower
        unit, divisor = next(
            (entry for entry in _TIME_UNITS if span >= 0.1 * entry[1]), ("ns", 1.0)
        )
    limits = _Range(lower / divisor, middle / divisor, upper / divisor)
    scale = TURBO
    if unit == "m/s" and values.dtype.kind == "f":
        max_speed = max(-limits.lower, limits.upper)
        limits = _Range(-max_speed, limits.middle, max_speed)
        scale = DIVERGING
    logarithmic = column.scale == "logarithmic" and limits.has_large_factors
    if chosen_limits is not None:
        limits = _Range(chosen_limits[0], limits.middle, chosen_limits[1])
        logarithmic = logarithmic and limits.lower > 0
    paint = _scale_painter(limits, divisor, logarithmic, scale)
    range_limits = float(limits.lower), float(limits.upper)
    return Coloring(
        paint,
        column.name,
        unit,
        column.meaning,
        range_limits,
        logarithmic,
        scale=scale,
        divisor=divisor,
    )


def _scale_painter(
    limits: _Range, divisor: float, logarithmic: bool, scale: Floats
) -> Callable[[AnyArray], Floats]:
    """Return a function that maps values to the colors of a scale.

    The values are divided by `divisor` to get the unit of the limits.
    """
    lower, _, upper = limits
    start, stop = np.log([lower, upper]) if logarithmic else (lower, upper)

    def paint(values: AnyArray) -> Floats:
        finite = np.isfinite(values)
        numbers = values.astype(np.float64) / divisor
        if logarithmic:
            numbers = np.log(np.clip(numbers, lower, upper))
        scaled = (numbers - start) * (255 / (stop - start if upper > lower else 1.0))
        colors = scale[np.clip(np.where(finite, scaled, 0), 0, 255).astype(np.uint8)]
        colors[~finite] = _GRAY
        return colors

    return paint
