"""The points on a page, with what one can choose about them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..columns.table import Column
from .colouring import colours_of
from .display import POSITION
from .inside import facing_triangles
from .mesh_node import MeshNode, coloured_triangles
from .page import LivePage

# Size of a point as a share of the scene's diagonal: that they can be seen where there are few,
# and told apart where there are many.
MOST_SHARE, SHARE_OF_MANY = 0.0035, 0.6
MOST_ON_WALLS = 150_000  # points on walls, which take 48 bytes each


class CloudLayer:
    """Points, the choice of their colours and size, and a legend.

    Parameters
    ----------
    page
        Where they are shown.
    quantities
        What the points can be coloured by, see `display.quantities`.
    names
        {label: names of its values 0, 1, 2, …}, for those that have names.
    size_m
        Diagonal of the scene in metres.
    on_change
        Called when something else is to be shown; `draw` shows it.
    """

    def __init__(
        self,
        page: LivePage,
        quantities: Sequence[Column],
        names: Mapping[str, Sequence[str]],
        size_m: float,
        on_change: Callable[[Any], None],
    ) -> None:
        self._page, self._names, self._size_m = page, names, size_m
        self._quantities = {column.name: column for column in quantities}
        self._share = MOST_SHARE
        self._node: Any = None  # viser shows no cloud without points
        self._walls = MeshNode(page, "/cloud-on-walls")
        with page.gui.add_folder("cloud"):
            self._shown = page.gui.add_checkbox("show", initial_value=True)
            self._colour = page.gui.add_dropdown("colour", tuple(self._quantities))
            self._size = page.gui.add_slider("point size", 0.1, 4.0, 0.1, 1.0)
            self._legend = page.gui.add_html("")
        self._colour.on_update(on_change)

        @self._shown.on_update
        def _show(_: Any) -> None:
            self._legend.visible = self._walls.visible = self._shown.value
            if self._node is not None:
                self._node.visible = self._shown.value

        @self._size.on_update
        def _resize(_: Any) -> None:
            if self._node is not None:
                self._node.point_size = self._point_size
            on_change(None)

    @property
    def state(self) -> Hashable:
        """What `draw` depends on, beside the points."""
        return self._colour.value, self._size.value

    def draw(
        self, rows: NDArray[np.void], facing: NDArray[np.float32] | None = None, key: Hashable = 0
    ) -> None:
        """Show these points (see `display_rows`) instead of those before.

        Parameters
        ----------
        facing
            (n, 3): which way the wall faces that a point is on, to be shown from there alone; 0
            where it is on none.
        key
            What differs where these are other points, and not some more.
        """
        column = self._quantities[self._colour.value]
        names = self._names.get(column.name, ())
        colours, legend = colours_of(rows[column.name], column, names)
        self._legend.content = legend.html if len(rows) else ""
        self._share = min(MOST_SHARE, SHARE_OF_MANY / max(1, len(rows)) ** 0.5)
        positions = np.ascontiguousarray(rows[POSITION])
        on_wall = np.zeros(len(rows), np.bool_) if facing is None else facing.any(axis=1)
        self._draw_free(positions[~on_wall], colours[~on_wall])
        if facing is None or not on_wall.any():
            self._walls.clear()
            return
        some = np.flatnonzero(on_wall)
        some = some[:: len(some) // MOST_ON_WALLS + 1]
        corners = facing_triangles(positions[some], facing[some], self._point_size)
        self._walls.show(coloured_triangles(corners, colours[some], 0, lit=False), key)

    def settle(self) -> bool:
        """Clear up after `draw`; returns whether there is more to be cleared up later."""
        return self._walls.settle()

    def _draw_free(self, positions: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
        if not len(positions):
            if self._node is not None:
                self._node.remove()
                self._node = None
        elif self._node is None:
            self._node = self._page.scene.add_point_cloud(
                "/cloud",
                positions,
                colours,
                point_size=self._point_size,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
                visible=self._shown.value,
            )
        else:
            with self._page.atomic():  # else there would be points without colours for a moment
                self._node.points = positions
                self._node.colors = colours
                self._node.point_size = self._point_size

    @property
    def _point_size(self) -> float:
        """Metres."""
        return self._share * self._size_m * self._size.value
