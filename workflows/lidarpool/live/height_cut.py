"""A slider on a page that takes away whatever is above a height."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .page import LivePage

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
        """Those of the points (DISPLAY) that are not cut away."""
        height = self.height
        return rows if height is None else rows[rows["position"][:, 2] <= height]

    def propose(self, height: float) -> None:
        """Cut at a height, unless somebody has chosen another."""
        if self.height is None:
            self._slider.value = min(max(height + self._base, self._slider.min), self._top)
