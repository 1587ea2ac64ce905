"""Legends of colours: labels and scales."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarsim.base.arrays import Floats
from lidarsim.base.words import rounded
from lidarsim.scene.colours import as_bytes

from ..render.colouring import (
    NORMALS,
    RGB,
    TURBO,
    Colouring,
)

MAX_LABELS = 1000  # limit for a legend

Legend = dict[str, Any]  # JSON for the page: of `legend_of` or `scale_legend`


def legend_of(colouring: Colouring) -> Legend:
    """Return the legend of colours: a scale with numbers, or labels with their values."""
    if colouring.name in (RGB.name, NORMALS.name):
        return scale_legend(colouring.meaning, (), np.empty((0, 3)))
    if colouring.limits is None:
        labels = [
            [name, as_bytes(colour).tolist(), value]
            for (name, colour), value in zip(colouring.labels, colouring.values, strict=True)
        ]
        hidden = len(labels) - MAX_LABELS
        return {"labels": labels[:MAX_LABELS], "more": max(hidden, 0), "column": colouring.name}
    lower, upper = colouring.limits
    title = f"{colouring.name}, {colouring.unit}" if colouring.unit else colouring.name
    title += f": {colouring.meaning}" if colouring.meaning else ""
    if colouring.logarithmic:
        marks = [rounded(number, 2) for number in (lower, (lower * upper) ** 0.5, upper)]
    else:  # the digits suit a bar of this span, without -0
        digits = int(np.clip(np.ceil(1 - np.log10(upper - lower)), 0, 6)) if upper > lower else 2
        marks = [
            f"{round(number, digits) + 0.0:,.{digits}f}"
            for number in (lower, (lower + upper) / 2, upper)
        ]
    return scale_legend(title, marks, colouring.scale[::15]) | {
        "limits": [float(lower), float(upper)],
        "logarithmic": colouring.logarithmic,
    }


def scale_legend(title: str, marks: Sequence[str], colours: Floats = TURBO[::15]) -> Legend:
    """Return the legend of a scale of colours (n, 3), 0 to 1, with evenly spread marks."""
    return {"title": title, "marks": list(marks), "colours": as_bytes(colours).tolist()}
