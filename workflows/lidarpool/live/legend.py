"""Legends of colours, for the page to draw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.arrays import Bytes, Floats
from ..render.colouring import TURBO, Colouring

MOST_LABELS = 1000  # in a legend

Legend = dict[str, Any]  # what the page is told of it


def legend_of(colouring: Colouring) -> Legend:
    """Legend of colours: a scale with numbers, or labels with their values."""
    if colouring.limits is None:
        labels = [
            [name, as_bytes(colour).tolist(), value]
            for (name, colour), value in zip(colouring.labels, colouring.values, strict=True)
        ]
        more = len(labels) - MOST_LABELS
        return {"labels": labels[:MOST_LABELS], "more": max(more, 0), "column": colouring.name}
    low, high = colouring.limits
    title = f"{colouring.name}, {colouring.unit}" if colouring.unit else colouring.name
    title += f": {colouring.meaning}" if colouring.meaning else ""
    if colouring.logarithmic:
        marks = [f"{at:.2g}" for at in (low, (low * high) ** 0.5, high)]
    else:  # as many digits as a bar of this span needs, and never -0
        digits = int(np.clip(np.ceil(1 - np.log10(high - low)), 0, 6)) if high > low else 2
        marks = [f"{round(at, digits) + 0.0:,.{digits}f}" for at in (low, (low + high) / 2, high)]
    return scale_legend(title, marks, colouring.scale[::15])


def scale_legend(title: str, marks: Sequence[str], colours: Floats = TURBO[::15]) -> Legend:
    """Legend of a scale of colours (n, 3), with evenly spread marks."""
    return {"title": title, "marks": list(marks), "colours": as_bytes(colours).tolist()}


def as_bytes(colours: Floats) -> Bytes:
    """Colours of 0 to 1 as bytes."""
    return np.round(255 * colours).astype(np.uint8)
