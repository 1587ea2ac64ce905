"""The points on a page, with what one can choose about them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .colouring import colours_of
from .display import DISPLAY
from .page import LivePage

# Size of a point as a share of the scene's diagonal: that they can be seen where there are few,
# and told apart where there are many.
MOST_SHARE, SHARE_OF_MANY = 0.0035, 0.6


class CloudLayer:
    """Points, the choice of their colours and size, and a legend.

    Parameters
    ----------
    page
        Where they are shown.
    names
        Names of the objects, by number.
    quantities
        Those of `QUANTITIES` that the points have.
    size_m
        Diagonal of the scene in metres.
    on_change
        Called when something else is to be shown; `draw` shows it.
    """

    def __init__(
        self,
        page: LivePage,
        names: Sequence[str],
        quantities: Sequence[str],
        size_m: float,
        on_change: Callable[[Any], None],
    ) -> None:
        self._page, self._names, self._size_m = page, names, size_m
        self._share = MOST_SHARE
        empty = np.empty(0, DISPLAY)
        self._node = page.scene.add_point_cloud(
            "/cloud",
            empty["position"],
            np.empty((0, 3), np.uint8),
            point_size=MOST_SHARE * size_m,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
        with page.gui.add_folder("cloud"):
            self._shown = page.gui.add_checkbox("show", initial_value=True)
            self._colour = page.gui.add_dropdown("colour", tuple(quantities))
            self._size = page.gui.add_slider("point size", 0.1, 4.0, 0.1, 1.0)
            self._legend = page.gui.add_html("")
        self._colour.on_update(on_change)

        @self._shown.on_update
        def _show(_: Any) -> None:
            self._node.visible = self._shown.value

        @self._size.on_update
        def _resize(_: Any) -> None:
            self._resize_points()

    def draw(self, rows: NDArray[np.void]) -> None:
        """Show these points (DISPLAY) instead of those before."""
        colours, legend = colours_of(rows, self._colour.value, self._names)
        with self._page.atomic():  # else there would be points without colours for a moment
            self._node.points = np.ascontiguousarray(rows["position"])
            self._node.colors = colours
            self._legend.content = legend.html
            self._share = min(MOST_SHARE, SHARE_OF_MANY / max(1, len(rows)) ** 0.5)
            self._resize_points()

    def _resize_points(self) -> None:
        self._node.point_size = self._share * self._size_m * self._size.value
