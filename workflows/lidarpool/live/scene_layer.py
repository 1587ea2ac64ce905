"""The scene on a page, coloured by the rays that hit it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Scene
from ..view.intensity_picture import density_range
from .colouring import TURBO, ColourBar
from .glb import coloured_triangles
from .page import LivePage
from .surface import DisplaySurface

TITLE = "hits per square metre; grey: none"
_UNSEEN = np.array([186, 190, 196], np.float64)


class SceneLayer:
    """The scene's surface, a colour bar, and a switch to hide it.

    Parameters
    ----------
    page
        Where it is shown.
    scene
        The scene.
    """

    def __init__(self, page: LivePage, scene: Scene) -> None:
        self._page, self._scene = page, scene
        self._surface: DisplaySurface | None = None
        self._node: Any = None
        with page.gui.add_folder("scene"):
            self._shown = page.gui.add_checkbox("show", initial_value=True)
            self._legend = page.gui.add_html("")

        @self._shown.on_update
        def _show(_: Any) -> None:
            if self._node is not None:
                self._node.visible = self._shown.value

    def draw(self, hit_counts: NDArray[np.int64]) -> None:
        """Show the hits (f,) of each triangle so far."""
        if self._surface is None:  # of millions of triangles it takes seconds
            self._surface = DisplaySurface(self._scene)
        density, hit = self._surface.density(hit_counts)
        limits = density_range(density)
        data = coloured_triangles(self._surface.corners, intensity_colours(density, hit, limits))
        if self._node is None:
            self._node = self._page.scene.add_glb(
                "/scene", data, cast_shadow=False, receive_shadow=False, visible=self._shown.value
            )
        else:
            self._node.glb_data = data
        if density.any():
            self._legend.content = ColourBar(TITLE, *limits, logarithmic=True).html


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
