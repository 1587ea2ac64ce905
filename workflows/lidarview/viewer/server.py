"""Serves a page to browsers of this machine: files, and answers to the questions of the page.

The page asks with GET and gives orders with POST. Its address holds a random token; other addresses
are answered with 404, so that no website, and no user of the machine who does not know the token,
sees the page or gives orders. Requests of other websites are refused, whatever they know; only
links to the page are followed. All addresses within the page are relative, so that the page also
works behind a proxy.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from hmac import compare_digest
from html import escape
from http import HTTPStatus
from importlib.resources import files
from typing import Any

import click
from tornado.httputil import HTTPHeaders, RequestStartLine
from tornado.iostream import StreamClosedError
from tornado.web import Application, HTTPError, RequestHandler, StaticFileHandler

from lidarsim.base.arrays import AnyArray
from lidarsim.base.notebook import cell_display
from lidarsim.base.other_sites import names_of_machine, refusal

from .guarded_server import Refusal, guarded_server
from .point_selection import Abandoned

HOST = "127.0.0.1"
PORT = 8080  # or the next that is free
VIEWER = "index.html"
_PORTS_TRIED = 100

_HUB = "JUPYTERHUB_SERVICE_PREFIX"  # environment variable of a hub's kernels: the user's path

MAX_SLOW = 2  # slow answers of a kind that are computed or sent at a time
MAX_WAITING = 16  # slow questions of a kind that wait; further questions get status 503
LARGE_POINTS = 1_000_000  # an answer of more points is large
LONG_TEXT = 1_000  # letters: a question for points of longer lists is slow
STALL_S = 20.0  # without a byte that the browser reads; then its connection is closed

_ALIGNED = 8  # bytes, that arrays begin at multiples of
_PIECE = 1 << 20  # bytes that are written at a time

# What a page may load: files and answers of this server, and pictures and downloads that the page
# itself makes. No inline script, style or handler of events is allowed. A list of jobs frames the
# viewers of its jobs.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'"
)
_FRAMES = "; frame-ancestors 'self'"  # pages that may frame a page

_LOGGER = logging.getLogger(__name__)

Arguments = Mapping[str, str]
Answer = tuple[dict[str, Any], dict[str, AnyArray]]  # content of the JSON text, and arrays


# Answers a question with its arguments: KeyError or ValueError for an unknown question or a wrong
# argument, Abandoned once the function (the last argument) says that nobody waits.
Source = Callable[[str, Arguments, Callable[[], bool]], Answer]


def bundle(header: dict[str, Any], arrays: Mapping[str, AnyArray]) -> list[bytes]:
    """Write JSON and arrays as a single message.

    The message starts with the length of the JSON text, uint32. The text lists the arrays: name,
    type, shape, and first byte after the text. All numbers are little-endian.
    """
    listed: list[Any] = []
    pieces: list[bytes] = []
    offset = 0
    for name, values in arrays.items():
        little = values.astype(values.dtype.newbyteorder("<"), order="C", copy=False)
        listed.append([name, little.dtype.name, list(little.shape), offset])
        padding = -little.nbytes % _ALIGNED
        pieces += [little.tobytes(), bytes(padding)]
        offset += little.nbytes + padding
    text = json.dumps(header | {"arrays": listed}, allow_nan=False).encode()
    text += b" " * (-(len(text) + 4) % _ALIGNED)
    return [len(text).to_bytes(4, "little"), text, *pieces]


def is_large(question: str, arguments: Arguments) -> bool:
    """Return True if an answer may have millions of points, and hold memory until read.

    ValueError if the number of points is not a number.
    """
    kind = question.rpartition("/")[2]
    return kind == "export" or (kind == "points" and int(arguments.get("most", 0)) > LARGE_POINTS)


def is_search(question: str, arguments: Arguments) -> bool:
    """Return True if an answer may take seconds because all points are searched."""
    long_lists = len(arguments.get("scans", "")) > LONG_TEXT
    return question.rpartition("/")[2] == "points" and (bool(arguments.get("filter")) or long_lists)


class SlowQuestions:
    """Slots for slow questions of a kind, which are answered in separate threads.

    An answer holds its slot until the browser has read the answer, so that few large answers are in
    memory. Large answers and searches are two kinds: large answers that nobody reads delay no
    search.
    """

    def __init__(self) -> None:
        self.threads = ThreadPoolExecutor(MAX_SLOW, "lidarpool-page-slow")
        self._free = asyncio.Semaphore(MAX_SLOW)
        self._waiting = 0

    @asynccontextmanager
    async def slot(self) -> AsyncIterator[None]:
        """Wait for a slot, and hold it while the body runs.

        Raises HTTPError if too many requests are pending.
        """
        if self._waiting >= MAX_WAITING:
            raise HTTPError(503, "too many slow requests are pending")
        self._waiting += 1
        try:
            await self._free.acquire()
        finally:
            self._waiting -= 1
        try:
            yield
        finally:
            self._free.release()


class _Guarded(RequestHandler):
    """Answers requests that `_Guard` has let pass."""

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        self.set_header("Cache-Control", "no-store")
        self.set_header("Referrer-Policy", "no-referrer")  # the address holds the token
        self.set_header("X-Content-Type-Options", "nosniff")
        # The cell of a notebook, whose address is unknown here, may frame any page.
        policy = POLICY if self.settings["in_notebook"] else POLICY + _FRAMES
        self.set_header("Content-Security-Policy", policy)

    def log_exception(self, *error: Any) -> None:
        """Log errors that are not the client's."""
        if not isinstance(error[1], HTTPError):
            _LOGGER.error("A request from the page failed", exc_info=error)


class _File(_Guarded, StaticFileHandler):
    """Sends a file that the page consists of."""


class _Question(_Guarded):
    """Answers a question by `source`, which may take long, in a separate thread.

    Slow questions of a kind wait for a slot; the rest are answered meanwhile.
    """

    def initialize(self, source: Source, stop: Callable[[], None] | None) -> None:
        self._source = source
        self._stop = stop
        self._disconnected = threading.Event()

    async def get(self, question: str) -> None:
        arguments = {name: self.get_query_argument(name) for name in self.request.query_arguments}
        try:
            slow: SlowQuestions | None = None
            if is_large(question, arguments):
                slow = self.settings["large"]
            elif is_search(question, arguments):
                slow = self.settings["searches"]
            if slow is not None:
                async with slow.slot():
                    await self._answer(slow.threads, question, arguments)
            else:
                await self._answer(None, question, arguments)
        except (KeyError, ValueError) as error:
            raise HTTPError(404, "%s", repr(error)) from error
        except (Abandoned, StreamClosedError):
            return

    async def _answer(
        self, threads: ThreadPoolExecutor | None, question: str, arguments: Arguments
    ) -> None:
        """Compute an answer in a thread and send the answer.

        Raises Abandoned if the browser has left.
        """
        if self._disconnected.is_set():
            raise Abandoned

        def pieces() -> list[bytes]:
            return bundle(*self._source(question, arguments, self._disconnected.is_set))

        answer = await asyncio.get_running_loop().run_in_executor(threads, pieces)
        self.set_header("Content-Type", "application/octet-stream")
        for piece in answer:
            for offset in range(0, len(piece), _PIECE):
                self.write(piece[offset : offset + _PIECE])
                try:
                    await asyncio.wait_for(self.flush(), STALL_S)
                except TimeoutError as error:
                    self.detach().close()
                    raise Abandoned from error

    def post(self, order: str) -> None:
        if order != "stop" or self._stop is None:
            raise HTTPError(404)
        self._stop()

    def on_connection_close(self) -> None:
        self._disconnected.set()


@dataclass(frozen=True)
class PageServer:
    """A page that is served at an address of this machine."""

    port: int
    host: str = HOST
    token: str = field(default_factory=secrets.token_urlsafe, repr=False)
    good_once: list[str] = field(default_factory=list, repr=False)  # tokens of single use

    @property
    def url(self) -> str:
        """Address of the page, which ends with "/"."""
        return f"{self._root}{self.token}/"

    @property
    def _root(self) -> str:
        """Address of the server, which ends with "/"."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"

    def once(self) -> str:
        """Return an address that leads to the page once.

        Other users of the machine see the arguments that a browser is started with.
        """
        self.good_once.append(secrets.token_urlsafe())
        return f"{self._root}{self.good_once[-1]}/"


class _Guard:
    """Checks a request by its address and headers, before its body is read."""

    def __init__(self, page: PageServer) -> None:
        self._page = page
        # The name of a notebook's proxy is unknown here.
        is_proxied = cell_display() is not None or _HUB in os.environ
        self._names = None if is_proxied else names_of_machine(page.host) | {page.host.lower()}

    def __call__(self, start_line: RequestStartLine, headers: HTTPHeaders) -> Refusal | None:
        """Return the refusal of a request, or the page for an address of single use, or None."""
        path = start_line.path.partition("?")[0]
        token = "".join(path.split("/")[1:2])
        is_good_once = token in self._page.good_once
        if not is_good_once and not compare_digest(self._page.token.encode(), token.encode()):
            return Refusal(HTTPStatus.NOT_FOUND, "this page does not exist")
        reason = refusal(
            headers,
            self._names,
            changes_state=start_line.method not in ("GET", "HEAD"),
            is_page=start_line.method == "GET" and path.endswith("/"),
        )
        if reason:
            return Refusal(HTTPStatus.FORBIDDEN, reason)
        if is_good_once:
            self._page.good_once.remove(token)
            return Refusal(HTTPStatus.FOUND, headers={"Location": self._page.url})
        return None


@contextmanager
def page_server(
    source: Source,
    port: int = PORT,
    stop: Callable[[], None] | None = None,
    *,
    index: str = VIEWER,
    host: str = HOST,
) -> Iterator[PageServer]:
    """Serve a page while the body runs, in a separate thread, on a port or the next free port.

    A `port` of 0 is for any; `stop` is called when a user of the page orders to stop. `index` is
    the page's file; the viewer of a job is at ``job/NUMBER/``, and its questions start so.
    """
    listener = _open_socket(host, port)
    folder = str(files(__package__) / "page")
    page, viewer = ({"path": folder, "default_filename": name} for name in (index, VIEWER))
    listener.setblocking(False)
    served_page = PageServer(listener.getsockname()[1], host)
    running: Future[asyncio.AbstractEventLoop] = Future()
    ended = asyncio.Event()

    async def serve() -> None:
        handlers: list[Any] = [
            (r"/[^/]+/(|\w[\w.]*\.(?:css|js))", _File, page),
            (r"/[^/]+/job/\d+/(|\w[\w.]*\.(?:css|js))", _File, viewer),
            (r"/[^/]+/(.*)", _Question, {"source": source, "stop": stop}),
        ]
        application = Application(handlers, log_function=lambda _: None)
        application.settings |= {
            "large": SlowQuestions(),
            "searches": SlowQuestions(),
            "in_notebook": cell_display() is not None,
        }
        server = guarded_server(application, _Guard(served_page))
        server.add_socket(listener)
        loop = asyncio.get_running_loop()
        loop.set_default_executor(ThreadPoolExecutor(2, "lidarpool-page"))
        running.set_result(loop)
        await ended.wait()
        server.stop()
        await server.close_all_connections()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="page", daemon=True)
    thread.start()
    loop = running.result()
    try:
        yield served_page
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()


def _open_socket(host: str, port: int) -> socket.socket:
    """Listen on a port, or the next free port, or any port for 0 or if no port is free."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    candidates = range(port, min(port + _PORTS_TRIED, 65_536)) if port else range(0)
    for candidate in candidates:
        with suppress(OSError):
            return socket.create_server((host, candidate), family=family, backlog=128)
    return socket.create_server((host, 0), family=family, backlog=128)


@contextmanager
def announced(
    page: PageServer, words: str, browser: bool, *, on_stdout: bool = False
) -> Iterator[None]:
    """Print a page's address while the body runs, or show the page in the cell of a notebook.

    The address is on stderr, beside the progress of a run, or `on_stdout` where it is the result.
    `browser` opens a browser where there is a desktop, and no notebook.
    """
    display = cell_display()
    if display is None:
        click.echo(words, err=not on_stdout)
        if browser:
            open_browser(page.once())
        yield
        return
    shown = display.display(display.HTML(frame_of(page, words)), display_id=True)
    try:
        yield
    finally:
        shown.update(display.HTML(""))


def frame_of(page: PageServer, words: str) -> str:
    """Return HTML for the cell of a notebook: a link of some words, and the page in a frame."""
    url = page.url
    words = escape(words)
    if hub := os.environ.get(_HUB):  # 127.0.0.1 in a frame would be the reader's own machine
        url = f"{hub.rstrip('/')}/proxy/{page.port}/{page.token}/"
        words += (
            " The frame requires jupyter-server-proxy. Without it, run ssh -L "
            f"{page.port}:{HOST}:{page.port} HOST on your computer, where HOST is the name of this "
            "machine, and open the address."
        )
    link = f'<a href="{url}" target="_blank">{words}</a>'
    return f'{link}<br><iframe src="{url}" style="width:100%;height:640px;border:0"></iframe>'


def open_browser(url: str) -> None:
    """Open a page in a browser, if there is a desktop."""
    desktop = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if "SSH_CONNECTION" in os.environ or (sys.platform.startswith("linux") and not desktop):
        return  # a browser in the terminal would take the terminal over
    webbrowser.open(url)
