"""The scene on a page, coloured by the rays that hit it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Scene
from ..view.intensity_picture import density_range
from .clipping import triangles_below
from .colouring import TURBO, ColourBar
from .glb import coloured_triangles
from .height_cut import HeightCut
from .inside import InsideView
from .light import light_evenly
from .mesh_node import MeshNode
from .page import LivePage
from .surface import DisplaySurface
from .walls import Walls

TITLE = "hits per square metre; grey: none"
_UNSEEN = np.array([186, 190, 196], np.float64)

Corners = NDArray[np.float32]
Ints = NDArray[np.int64]


class SceneLayer:
    """The scene's surface, a colour bar, and switches for it and for its near walls.

    Parameters
    ----------
    page
        Where it is shown.
    scene
        The scene.
    poses
        (p, 3) where the sensors stand, metres, local.
    cut
        Above which nothing is shown; if the sensors are under a roof, it is set below that.
    on_change
        Called when something else is to be shown; `draw` shows it.
    """

    def __init__(
        self,
        page: LivePage,
        scene: Scene,
        poses: NDArray[np.float64],
        cut: HeightCut,
        on_change: Callable[[Any], None],
    ) -> None:
        self._scene, self._poses, self._cut = scene, poses, cut
        light_evenly(page)
        self._node = MeshNode(page, "/scene")
        self._shape: tuple[Hashable, Corners, Ints, int] | None = None
        with page.gui.add_folder("scene"):
            self._shown = page.gui.add_checkbox("show", initial_value=True)
            self._near = page.gui.add_checkbox(
                "near walls",
                initial_value=False,
                visible=False,
                hint="Walls and roofs between you and the sensors.",
            )
            self._legend = page.gui.add_html("")
        self._near.on_update(on_change)

        @self._shown.on_update
        def _show(_: Any) -> None:
            self._node.visible = self._legend.visible = self._shown.value

        # Of millions of triangles it takes seconds, which the rest of the page need not wait for.
        executor = ThreadPoolExecutor(1, thread_name_prefix="lidarpool-live")
        self._prepared: Future[tuple[DisplaySurface, InsideView, Walls | None]] = executor.submit(
            self._prepare
        )
        self._prepared.add_done_callback(on_change)
        executor.shutdown(wait=False)

    @property
    def state(self) -> Hashable:
        """What `draw` depends on, beside the hits."""
        return self._prepared.done(), self._cut.height, self._near.value

    def draw(self, hit_counts: NDArray[np.int64]) -> None:
        """Show the hits (f,) of each triangle so far, as soon as there is something to show.

        Raises
        ------
        Exception
            If the scene could not be made ready.
        """
        if not self._prepared.done():
            return
        surface = self._prepared.result()[0]
        density, hit = surface.density(hit_counts)
        limits = density_range(density)
        key, corners, source, two_sided = self._shape_now()
        if len(corners):
            colours = intensity_colours(density, hit, limits)[source]
            self._node.show(coloured_triangles(corners, colours, two_sided), key)
        else:
            self._node.clear()
        if density.any():
            self._legend.content = ColourBar(TITLE, *limits, logarithmic=True).html

    def settle(self) -> bool:
        """Clear up after `draw`; returns whether there is more to be cleared up later."""
        return self._node.settle()

    def facing(self, positions: Corners) -> Corners | None:
        """Which way walls face that are shown from one side, at positions (n, 3).

        See `Walls.facing_at`; None where all is shown from both sides.
        """
        if not self._prepared.done() or self._near.value:
            return None
        walls = self._prepared.result()[2]
        return None if walls is None else walls.facing_at(positions)

    def _prepare(self) -> tuple[DisplaySurface, InsideView, Walls | None]:
        surface = DisplaySurface(self._scene)
        inside = InsideView.of(surface.coarse, self._poses)
        if inside.ceiling is not None:
            self._cut.propose(inside.ceiling)
        self._near.visible = bool(inside.shell.any())
        walls = Walls.of(inside.wound(surface.corners)[inside.shell])
        return surface, inside, walls

    def _shape_now(self) -> tuple[Hashable, Corners, Ints, int]:
        """Triangles to show.

        Returns
        -------
        key
            What they depend on.
        corners
            (n, 3, 3).
        source
            (n,): which triangle of the surface each is of.
        two_sided
            How many of them, from the first, are seen from both sides.
        """
        height = self._cut.height
        key = height, self._near.value
        if self._shape is not None and self._shape[0] == key:
            return self._shape
        surface, inside, _ = self._prepared.result()
        corners, source = inside.wound(surface.corners), np.arange(len(surface.corners))
        if height is not None:
            corners, source = triangles_below(corners, height)
        one_sided = inside.shell[source] & (not self._near.value)
        order = np.argsort(one_sided, kind="stable")
        two_sided = int((~one_sided).sum())
        self._shape = key, corners[order], source[order], two_sided
        return self._shape


def intensity_colours(
    density: NDArray[np.float64], hit: NDArray[np.bool_], limits: tuple[float, float]
) -> NDArray[np.uint8]:
    """Colours (f, 3) on a logarithmic scale, as in intensity.png.

    What was hit by none is grey; where hits were shared with the triangles around, they fade
    out to grey.
    """
    low, high = limits
    share = np.log(np.maximum(density, low) / low) / np.log(high / low)
    colours = TURBO[np.clip(share * 255, 0, 255).astype(np.uint8)]
    seen = np.where(hit, 1.0, np.clip(density / low / 0.6 - 0.3, 0, 1))[:, None]
    return np.round(_UNSEEN * (1 - seen) + colours * seen).astype(np.uint8)
