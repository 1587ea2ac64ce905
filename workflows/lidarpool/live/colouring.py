"""Colours of points by one of their columns, and the legend that explains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..columns.table import Column
from ..render.theme import mapped, object_colours

TURBO: NDArray[np.uint8] = np.round(255 * mapped("turbo", np.linspace(0.04, 0.97, 256))).astype(
    np.uint8
)  # (256, 3); its very ends are nearly black

MOST_ENTRIES = 12  # labels that a legend names
MOST_COLOURS = 1 << 16  # of labels
_SPREAD = (0.5, 99.5)  # percentiles between which the colours of numbers are spread
_GREY = (128, 128, 128)


@dataclass(frozen=True)
class ColourBar:
    """Bar of colours from `low` to `high`, written as HTML by `html`.

    Parameters
    ----------
    title
        What the colours mean, with its unit.
    low, high
        What the two ends stand for.
    logarithmic
        Whether the middle stands for their geometric mean.
    """

    title: str
    low: float
    high: float
    logarithmic: bool = False

    @property
    def html(self) -> str:
        """The bar with its title above and its numbers below."""
        stops = ", ".join("#{:02x}{:02x}{:02x}".format(*TURBO[i]) for i in range(0, 256, 15))
        if self.logarithmic:
            values = (self.low, (self.low * self.high) ** 0.5, self.high)
            texts = [f"{value:.2g}" if value < 10 else f"{value:,.0f}" for value in values]
        else:
            values = (self.low, (self.low + self.high) / 2, self.high)
            texts = [_number(value, self.high - self.low) for value in values]
        numbers = "".join(f"<span>{text}</span>" for text in texts)
        return (
            f'<div style="font-size:0.75em;padding:0.25em 0.8em">{escape(self.title)}'
            f'<div style="height:0.9em;border-radius:2px;margin:0.2em 0;'
            f'background:linear-gradient(to right, {stops})"></div>'
            f'<div style="display:flex;justify-content:space-between">{numbers}</div></div>'
        )


@dataclass(frozen=True)
class LabelKey:
    """Names of labels beside their colours, written as HTML by `html`."""

    names: Sequence[str]
    colours: NDArray[np.uint8]  # (n, 3)

    @property
    def html(self) -> str:
        """A line for each label, up to a number."""
        lines = [
            f'<div style="display:flex;align-items:center;gap:0.5em"><span style="width:0.8em;'
            f'height:0.8em;border-radius:2px;background:rgb({r},{g},{b})"></span>'
            f"<span>{escape(name)}</span></div>"
            for name, (r, g, b) in zip(self.names, self.colours.tolist(), strict=True)
        ][:MOST_ENTRIES]
        if len(self.names) > MOST_ENTRIES:
            lines.append(f"<div>and {len(self.names) - MOST_ENTRIES:,} more</div>")
        return f'<div style="font-size:0.75em;padding:0.25em 0.8em">{"".join(lines)}</div>'


Legend = ColourBar | LabelKey


def colours_of(
    values: NDArray[Any], column: Column, names: Sequence[str] = ()
) -> tuple[NDArray[np.uint8], Legend]:
    """Colours (n, 3) of the values (n,) of a column, and what they mean.

    Labels have a colour each. Those of more values than a legend can tell, and without names,
    are on a scale like numbers.

    Parameters
    ----------
    names
        Names of the values 0, 1, 2, … of a label.
    """
    is_label = column.kind == "label" and values.dtype.kind in "iu"
    if is_label:
        found = np.unique(values)
        if len(names):
            return _named_colours(values, column, names)
        if len(found) <= MOST_ENTRIES:
            palette = _palette(int(found.max(initial=0)) + 1)
            words = [f"{column.name} {value}" for value in found.tolist()]
            return _of(palette, values), LabelKey(words, _of(palette, found))
    return turbo_colours(values, _title(column), _limits(values, spread=not is_label))


def _title(column: Column) -> str:
    """Name, unit and meaning of a column."""
    name = f"{column.name}, {column.unit}" if column.unit else column.name
    return f"{name}: {column.meaning}" if column.meaning else name


def turbo_colours(
    values: NDArray[Any], title: str, limits: tuple[float, float]
) -> tuple[NDArray[np.uint8], ColourBar]:
    """Colours (n, 3) of values (n,) between two limits; grey where a value is NaN."""
    low, high = limits
    scaled = (values.astype(np.float64) - low) * (255 / (high - low if high > low else 1.0))
    known = np.isfinite(scaled)
    colours = TURBO[np.clip(np.where(known, scaled, 0), 0, 255).astype(np.uint8)]
    colours[~known] = _GREY
    return colours, ColourBar(title, low, high)


def _named_colours(
    values: NDArray[Any], column: Column, names: Sequence[str]
) -> tuple[NDArray[np.uint8], LabelKey]:
    palette = _palette(max(len(names), int(values.max(initial=0)) + 1))
    rest = (f"{column.name} {i}" for i in range(len(names), len(palette)))
    return _of(palette, values), LabelKey([*names, *rest][: len(palette)], palette)


def _palette(count: int) -> NDArray[np.uint8]:
    """Colours of the labels below a number, (n, 3), or of the first `MOST_COLOURS`."""
    return np.round(255 * object_colours(min(max(count, 1), MOST_COLOURS))).astype(np.uint8)


def _of(palette: NDArray[np.uint8], values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.asarray(palette[values.clip(0).astype(np.int64) % len(palette)])


def _limits(values: NDArray[Any], spread: bool) -> tuple[float, float]:
    """Find the ends of the colours; of numbers without what few points would stretch them to."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    if not spread:
        return float(known.min()), float(known.max())
    low, high = np.percentile(known, _SPREAD)
    return float(low), float(high)


def _number(value: float, span: float) -> str:
    """Write a number with the digits that a bar of this span needs."""
    digits = int(np.clip(np.ceil(1 - np.log10(span)), 0, 6)) if span > 0 else 2
    return f"{round(value, digits) + 0.0:,.{digits}f}"  # never -0
