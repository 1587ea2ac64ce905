"""The page: a viser server for this machine only, its camera, ground and light."""

from __future__ import annotations

import asyncio
import io
import itertools
import logging
import math
import os
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from queue import Empty, SimpleQueue
from urllib.parse import quote, unquote, urlsplit

import click
import numpy as np
import rich
import viser
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from viser.infra import WebsockClientConnection

from ..base.notebook import cell_display

HOST = "127.0.0.1"
PORT = 8080  # or the next that is free
PICTURE = "lidarpool.png"
LAST_S = 30.0  # to wait for the last drawing

# A browser reaches this machine by these names, also through a port forwarded by SSH, with any
# number. A foreign DNS name that points here is not among them.
OWN_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})

_POLICY_VIOLATION = 1008  # RFC 6455, 7.4.1
_FOV = math.radians(45)
# From the scene's middle to the camera.
_SIDES = {"all": (0.55, -1.0, 0.62), "top": (0.0, -1e-3, 1.0), "side": (0.0, -1.0, 0.0)}
# Of a window, by half its height: what the scene may fill left of the panel, and how far the
# middle of that is from the middle of the window.
_WIDE, _HIGH, _ASIDE = 1.15, 0.88, 0.42
# Light of about pi in all: under more, colours are paler than they are. viser's own lights make a
# floor of any colour nearly white.
_AROUND, _SUN = 1.3, 2.0
_FROM = (0.15, -0.75, 1.2)  # left of the camera's first place, so that no two sides look alike
_LIGHT, _DARK = (255, 255, 255), (20, 20, 20)  # behind all
_GRID = (128, 134, 142)

# Runs when the page loads it, as a script would not (HTML, 4.12.1.1).
_TICK_IF_DARK = (
    '<img src="data:," style="display:none" onerror="const box = document.getElementById(\'{}\');'
    "if (box && !box.checked && matchMedia('(prefers-color-scheme: dark)').matches) box.click()\">"
)

_LOGGER = logging.getLogger(__name__)


class LivePage(viser.ViserServer):
    """A page for users of this machine only, on a port or the next that is free; 0 for any."""

    def __init__(self, title: str, port: int) -> None:
        super().__init__(host=HOST, port=port, label=title, verbose=False)
        self._links: SimpleQueue[str] = SimpleQueue()  # paths
        self._websock_server.on_client_connect(self._admit)
        # Earlier connections reconnect: viser listens before this check is in place.
        self._websock_server.disconnect_all_clients()
        _set_theme(self, dark=False)
        self._dark: dict[int, viser.GuiCheckboxHandle] = {}  # {client: its choice}
        self.on_client_connect(self._add_dark)
        self.scene.configure_environment_map(None)
        self.scene.configure_default_lights(enabled=False, cast_shadow=False)
        self.scene.add_light_ambient("/light/around", intensity=_AROUND)
        self.scene.add_light_directional("/light/sun", intensity=_SUN, position=_FROM)

    SIDES = tuple(_SIDES)
    _bounds = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])

    async def _admit(self, client: WebsockClientConnection) -> None:
        """Keep pages from elsewhere from reading the content or pressing buttons.

        viser itself accepts every connection. Listening on the loopback interface does not help:
        the browser with the foreign page is on this machine.
        """
        connection = self._websock_server._live_connections[client.client_id]
        request = connection.request
        origins = request.headers.get_all("Origin") if request else []
        if may_connect(origins):
            if request is not None and request.path.strip("/"):
                self._links.put(request.path)
            return
        _LOGGER.warning("a page of %r wanted to connect to the live page: refused", origins)
        await connection.close(_POLICY_VIOLATION, "only pages of this machine may connect")
        # Its messages so far would still be handled, so closing is not enough. The next
        # that the handler of this connection does is to wait for what sends and takes messages:
        # cancelled by then, it starts neither, and takes the client off its tables.
        task = asyncio.current_task()
        assert task is not None
        task.cancel()

    def _add_dark(self, client: viser.ClientHandle) -> None:
        """Give a browser its own choice of colours, at first as its system has it.

        viser does not know the system's choice, so the page itself ticks the box, once.
        """
        box = client.gui.add_checkbox("dark", initial_value=False, order=1e6)  # the last one
        ticks = client.gui.add_html(_TICK_IF_DARK.format(box._impl.uuid))
        self._dark[client.client_id] = box

        @box.on_update
        def choose(_: viser.GuiEvent[viser.GuiCheckboxHandle]) -> None:
            _set_theme(client, box.value)
            ticks.content = ""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: viser would open a tunnel to this page from the internet."""

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://{HOST}:{self.get_port()}"

    def look_from(self, client: viser.ClientHandle, side: str) -> None:
        """Move the camera of a browser to a side from which it sees the whole."""
        low, high = self._bounds
        look_at, position = place_camera(low, high, side)
        place_eye(client, position, look_at)

    def save_picture(self, client: viser.ClientHandle) -> None:
        """Let a browser save its view, without the panel, as a PNG file."""
        height, width = client.camera.image_height, client.camera.image_width
        drawn = client.get_render(height, width, transport_format="png", timeout=LAST_S)
        dark = self._dark[client.client_id].value
        image = Image.new("RGB", (width, height), _DARK if dark else _LIGHT)
        layer = Image.fromarray(drawn)
        image.paste(layer, mask=layer.getchannel("A"))
        data = io.BytesIO()
        image.save(data, "PNG")
        client.send_file_download(PICTURE, data.getvalue(), save_immediately=True)

    def link(self, client: viser.ClientHandle, choices: Sequence[tuple[str, str]]) -> str:
        """Address of the view of a browser, with these choices.

        viser's page takes the camera from its address, and where to connect; choices are told
        as the path of that.
        """
        own = f"{HOST}:{self.get_port()}"
        request = self._websock_server._live_connections[client.client_id].request
        if request is not None and (origin := request.headers.get("Origin")):
            own = urlsplit(origin).netloc  # the port may be forwarded
        path = ";".join(f"{name}={quote(value, safe=',')}" for name, value in choices)
        camera = {"Position": client.camera.position, "LookAt": client.camera.look_at}
        places = [
            f"initialCamera{name}={','.join(f'{metres:.6g}' for metres in place)}"
            for name, place in camera.items()
        ]
        return f"http://{own}/?{'&'.join(places)}&websocket={quote(f'ws://{own}/{path}', safe='')}"

    def opened_link(self) -> list[tuple[str, str]] | None:
        """Choices of the next link that a browser has opened, or None."""
        try:
            path = self._links.get_nowait()
        except Empty:
            return None
        entries = (entry.partition("=") for entry in path.strip("/").split(";"))
        return [(name, unquote(value)) for name, _, value in entries]

    def frame_scene(self, bounds: ArrayLike) -> None:
        """Place the camera to see all of a box, (2, 3) in metres, with Z up, and a grid below.

        The lines of the grid are whole metres apart, or tenths or tens of them.
        """
        self._bounds = low, high = np.asarray(bounds, np.float64)
        size = float(np.linalg.norm(high - low)) or 1.0
        camera = self.initial_camera
        camera.fov = _FOV
        camera.look_at, camera.position = place_camera(low, high)
        camera.up = np.array([0.0, 0.0, 1.0])
        camera.near, camera.far = size / 500, size * 50
        step = 10.0 ** math.floor(math.log10(size / 4))
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


def place_camera(
    low: NDArray[np.float64], high: NDArray[np.float64], side: str = "all"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Find where a camera looks, (3,), and where it is, (3,), to see all corners of a box."""
    away = np.array(_SIDES[side]) / np.linalg.norm(_SIDES[side])
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    up = np.cross(away, right)
    middle = (low + high) / 2
    corners = np.array(list(itertools.product(*np.stack([low, high]).T))) - middle
    wide, tall = np.abs(corners @ right), np.abs(corners @ up)
    reach = np.maximum(wide / _WIDE, tall / _HIGH) / math.tan(_FOV / 2)
    distance = float((corners @ away + reach).max()) or 1.0
    at = middle + _ASIDE * math.tan(_FOV / 2) * distance * right
    return at, at + distance * away


def place_eye(
    client: viser.ClientHandle, position: NDArray[np.float64], look_at: NDArray[np.float64]
) -> None:
    """Move the camera of a browser."""
    with client.atomic():
        client.camera.up_direction = np.array([0.0, 0.0, 1.0])
        client.camera.position = position
        client.camera.look_at = look_at


def may_connect(origins: Iterable[str]) -> bool:
    """Whether a connection with these ``Origin`` headers is from this machine.

    A browser lets any page connect to any server, and sends the server the page's origin
    (RFC 6454). A connection without the header is not from a browser.

    Examples
    --------
    >>> may_connect(["http://localhost:8080"]), may_connect([])
    (True, True)
    >>> may_connect(["https://localhost.example.com"]), may_connect(["null"])
    (False, False)
    """
    try:
        parts = [urlsplit(origin) for origin in origins]
        return all(p.scheme in ("http", "https") and p.hostname in OWN_NAMES for p in parts)
    except ValueError:  # no address at all
        return False


def _set_theme(whose: viser.ViserServer | viser.ClientHandle, dark: bool) -> None:
    whose.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=dark)


@contextmanager
def live_page(title: str, port: int = PORT) -> Iterator[LivePage]:
    """Serve a page while the body runs, on a port or the next that is free; 0 for any."""
    with _without_words():
        page = LivePage(title, port)
    try:
        yield page
    finally:
        with _without_words():
            page.stop()


@contextmanager
def _without_words() -> Iterator[None]:
    """Suppress viser's output at start and end."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


@contextmanager
def announced(page: LivePage, words: str, browser: bool) -> Iterator[None]:
    """Tell a page's address while the body runs, or show the page in the cell of a notebook.

    `browser`: open one where there is a desktop, and no notebook.
    """
    display = cell_display()
    if display is None:
        click.echo(words, err=True)
        if browser:
            open_browser(page.url)
        yield
        return
    link = f'<a href="{page.url}" target="_blank">{escape(words)}</a>'
    below = f'<iframe src="{page.url}" style="width:100%;height:560px;border:0"></iframe>'
    if "JUPYTERHUB_SERVICE_PREFIX" in os.environ:  # a frame would show the reader's own machine
        port = page.get_port()
        below = (
            "This address is on the kernel's machine, and the hub leads nobody there: connect "
            f"with ssh -L {port}:{HOST}:{port} and the machine's name, then open it."
        )
    shown = display.display(display.HTML(f"{link}<br>{below}"), display_id=True)
    try:
        yield
    finally:
        shown.update(display.HTML(""))


@contextmanager
def redrawn(draw: Callable[[], float], every_s: float) -> Iterator[None]:
    """Call a function repeatedly in a thread while the body runs, and once at its end.

    The function draws changes, and returns the share of one core that it may take of the time until
    it is called again; that is in `every_s` seconds at least. An error is logged, and ends the
    drawing but not the body.
    """
    ended = threading.Event()

    def run() -> None:
        try:
            while True:
                last, started = ended.is_set(), time.thread_time()
                share = draw()
                if last:
                    return
                took = time.thread_time() - started  # processor time: waiting does not count
                ended.wait(max(every_s, took / share - took))
        except Exception:
            _LOGGER.exception("the page cannot be drawn any more")

    thread = threading.Thread(target=run, name="lidarpool-live", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(LAST_S)


def open_browser(url: str) -> bool:
    """Open a page if there is a desktop to open it on; returns whether there is."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return False  # else a browser in the terminal would take it over
    if "SSH_CONNECTION" in os.environ:
        return False
    return webbrowser.open(url)
