"""A height above which a page shows nothing: its slider, and what it leaves of meshes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .display import POSITION
from .page import LivePage

Reals = NDArray[np.float32]

STEPS = 100  # of the slider, at least


class HeightCut:
    """The height above which nothing is shown; at its upper end everything is.

    Parameters
    ----------
    page
        Where it is.
    bounds
        Box (2, 3), in metres, of what there is to cut.
    base
        World height of the page's origin, metres: the slider tells world heights.
    on_change
        Called when it was moved.
    """

    def __init__(
        self,
        page: LivePage,
        bounds: NDArray[np.float64],
        base: float,
        on_change: Callable[[Any], None],
    ) -> None:
        low, high = bounds[:, 2].tolist()
        step = 10.0 ** math.floor(math.log10(max(high - low, 1e-3) / STEPS))
        digits = max(0, -round(math.log10(step)))
        first = round(math.floor((low + base) / step) * step, digits)
        self._top = round((math.floor((high + base) / step) + 1) * step, digits)
        self._base = base
        self._slider: Any = page.gui.add_slider(
            "cut above, m",
            first,
            self._top,
            step,
            self._top,
            hint="Nothing higher than this is shown.",
        )
        self._slider.on_update(on_change)

    @property
    def height(self) -> float | None:
        """Metres in the page's own coordinates; None where nothing is cut."""
        value = self._slider.value
        return None if value >= self._top else float(value) - self._base

    def below(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Those of the points (see `display_rows`) that are not cut away."""
        height = self.height
        return rows if height is None else rows[rows[POSITION][:, 2] <= height]

    def propose(self, height: float) -> None:
        """Cut at a height, unless somebody has chosen another."""
        if self.height is None:
            self._slider.value = min(max(height + self._base, self._slider.min), self._top)


def triangles_below(corners: Reals, height: float) -> tuple[Reals, NDArray[np.int64]]:
    """Cut triangles at a height and keep what is below.

    Parameters
    ----------
    corners
        (f, 3, 3), finite, metres.
    height
        Metres.

    Returns
    -------
    corners
        (n, 3, 3): whole triangles and pieces, wound as they were.
    source
        (n,): for each the triangle that it is of.
    """
    above = corners[:, :, 2] > height
    count = above.sum(axis=1)
    whole, one, two = (np.flatnonzero(count == n) for n in (0, 1, 2))
    # The corner that is alone on its side comes first.
    a, b, c = _turned(corners[one], above[one].argmax(axis=1))
    ab, ac = _crossing(a, b, height), _crossing(a, c, height)
    d, e, f = _turned(corners[two], (~above[two]).argmax(axis=1))
    pieces = [
        corners[whole],
        np.stack([ab, b, c], axis=1),
        np.stack([ab, c, ac], axis=1),
        np.stack([d, _crossing(d, e, height), _crossing(d, f, height)], axis=1),
    ]
    return np.concatenate(pieces), np.concatenate([whole, one, one, two])


def lines_below(ends: Reals, height: float) -> Reals:
    """Cut lines (n, 2, 3) at a height and keep what is below; those wholly above are dropped."""
    above = ends[:, :, 2] > height
    out = ends[~above.all(axis=1)].copy()
    above = above[~above.all(axis=1)]
    for end in (0, 1):
        cut = above[:, end]
        out[cut, end] = _crossing(out[cut, end], out[cut, 1 - end], height)
    return out


def _turned(corners: Reals, first: NDArray[np.int64]) -> tuple[Reals, Reals, Reals]:
    """Corners of triangles (n, 3, 3), in their order, beginning with that of this number (n,)."""
    rows = np.arange(len(corners))
    a, b, c = (corners[rows, (first + k) % 3] for k in range(3))
    return a, b, c


def _crossing(a: Reals, b: Reals, height: float) -> Reals:
    """Where lines from a to b, (n, 3) both and on two sides of a height, cross it."""
    share = (height - a[:, 2]) / (b[:, 2] - a[:, 2])
    out = a + share[:, None] * (b - a)
    out[:, 2] = height
    return out
