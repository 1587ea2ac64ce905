"""The sensor on a page, and some of its rays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scan import Frame
from .page import LivePage

_RED = (224, 24, 45)
_EARLIER = (232, 140, 150)


class SensorLayer:
    """A red ball where the sensor is, the rays of its last frame, and paler ones of earlier ones.

    Parameters
    ----------
    page
        Where they are shown.
    size_m
        Diagonal of the scene in metres.
    """

    def __init__(self, page: LivePage, size_m: float) -> None:
        self._page = page
        self._ball = page.scene.add_icosphere(
            "/sensor", 0.009 * size_m, _RED, visible=False, cast_shadow=False
        )
        page.scene.add_label("/sensor/label", "sensor", anchor="bottom-left")
        self._rays: dict[str, Any] = {}  # {name: node}; viser shows no empty ones
        with page.gui.add_folder("sensor"):
            self._shown = page.gui.add_checkbox("rays", initial_value=True)

        @self._shown.on_update
        def _show(_: Any) -> None:
            for node in self._rays.values():
                node.visible = self._shown.value

    def draw(self, frame: Frame) -> None:
        """Show the sensor and the rays of a frame."""
        place = np.asarray(frame.pose.position, np.float32)
        self._ball.position = place
        self._ball.visible = True
        starts = np.broadcast_to(place, frame.samples.shape)
        self._draw_rays("latest", np.stack([starts, frame.samples], axis=1), _RED, 1.6)

    def draw_earlier(self, rays: NDArray[np.float32]) -> None:
        """Show rays (n, 2, 3) of all frames so far."""
        self._draw_rays("earlier", rays, _EARLIER, 1.0)

    def _draw_rays(
        self, name: str, rays: NDArray[np.float32], colour: tuple[int, int, int], width: float
    ) -> None:
        if not len(rays):
            return
        if name in self._rays:
            self._rays[name].points = rays
        else:
            self._rays[name] = self._page.scene.add_line_segments(
                f"/rays/{name}",
                rays,
                colour,
                thickness=width,
                thickness_units="screen",
                visible=self._shown.value,
            )
