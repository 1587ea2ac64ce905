"""Colours of points by one of their quantities, and the legend that explains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from ..view.theme import mapped, object_colours

QUANTITIES = ("height", "range", "ring", "object", "scan")

TURBO: NDArray[np.uint8] = np.round(255 * mapped("turbo", np.linspace(0.04, 0.97, 256))).astype(
    np.uint8
)  # (256, 3); its very ends are nearly black

MOST_ENTRIES = 12  # objects that a legend names
_SPREAD = (0.5, 99.5)  # percentiles between which the colours of lengths are spread
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
class ObjectKey:
    """Names of objects beside their colours, written as HTML by `html`."""

    names: Sequence[str]
    colours: NDArray[np.uint8]  # (n, 3)

    @property
    def html(self) -> str:
        """A line for each object, up to a number."""
        lines = [
            f'<div style="display:flex;align-items:center;gap:0.5em"><span style="width:0.8em;'
            f'height:0.8em;border-radius:2px;background:rgb({r},{g},{b})"></span>'
            f"<span>{escape(name)}</span></div>"
            for name, (r, g, b) in zip(self.names, self.colours.tolist(), strict=True)
        ][:MOST_ENTRIES]
        if len(self.names) > MOST_ENTRIES:
            lines.append(f"<div>and {len(self.names) - MOST_ENTRIES:,} more</div>")
        return f'<div style="font-size:0.75em;padding:0.25em 0.8em">{"".join(lines)}</div>'


Legend = ColourBar | ObjectKey


def colours_of(
    rows: NDArray[np.void], quantity: str, names: Sequence[str]
) -> tuple[NDArray[np.uint8], Legend]:
    """Colours (n, 3) of rows (DISPLAY) by one of `QUANTITIES`, and what they mean.

    Parameters
    ----------
    names
        Names of the objects, by number.
    """
    if quantity == "object":
        return _object_colours(rows["object"], names)
    if quantity == "height":
        values, title, spread = rows["position"][:, 2], "height, m", True
    elif quantity == "range":
        values, title, spread = rows["range"], "range, m", True
    else:
        values, title, spread = rows[quantity].astype(np.float32), quantity, False
    return turbo_colours(values, title, _limits(values, spread))


def turbo_colours(
    values: NDArray[np.floating], title: str, limits: tuple[float, float]
) -> tuple[NDArray[np.uint8], ColourBar]:
    """Colours (n, 3) of values (n,) between two limits; grey where a value is NaN."""
    low, high = limits
    scaled = (values - low) * (255 / (high - low if high > low else 1.0))
    known = np.isfinite(scaled)
    colours = TURBO[np.clip(np.where(known, scaled, 0), 0, 255).astype(np.uint8)]
    colours[~known] = _GREY
    return colours, ColourBar(title, low, high)


def _object_colours(
    owners: NDArray[np.int32], names: Sequence[str]
) -> tuple[NDArray[np.uint8], ObjectKey]:
    count = max(len(names), int(owners.max(initial=-1)) + 1, 1)
    palette = np.round(255 * object_colours(count)).astype(np.uint8)
    shown = [*names, *(f"object {i}" for i in range(len(names), count))][:count]
    return palette[owners.clip(0)], ObjectKey(shown, palette)


def _limits(values: NDArray[np.floating], spread: bool) -> tuple[float, float]:
    """Find the ends of the colours; of lengths without what few points would stretch them to."""
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
