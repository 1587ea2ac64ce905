"""Colours of the pictures: light and dark pages, one colour an object, colour maps."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from functools import cached_property

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# Distinct on light and on dark pages, also for most colour-blind readers (after Paul Tol's
# "bright" and "muted" sets, 2021, in an order that keeps neighbours apart).
OBJECT_COLOURS = (
    "#4477aa", "#ee7733", "#44aa77", "#cc6677", "#66b8d9", "#ccaa33",
    "#8a63b0", "#997755", "#88aa44", "#cc77b8", "#336688", "#b0574f",
)  # fmt: skip


@dataclass(frozen=True)
class Theme:
    """Colours of one page, as matplotlib names them."""

    page: str
    ground: str
    line: str
    ink: str
    muted: str
    clay: str
    unseen: str
    sensor: str
    ray: str

    @cached_property
    def rgb(self) -> dict[str, Floats]:
        """Every colour as float64 (3,) in 0 to 1, by name."""
        return {name: np.array(to_rgb(value)) for name, value in vars(self).items() if value}


LIGHT = Theme(
    page="#ffffff",
    ground="#f1f3f5",
    line="#c3cad3",
    ink="#1c2430",
    muted="#5d6876",
    clay="#d9dde2",
    unseen="#c9ccd1",
    sensor="#e0182d",
    ray="#e0182d",
)
DARK = Theme(
    page="#0e131a",
    ground="#19212b",
    line="#3a4655",
    ink="#e8edf3",
    muted="#9aa7b5",
    clay="#4a545f",
    unseen="#59616b",
    sensor="#ff4d5e",
    ray="#ff6b78",
)


def theme_for(dark: bool) -> Theme:
    """Return the page's theme."""
    return DARK if dark else LIGHT


def object_colours(count: int) -> Floats:
    """Colours of `count` objects, (count, 3) in 0 to 1.

    The first twelve are a chosen set; more are spread over the hues by the golden angle, with
    lightness in three steps.
    """
    chosen = [to_rgb(colour) for colour in OBJECT_COLOURS[:count]]
    more = [
        colorsys.hls_to_rgb((0.08 + 0.618034 * n) % 1.0, (0.42, 0.56, 0.68)[n % 3], 0.5)
        for n in range(count - len(chosen))
    ]
    return np.array(chosen + more, dtype=np.float64).reshape(count, 3)


def mapped(name: str, fraction: ArrayLike) -> Floats:
    """Colours (n, 3) of a matplotlib colour map at fractions (n,) in 0 to 1."""
    return np.asarray(matplotlib.colormaps[name](np.asarray(fraction)), dtype=np.float64)[..., :3]
