"""Colours of points by one of their columns, and legends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..columns.table import Column
from .theme import mapped, object_colours

TURBO = mapped("turbo", np.linspace(0.07, 0.95, 256))  # (256, 3); its very ends are nearly black
MOST_ENTRIES = 12  # most labels without names that have a colour each
MOST_COLOURS = 1 << 16  # of labels

_SPREAD = (0.5, 99.5)  # percentiles at the ends of a colour scale
_GREY = 0.5
_SKEWED = 0.1  # a median this low in its range: the scale is logarithmic
_TIMES = (("s", 1e9), ("ms", 1e6), ("µs", 1e3))  # units for nanoseconds


@dataclass(frozen=True, eq=False)
class Colouring:
    """Colours of points, and a legend: a scale between two limits, or labels.

    Parameters
    ----------
    colours
        float64 (n, 3) in 0 to 1.
    name, unit, meaning
        Of the column; the unit is that of `limits`.
    limits
        Lowest and highest value on the scale, whose colours are `TURBO`; None for labels.
    logarithmic
        Whether the scale is.
    labels
        (name, colour): existing labels, those with most points first if there are many.
    values
        Values of the column that the labels stand for.
    paint
        Returns colours (m, 3) of other values (m,) of the column on the same scale.
    """

    colours: NDArray[np.float64]
    name: str
    unit: str
    meaning: str
    limits: tuple[float, float] | None = None
    logarithmic: bool = False
    labels: tuple[tuple[str, NDArray[np.float64]], ...] = ()
    values: tuple[int, ...] = ()
    paint: Callable[[NDArray[Any]], NDArray[np.float64]] = field(
        default=lambda values: np.full((len(values), 3), _GREY), repr=False
    )


def colours_of(values: NDArray[Any], column: Column, names: Sequence[str] = ()) -> Colouring:
    """Colour points by the values (n,) of a column.

    Labels have a colour each; labels without names and with too many values for a legend are on a
    scale like numbers. Numbers that are mostly small with a few large ones, such as intensities,
    have a logarithmic scale. NaN is grey.

    Parameters
    ----------
    names
        Names of the values 0, 1, 2, … of a label.
    """
    spread = _SPREAD
    if column.kind == "label" and values.dtype.kind in "iu":
        values = values.astype(np.int64)
        found, counts = np.unique(values, return_counts=True)
        if names or len(found) <= MOST_ENTRIES:
            count = max(len(names), int(found.max(initial=0)) + 1)
            palette = object_colours(min(count, MOST_COLOURS))
            if len(found) > MOST_ENTRIES:
                found = found[np.argsort(-counts, kind="stable")]
            words = [
                names[value] if 0 <= value < len(names) else f"{column.name} {value}"
                for value in found.tolist()
            ]
            labels = tuple(zip(words, palette[found % len(palette)], strict=True))

            def label(values: NDArray[Any]) -> NDArray[np.float64]:
                return np.asarray(palette[values.astype(np.int64) % len(palette)])

            return Colouring(
                label(values), column.name, "", column.meaning, labels=labels,
                values=tuple(found.tolist()), paint=label,
            )  # fmt: skip
        spread = (0, 100)
    known, unit, size = np.isfinite(values), column.unit, 1.0
    middle, low, high = 0.5, 0.0, 1.0
    if known.any():
        numbers = values[known].astype(np.float64)
        low, middle, high = np.percentile(numbers, [spread[0], 50, spread[1]])
    if unit == "ns":
        span = high - low
        unit, size = next((entry for entry in _TIMES if span >= 0.1 * entry[1]), ("ns", 1.0))
        low, middle, high = low / size, middle / size, high / size
    logarithmic = bool(low > 0 and middle - low < _SKEWED * (high - low))
    ends = np.log([low, high]) if logarithmic else (low, high)

    def shade(values: NDArray[Any]) -> NDArray[np.float64]:
        known, numbers = np.isfinite(values), values.astype(np.float64) / size
        if logarithmic:
            numbers = np.log(np.clip(numbers, low, high))
        scaled = (numbers - ends[0]) * (255 / (ends[1] - ends[0] if high > low else 1.0))
        colours = TURBO[np.clip(np.where(known, scaled, 0), 0, 255).astype(np.uint8)]
        colours[~known] = _GREY
        return colours

    limits = float(low), float(high)
    return Colouring(
        shade(values), column.name, unit, column.meaning, limits, logarithmic, paint=shade
    )
