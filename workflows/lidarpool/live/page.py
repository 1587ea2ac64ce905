"""The page: a viser server on the loopback interface, its camera, ground and theme."""

from __future__ import annotations

import itertools
import math
import os
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import rich
import viser
from numpy.typing import ArrayLike, NDArray

from .visitors import refuse_strangers

HOST = "127.0.0.1"
PORT = 8080  # or the next that is free

_FOV = math.radians(45)
_AWAY = np.array([0.55, -1.0, 0.62])  # from the scene's middle to the camera
_AWAY /= np.linalg.norm(_AWAY)
_RIGHT = np.cross([0.0, 0.0, 1.0], _AWAY)
_RIGHT /= np.linalg.norm(_RIGHT)
_UP = np.cross(_AWAY, _RIGHT)
# Of a window, by half its height: what the scene may fill left of the panel, and how far the
# middle of that is from the middle of the window.
_WIDE, _HIGH, _ASIDE = 1.15, 0.88, 0.42
# Light of about pi in all: under more, colours are paler than they are. viser's own lights make a
# floor of any colour nearly white.
_AROUND, _SUN = 1.3, 2.0
_FROM = (0.15, -0.75, 1.2)  # left of the camera's first place, so that no two sides look alike
_GRID = (128, 134, 142)  # lines that are seen on a light page and on a dark one


class LivePage(viser.ViserServer):
    """A page for anybody on this machine, and for nobody else.

    Parameters
    ----------
    title
        Title of its panel.
    port
        Port to listen on, or the next that is free; 0 for any.
    """

    def __init__(self, title: str, port: int) -> None:
        super().__init__(host=HOST, port=port, label=title, verbose=False)
        refuse_strangers(self)

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: viser would open a way to this page from the whole internet."""

    @property
    def url(self) -> str:
        """Where it is."""
        return f"http://{HOST}:{self.get_port()}"

    def show_theme(self, dark: bool) -> None:
        """Show the page light or dark."""
        self.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)

    def frame_scene(self, bounds: ArrayLike) -> None:
        """Put the camera where it sees all of a box, (2, 3) in metres, with Z up, and a grid below.

        The lines of the grid are whole metres apart, or tenths or tens of them.
        """
        low, high = np.asarray(bounds, np.float64)
        size = float(np.linalg.norm(high - low)) or 1.0
        middle, distance = place_camera(low, high)
        camera = self.initial_camera
        camera.fov = _FOV
        camera.look_at = middle
        camera.position = middle + distance * _AWAY
        camera.up = np.array([0.0, 0.0, 1.0])
        camera.near, camera.far = size / 500, size * 50
        self._add_grid(low, high, size)

    def _add_grid(self, low: NDArray[np.float64], high: NDArray[np.float64], size: float) -> None:
        step = grid_step(size)
        centre = step * np.round((low + high) / (2 * step))
        self.scene.add_grid(
            "/ground",
            width=step * math.ceil(1.4 * (high[0] - low[0]) / step + 4),
            height=step * math.ceil(1.4 * (high[1] - low[1]) / step + 4),
            cell_size=step,
            cell_color=_GRID,
            section_size=5 * step,
            section_color=_GRID,
            section_thickness=1.5,
            fade_distance=20 * size,
            shadow_opacity=0.0,
            position=(float(centre[0]), float(centre[1]), float(low[2]) - 0.002 * size),
        )

    def light_evenly(self) -> None:
        """Replace the lights, so that the colours of a surface are those of its bar."""
        self.scene.configure_environment_map(None)
        self.scene.configure_default_lights(enabled=False, cast_shadow=False)
        self.scene.add_light_ambient("/light/around", intensity=_AROUND)
        self.scene.add_light_directional("/light/sun", intensity=_SUN, position=_FROM)

    def add_page_controls(self, step_m: float) -> None:
        """Add what every page has at the end of its panel."""
        with self.gui.add_folder("page", expand_by_default=False):
            dark = self.gui.add_checkbox("dark", initial_value=False)
            self.gui.add_markdown(f"Metres, Z up; the grid's lines are {step_m:g} m apart.")
        dark.on_update(lambda _: self.show_theme(dark.value))


def place_camera(
    low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Find where a camera looks, (3,), and from how far, to see all corners of a box."""
    middle = (low + high) / 2
    corners = np.array(list(itertools.product(*np.stack([low, high]).T))) - middle
    wide, tall = np.abs(corners @ _RIGHT), np.abs(corners @ _UP)
    reach = np.maximum(wide / _WIDE, tall / _HIGH) / math.tan(_FOV / 2)
    distance = float((corners @ _AWAY + reach).max()) or 1.0
    return middle + _ASIDE * math.tan(_FOV / 2) * distance * _RIGHT, distance


def grid_step(size: float) -> float:
    """Metres between lines of a grid under a scene of this diagonal."""
    return float(10.0 ** math.floor(math.log10(size / 4)))


@contextmanager
def live_page(title: str, port: int = PORT) -> Iterator[LivePage]:
    """Serve a page while the body runs.

    Parameters
    ----------
    title
        Title of its panel.
    port
        Port to listen on, or the next that is free; 0 for any.
    """
    console = rich.get_console()  # viser tells there what is going on, as it runs and as it ends
    before, console.quiet = console.quiet, True
    try:
        page = LivePage(title, port)
        try:
            page.show_theme(dark=False)
            yield page
        finally:
            page.stop()
    finally:
        console.quiet = before


def open_browser(url: str) -> bool:
    """Open a page if there is a desktop to open it on; returns whether there is."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return False  # else a browser in the terminal would take it over
    if "SSH_CONNECTION" in os.environ:
        return False
    return webbrowser.open(url)
