"""Define the colors of all plots."""

from __future__ import annotations

import colorsys

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike

from lidarsim.numerics.arrays import Floats

PAGE = "#ffffff"
GROUND = "#f1f3f5"
LINE = "#c3cad3"
INK = "#1c2430"
MUTED = "#5d6876"
CLAY = "#d9dde2"
UNSEEN = "#c9ccd1"
SENSOR = "#101317"  # sensors, paths and rays; no color scale contains it
EMPHASIS = "#e0182d"
RANGE_COLORS = "viridis_r"  # colormap of range images, in which short ranges are yellow
VEIL = 0.085  # opacity of MUTED over the page, which is the color of the ground
# In pictures within an HTML page, the style sheet of the page defines these colors.
STYLED = {
    PAGE: "page", GROUND: "ground", LINE: "line", INK: "ink", MUTED: "muted", UNSEEN: "unseen",
    SENSOR: "sensor", EMPHASIS: "emphasis",
}  # fmt: skip

# The first twelve colors are distinct even for most color-blind readers. They follow the "bright"
# and "muted" sets by Paul Tol (2021), in an order that keeps neighbors distinct. Each further color
# is the one that differs most from the colors before it in OKLab.
OBJECT_COLORS = (
    "#4477aa", "#ee7733", "#44aa77", "#cc6677", "#66b8d9", "#ccaa33",
    "#8a63b0", "#997755", "#88aa44", "#cc77b8", "#336688", "#b0574f",
    "#662266", "#226622", "#663322", "#77ddaa", "#dddd88", "#dd9999",
    "#554499", "#993366", "#558822", "#9999dd", "#228877", "#2299dd",
    "#775522", "#334466", "#ddaadd", "#99aa88", "#5599aa", "#993322",
)  # fmt: skip


def rgb(color: str) -> Floats:
    """Return a color as an array of values from 0 to 1.

    The shape is (3,).
    """
    return np.array(to_rgb(color))


def object_colors(count: int) -> Floats:
    """Return distinct colors for objects, with values from 0 to 1.

    The first colors come from `OBJECT_COLORS`. Further colors are spread over the hues by
    the golden angle, with three levels of lightness. The shape is (count, 3).
    """
    chosen = [to_rgb(color) for color in OBJECT_COLORS[:count]]
    further = [
        colorsys.hls_to_rgb((0.08 + 0.618034 * n) % 1.0, (0.42, 0.56, 0.68)[n % 3], 0.5)
        for n in range(count - len(chosen))
    ]
    return np.array(chosen + further, dtype=np.float64).reshape(count, 3)


def apply_colormap(name: str, fraction: ArrayLike) -> Floats:
    """Return the colors of a Matplotlib colormap at the given fractions from 0 to 1."""
    return np.asarray(matplotlib.colormaps[name](np.asarray(fraction)), dtype=np.float64)[..., :3]
