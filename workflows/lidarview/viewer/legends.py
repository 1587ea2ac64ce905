"""Build the legends that the page shows for colors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarfiles.color_table import TURBO
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.colors import as_bytes
from lidarsim.words import format_rounded

from ..render.coloring import NORMALS, RGB, Coloring

MAX_LABELS = 1000  # maximum number of labels in a legend

Legend = dict[str, Any]  # sent to the page as JSON


def make_legend(coloring: Coloring) -> Legend:
    """Build the legend of a coloring.

    The legend is a scale with numbers, or a list of labels with their values.
    """
    if coloring.name in (RGB.name, NORMALS.name):
        return scale_legend(coloring.meaning, (), np.empty((0, 3)))
    if coloring.limits is None:
        labels = [
            [name, as_bytes(color).tolist(), value]
            for (name, color), value in zip(coloring.labels, coloring.values, strict=True)
        ]
        hidden = len(labels) - MAX_LABELS
        return {"labels": labels[:MAX_LABELS], "more": max(hidden, 0), "column": coloring.name}
    lower, upper = coloring.limits
    title = f"{coloring.name}, {coloring.unit}" if coloring.unit else coloring.name
    title += f": {coloring.meaning}" if coloring.meaning else ""
    if coloring.logarithmic:
        marks = [format_rounded(number, 2) for number in (lower, (lower * upper) ** 0.5, upper)]
    else:  # as many digits as the span needs; adding 0.0 avoids "-0"
        digits = int(np.clip(np.ceil(1 - np.log10(upper - lower)), 0, 6)) if upper > lower else 2
        marks = [
            f"{round(number, digits) + 0.0:,.{digits}f}"
            for number in (lower, (lower + upper) / 2, upper)
        ]
    return scale_legend(title, marks, coloring.scale[::15]) | {
        "limits": [float(lower), float(upper)],
        "logarithmic": coloring.logarithmic,
    }


def scale_legend(title: str, marks: Sequence[str], colors: Floats = TURBO[::15]) -> Legend:
    """Build the legend of a color scale with evenly spaced marks.

    `colors` has shape (n, 3), with values from 0 to 1.
    """
    return {"title": title, "marks": list(marks), "colors": as_bytes(colors).tolist()}
