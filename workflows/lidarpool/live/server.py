"""Serves a page to browsers of this machine: files, and answers to what the page asks for.

The page asks with GET and gives orders with POST. All addresses within it are relative, so that it
also works behind a proxy.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from html import escape
from importlib.resources import files
from importlib.util import find_spec
from typing import Any, Protocol

import click
from numpy.typing import NDArray
from tornado.httpserver import HTTPServer
from tornado.iostream import StreamClosedError
from tornado.web import Application, HTTPError, RequestHandler

from ..base.notebook import cell_display
from .points import Abandoned

HOST = "127.0.0.1"
PORT = 8080  # or the next that is free
_PORTS_TRIED = 100

# A browser reaches this machine by these names, also through a port forwarded by SSH, with any
# number. A foreign DNS name that points here is not among them.
OWN_NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})
_HUB = "JUPYTERHUB_SERVICE_PREFIX"  # in the environment of kernels of a hub: where its user's is

# What the page consists of, with its types.
_FILES = {
    "": ("index.html", "text/html"),
    "page.css": ("page.css", "text/css"),
    "page.js": ("page.js", "text/javascript"),
    "picture.js": ("picture.js", "text/javascript"),
    "controls.js": ("controls.js", "text/javascript"),
    "three.min.js": ("three.min.js", "text/javascript"),
}
_ALIGNED = 8  # bytes, that arrays begin at multiples of
_PIECE = 1 << 20  # bytes that are written at a time

_LOGGER = logging.getLogger(__name__)

Arguments = Mapping[str, str]
Answer = tuple[dict[str, Any], dict[str, NDArray[Any]]]  # what is written as JSON, and arrays


class Source(Protocol):
    """What the page shows."""

    def answer(self, what: str, asked: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a question of the page.

        Raises
        ------
        KeyError, ValueError
            If there is no such question, or an argument is missing or wrong.
        Abandoned
            If nobody waits for the answer any more, as `abandoned` tells.
        """

    def order(self, what: str) -> None:
        """Do what a user of the page has ordered; KeyError if there is no such order."""


def bundle(header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> list[bytes]:
    """Write JSON and arrays as one message.

    It begins with the length of the JSON text, uint32, which lists the arrays: name, type, shape,
    and first byte after the text. All numbers are little-endian.
    """
    listed: list[Any] = []
    pieces: list[bytes] = []
    at = 0
    for name, values in arrays.items():
        little = values.astype(values.dtype.newbyteorder("<"), order="C", copy=False)
        listed.append([name, little.dtype.name, list(little.shape), at])
        room = -little.nbytes % _ALIGNED
        pieces += [little.tobytes(), bytes(room)]
        at += little.nbytes + room
    text = json.dumps(header | {"arrays": listed}, allow_nan=False).encode()
    text += b" " * (-(len(text) + 4) % _ALIGNED)
    return [len(text).to_bytes(4, "little"), text, *pieces]


class _Handler(RequestHandler):
    """Answers one request. `source` may take long: it is asked in a thread of its own."""

    def initialize(self, source: Source, threads: ThreadPoolExecutor) -> None:
        self._source, self._threads, self._gone = source, threads, threading.Event()

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        self.set_header("Cache-Control", "no-store")

    def prepare(self) -> None:
        """Refuse pages from elsewhere.

        That the server listens on the loopback interface does not help: the browser with a foreign
        page is on this machine. Such a page cannot read answers, unless its own DNS name points
        here; and a browser tells where an order comes from.
        """
        if _HUB in os.environ:  # its proxy has asked who it is, and no browser runs on its machine
            return
        host = self.request.headers.get("Host", "")
        origin = self.request.headers.get("Origin")
        if not may_ask(host, origin):
            _LOGGER.warning("a page of %r asked %r: refused", origin, host)
            raise HTTPError(403)

    async def get(self, what: str) -> None:
        if what in _FILES:
            name, kind = _FILES[what]
            self.set_header("Content-Type", f"{kind}; charset=utf-8")
            self.finish(files(__package__).joinpath("page", name).read_bytes())
            return
        asked = {name: self.get_query_argument(name) for name in self.request.query_arguments}
        ask = partial(self._source.answer, what, asked, self._gone.is_set)
        try:
            answer = await asyncio.get_running_loop().run_in_executor(self._threads, ask)
        except (KeyError, ValueError) as error:
            raise HTTPError(404, "%s", repr(error)) from error
        except Abandoned:
            return
        self.set_header("Content-Type", "application/octet-stream")
        try:
            for piece in bundle(*answer):
                for at in range(0, len(piece), _PIECE):
                    self.write(piece[at : at + _PIECE])
                    await self.flush()
        except StreamClosedError:
            return

    def post(self, what: str) -> None:
        # A page from elsewhere cannot set this header (Fetch standard, 2.2.2).
        if "X-Lidarpool" not in self.request.headers:
            raise HTTPError(403)
        try:
            self._source.order(what)
        except KeyError as error:
            raise HTTPError(404) from error

    def on_connection_close(self) -> None:
        self._gone.set()

    def log_exception(self, *error: Any) -> None:
        """Log what is our fault only."""
        if not isinstance(error[1], HTTPError):
            _LOGGER.error("the page's question was not answered", exc_info=error)


def may_ask(host: str, origin: str | None) -> bool:
    """Whether a request with these ``Host`` and ``Origin`` headers is of this machine's pages.

    Examples
    --------
    >>> may_ask("localhost:8080", None), may_ask("127.0.0.1:8080", "http://127.0.0.1:8080")
    (True, True)
    >>> may_ask("example.com:8080", None), may_ask("localhost:8080", "http://example.com")
    (False, False)
    """
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    if name.lower() not in OWN_NAMES:
        return False
    return origin is None or origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")


class PageServer:
    """Serves a page on 127.0.0.1, in a thread of its own, on a port or the next that is free.

    Parameters
    ----------
    source
        What the page shows.
    port
        0 for any.
    """

    def __init__(self, source: Source, port: int = PORT) -> None:
        self._source, self._threads = source, ThreadPoolExecutor(2, "lidarpool-page")
        self._loop: asyncio.AbstractEventLoop | None = None
        self._socket = _bound(port)
        self.port: int = self._socket.getsockname()[1]
        started = threading.Event()
        self._thread = threading.Thread(
            target=self._serve, args=(started,), name="lidarpool-page", daemon=True
        )
        self._thread.start()
        started.wait()

    def _serve(self, started: threading.Event) -> None:
        async def serve() -> None:
            self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
            options = {"source": self._source, "threads": self._threads}
            server = HTTPServer(Application([("/(.*)", _Handler, options)], log_function=_quiet))
            server.add_socket(self._socket)
            started.set()
            await self._ended.wait()
            server.stop()
            await server.close_all_connections()

        asyncio.run(serve())

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://{HOST}:{self.port}"

    def close(self) -> None:
        """Serve no more; returns once the thread has ended."""
        if self._loop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join()
        self._threads.shutdown(cancel_futures=True)


def _quiet(handler: RequestHandler) -> None:
    """Do not log requests."""


def _bound(port: int) -> socket.socket:
    last = min(port + _PORTS_TRIED, 65_536)
    for tried in (*range(port, last), 0) if port else (0,):
        try:
            bound = socket.create_server((HOST, tried), backlog=128)
        except OSError:
            if not tried:
                raise
            continue
        bound.setblocking(False)
        return bound
    raise AssertionError  # the last one tried is any


@contextmanager
def page_server(source: Source, port: int = PORT) -> Iterator[PageServer]:
    """Serve a page while the body runs; see `PageServer`."""
    server = PageServer(source, port)
    try:
        yield server
    finally:
        server.close()


@contextmanager
def announced(page: PageServer, words: str, browser: bool) -> Iterator[None]:
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
    url, words = page.url, escape(words)
    hub = os.environ.get(_HUB)
    if hub is not None and find_spec("jupyter_server_proxy"):
        url = f"{hub.rstrip('/')}/proxy/{page.port}/"
        words = words.replace(page.url, url)
        hub = None
    link = f'<a href="{url}" target="_blank">{words}</a>'
    below = f'<iframe src="{url}" style="width:100%;height:640px;border:0"></iframe>'
    if hub is not None:  # a frame would show the reader's own machine
        below = (
            "This address is on the kernel's machine: install jupyter-server-proxy, which leads "
            f"there, or connect with ssh -L {page.port}:{HOST}:{page.port} and the machine's "
            "name, then open it."
        )
    shown = display.display(display.HTML(f"{link}<br>{below}"), display_id=True)
    try:
        yield
    finally:
        shown.update(display.HTML(""))


def open_browser(url: str) -> bool:
    """Open a page if there is a desktop to open it on; returns whether there is."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return False  # else a browser in the terminal would take it over
    if "SSH_CONNECTION" in os.environ:
        return False
    return webbrowser.open(url)
