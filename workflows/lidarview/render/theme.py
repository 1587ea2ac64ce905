"""Colors of the pictures."""

from __future__ import annotations

import colorsys

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike

from lidarsim.base.arrays import Floats

PAGE = "#ffffff"
GROUND = "#f1f3f5"
LINE = "#c3cad3"
INK = "#1c2430"
MUTED = "#5d6876"
CLAY = "#d9dde2"
UNSEEN = "#c9ccd1"
SENSOR = "#e0182d"
RANGE_COLORS = "viridis_r"  # color map of range images: yellow is near
VEIL = 0.085  # share of MUTED over the page: the ground in a rendered picture
# In pictures within a page, the style of the page defines these colors.
STYLED = {
    PAGE: "page", GROUND: "ground", LINE: "line", INK: "ink", MUTED: "muted", UNSEEN: "unseen",
    SENSOR: "sensor",
}  # fmt: skip

# Distinct even for most color-blind readers (after Paul Tol's "bright" and "muted" sets, 2021,
# in an order that keeps neighbors apart).
OBJECT_COLORS = (
    "#4477aa", "#ee7733", "#44aa77", "#cc6677", "#66b8d9", "#ccaa33",
    "#8a63b0", "#997755", "#88aa44", "#cc77b8", "#336688", "#b0574f",
)  # fmt: skip


def rgb(color: str) -> Floats:
    """Return a color as (3,) in 0 to 1."""
    return np.array(to_rgb(color))


def object_colors(count: int) -> Floats:
    """Return the colors of `count` objects, (count, 3) in 0 to 1.

    The first twelve are a chosen set; further colors are spread over the hues by the golden angle,
    with lightness in three steps.
    """
    chosen = [to_rgb(color) for color in OBJECT_COLORS[:count]]
    further = [
        colorsys.hls_to_rgb((0.08 + 0.618034 * n) % 1.0, (0.42, 0.56, 0.68)[n % 3], 0.5)
        for n in range(count - len(chosen))
    ]
    return np.array(chosen + further, dtype=np.float64).reshape(count, 3)


def mapped(name: str, fraction: ArrayLike) -> Floats:
    """Return the colors (n, 3) of a matplotlib color map at fractions (n,) in 0 to 1."""
    return np.asarray(matplotlib.colormaps[name](np.asarray(fraction)), dtype=np.float64)[..., :3]
