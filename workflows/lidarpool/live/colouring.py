"""Colours of points by one of their columns, and the legend that explains them, as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..columns.table import Column
from ..render.theme import mapped, object_colours

TURBO = mapped("turbo", np.linspace(0.04, 0.97, 256))  # (256, 3); its very ends are nearly black
MOST_ENTRIES = 12  # labels that a legend names
MOST_COLOURS = 1 << 16  # of labels

_SPREAD = (0.5, 99.5)  # percentiles between which the colours of numbers are spread
_GREY = 0.5
_SKEWED = 0.1  # a median this low in its range: the scale is logarithmic
_TIMES = (("s", 1e9), ("ms", 1e6), ("µs", 1e3))  # that nanoseconds are told in
_LEGEND = '<div style="font-size:0.75em;padding:0.25em 0.8em">'


def colours_of(
    values: NDArray[Any], column: Column, names: Sequence[str] = ()
) -> tuple[NDArray[np.uint8], str]:
    """Colours (n, 3) of the values (n,) of a column, and a legend.

    Labels have a colour each. Those of more values than a legend can tell, and without names,
    are on a scale like numbers. Numbers most of which are small among large ones, as intensities
    are, have a logarithmic scale. What is NaN is grey.

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
            palette = as_bytes(object_colours(min(count, MOST_COLOURS)))
            if len(found) > MOST_ENTRIES:
                found = found[np.argsort(-counts, kind="stable")]  # those of most points are named
            words = [
                names[value] if 0 <= value < len(names) else f"{column.name} {value}"
                for value in found.tolist()
            ]
            return palette[values % len(palette)], _key(words, palette[found % len(palette)])
        spread = (0, 100)
    known, numbers, unit = np.isfinite(values), values.astype(np.float64), column.unit
    middle, low, high = 0.5, 0.0, 1.0
    if known.any():
        low, middle, high = np.percentile(numbers[known], [spread[0], 50, spread[1]])
    if unit == "ns":
        span = high - low
        unit, size = next((entry for entry in _TIMES if span >= 0.1 * entry[1]), ("ns", 1.0))
        numbers = numbers / size
        low, middle, high = low / size, middle / size, high / size
    logarithmic = bool(low > 0 and middle - low < _SKEWED * (high - low))
    if logarithmic:
        numbers = np.log(np.clip(numbers, low, high))
    ends = np.log([low, high]) if logarithmic else (low, high)
    scaled = (numbers - ends[0]) * (255 / (ends[1] - ends[0] if high > low else 1.0))
    colours = TURBO[np.clip(np.where(known, scaled, 0), 0, 255).astype(np.uint8)]
    colours[~known] = _GREY
    title = f"{column.name}, {unit}" if unit else column.name
    title += f": {column.meaning}" if column.meaning else ""
    if logarithmic:
        marks = [f"{at:.2g}" for at in (low, (low * high) ** 0.5, high)]
        return as_bytes(colours), colour_bar(title, marks)
    # As many digits as a bar of this span needs, and never -0.
    digits = int(np.clip(np.ceil(1 - np.log10(high - low)), 0, 6)) if high > low else 2
    marks = [f"{round(at, digits) + 0.0:,.{digits}f}" for at in (low, (low + high) / 2, high)]
    return as_bytes(colours), colour_bar(title, marks)


def colour_bar(title: str, marks: Sequence[str]) -> str:
    """Bar of `TURBO` with its title above and evenly spread marks below, as HTML."""
    stops = ", ".join("rgb({},{},{})".format(*colour) for colour in as_bytes(TURBO[::15]).tolist())
    numbers = "".join(f"<span>{text}</span>" for text in marks)
    return (
        f"{_LEGEND}{escape(title)}"
        '<div style="height:0.9em;border-radius:2px;margin:0.2em 0;'
        f'background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{numbers}</div></div>'
    )


def _key(words: Sequence[str], colours: NDArray[np.uint8]) -> str:
    """Write a line for each label, up to a number."""
    lines = [
        '<div style="display:flex;align-items:center;gap:0.5em"><span style="width:0.8em;'
        f'height:0.8em;border-radius:2px;background:rgb({r},{g},{b})"></span>'
        f"<span>{escape(name)}</span></div>"
        for name, (r, g, b) in zip(words, colours.tolist(), strict=True)
    ][:MOST_ENTRIES]
    if len(words) > MOST_ENTRIES:
        lines.append(f"<div>and {len(words) - MOST_ENTRIES:,} more</div>")
    return f"{_LEGEND}{''.join(lines)}</div>"


def as_bytes(colours: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours of 0 to 1 as bytes."""
    return np.round(255 * colours).astype(np.uint8)
