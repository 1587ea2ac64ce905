"""Legends of colours, as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from ..render.colouring import TURBO, Colouring

MOST_LABELS = 1000  # 200 bytes each

_LEGEND = '<div style="font-size:0.75em;padding:0.25em 0.8em">'


def legend_of(colouring: Colouring) -> str:
    """Legend of colours: a bar, or all labels in a box that can be scrolled."""
    if colouring.limits is None:
        return _key(colouring)
    low, high = colouring.limits
    title = f"{colouring.name}, {colouring.unit}" if colouring.unit else colouring.name
    title += f": {colouring.meaning}" if colouring.meaning else ""
    if colouring.logarithmic:
        return colour_bar(title, [f"{at:.2g}" for at in (low, (low * high) ** 0.5, high)])
    # As many digits as a bar of this span needs, and never -0.
    digits = int(np.clip(np.ceil(1 - np.log10(high - low)), 0, 6)) if high > low else 2
    marks = [f"{round(at, digits) + 0.0:,.{digits}f}" for at in (low, (low + high) / 2, high)]
    return colour_bar(title, marks)


def colour_bar(title: str, marks: Sequence[str], colours: NDArray[np.float64] = TURBO) -> str:
    """Bar of colours (256, 3) with its title above and evenly spread marks below."""
    some = as_bytes(colours[::15]).tolist()
    stops = ", ".join("rgb({},{},{})".format(*colour) for colour in some)
    numbers = "".join(f"<span>{text}</span>" for text in marks)
    return (
        f"{_LEGEND}{escape(title)}"
        '<div style="height:0.9em;border-radius:2px;margin:0.2em 0;'
        f'background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{numbers}</div></div>'
    )


def _key(colouring: Colouring) -> str:
    labels = colouring.labels
    lines = [
        '<div style="display:flex;align-items:center;gap:0.5em;min-width:0"><span style="width:'
        f'0.8em;height:0.8em;flex:none;border-radius:2px;background:rgb({r},{g},{b})"></span>'
        f'<span title="{escape(name)}" style="overflow:hidden;text-overflow:ellipsis;'
        f'white-space:nowrap">{escape(name)}</span></div>'
        for name, (r, g, b) in ((n, as_bytes(c).tolist()) for n, c in labels[:MOST_LABELS])
    ]
    if len(labels) > MOST_LABELS:
        lines.append(f"<div>and {len(labels) - MOST_LABELS:,} more</div>")
    return (
        f'{_LEGEND}<div style="display:grid;grid-template-columns:1fr 1fr;gap:0 0.8em;'
        f'max-height:7.2em;overflow-y:auto">{"".join(lines)}</div></div>'
    )


def boxed(lines: Sequence[str]) -> str:
    """Lines of text for the panel."""
    text = "<br>".join(map(escape, lines))
    return f'<div style="padding:0 0.8em 0.6em;font-size:0.85em">{text}</div>'


def as_bytes(colours: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours of 0 to 1 as bytes."""
    return np.round(255 * colours).astype(np.uint8)
