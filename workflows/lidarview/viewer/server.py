"""Serve a page to browsers on this machine.

The page sends GET requests for files and data, and POST requests for commands. Its URL contains a
random token, and all other URLs return status 404. Websites, and other users of the machine who do
not know the token, can therefore neither see the page nor send commands. Requests from other
websites are always refused, except links to the page. All URLs within the page are relative, so the
page also works behind a proxy.
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

from lidarsim.environment.notebook import cell_display
from lidarsim.environment.other_sites import names_of_machine, refusal
from lidarsim.numerics.arrays import AnyArray

from .guarded_server import Refusal, guarded_server
from .point_selection import ClientDisconnected

HOST = "127.0.0.1"
PORT = 8080  # default port; if it is taken, the next free port is used
VIEWER = "index.html"
_PORTS_TRIED = 100

_HUB = "JUPYTERHUB_SERVICE_PREFIX"  # environment variable with the path of a JupyterHub user

MAX_SLOW = 2  # number of slow requests of a kind that are answered at a time
MAX_WAITING = 16  # number of slow requests of a kind that may wait; further requests get status 503
LARGE_POINTS = 1_000_000  # an answer with more points is large
LONG_TEXT = 1_000  # a request is slow if its list of scans has more characters
STALL_S = 20.0  # a connection is closed if the client reads nothing for this time

_ALIGNED = 8  # alignment of the arrays in an answer, in bytes
_PIECE = 1 << 20  # bytes that are written at a time

# A page may load files and data from this server, and images and downloads that the page itself
# creates. Inline scripts, styles, and event handlers are not allowed. The job list shows the
# viewers of its jobs in frames.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'"
)
_FRAMES = "; frame-ancestors 'self'"  # only pages of this server may show a page in a frame

_LOGGER = logging.getLogger(__name__)

Arguments = Mapping[str, str]
Answer = tuple[dict[str, Any], dict[str, AnyArray]]  # header, sent as JSON, and arrays by name


# Answers a request, given its name, its arguments, and a function that returns True once the client
# has disconnected. Raises KeyError or ValueError for an invalid request, and ClientDisconnected.
AnswerSource = Callable[[str, Arguments, Callable[[], bool]], Answer]


def pack_answer(header: dict[str, Any], arrays: Mapping[str, AnyArray]) -> list[bytes]:
    """Pack a header and arrays into a single message.

    The message starts with the length of the JSON text as uint32. The text contains the header and,
    for each array, its name, data type, shape, and byte offset after the text. All numbers are
    little-endian.
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
    """Return whether the answer may contain millions of points.

    Such an answer occupies memory until it is sent. Raises ValueError if the requested number of
    points is not a number.
    """
    kind = question.rpartition("/")[2]
    return kind == "export" or (kind == "points" and int(arguments.get("most", 0)) > LARGE_POINTS)


def is_search(question: str, arguments: Arguments) -> bool:
    """Return whether the answer may take seconds because all points are searched."""
    long_lists = len(arguments.get("scans", "")) > LONG_TEXT
    return question.rpartition("/")[2] == "points" and (bool(arguments.get("filter")) or long_lists)


class SlowRequestSlots:
    """Slots that limit the number of slow requests that are answered at the same time.

    A request holds its slot until the client has received the answer, so only a few large answers
    are in memory. Large answers and searches use separate slots. Clients that do not read their
    answers therefore cannot delay searches.
    """

    def __init__(self) -> None:
        self.threads = ThreadPoolExecutor(MAX_SLOW, "lidarpool-page-slow")
        self._free = asyncio.Semaphore(MAX_SLOW)
        self._waiting = 0

    @asynccontextmanager
    async def slot(self) -> AsyncIterator[None]:
        """Wait for a slot and hold it while the context is active.

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
    """Base class of handlers for requests that `_Guard` has accepted."""

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        self.set_header("Cache-Control", "no-store")
        self.set_header("Referrer-Policy", "no-referrer")  # the address holds the token
        self.set_header("X-Content-Type-Options", "nosniff")
        # A notebook shows pages in frames, and its address is unknown here.
        policy = POLICY if self.settings["in_notebook"] else POLICY + _FRAMES
        self.set_header("Content-Security-Policy", policy)

    def log_exception(self, *error: Any) -> None:
        """Log an error unless the client caused it."""
        if not isinstance(error[1], HTTPError):
            _LOGGER.error("A request from the page failed", exc_info=error)


class _File(_Guarded, StaticFileHandler):
    """Handler that sends the files of the page."""


class _Question(_Guarded):
    """Handler that answers a data request or a command.

    Answers are computed in threads because they may take long. Slow requests wait for a slot. All
    other requests are answered immediately.
    """

    def initialize(self, source: AnswerSource, stop: Callable[[], None] | None) -> None:
        self._source = source
        self._stop = stop
        self._disconnected = threading.Event()

    async def get(self, question: str) -> None:
        arguments = {name: self.get_query_argument(name) for name in self.request.query_arguments}
        try:
            slow: SlowRequestSlots | None = None
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
        except (ClientDisconnected, StreamClosedError):
            return

    async def _answer(
        self, threads: ThreadPoolExecutor | None, question: str, arguments: Arguments
    ) -> None:
        """Compute an answer in a thread and send it.

        Raises ClientDisconnected if the client has disconnected or stopped reading.
        """
        if self._disconnected.is_set():
            raise ClientDisconnected

        def pieces() -> list[bytes]:
            return pack_answer(*self._source(question, arguments, self._disconnected.is_set))

        answer = await asyncio.get_running_loop().run_in_executor(threads, pieces)
        self.set_header("Content-Type", "application/octet-stream")
        for piece in answer:
            for offset in range(0, len(piece), _PIECE):
                self.write(piece[offset : offset + _PIECE])
                try:
                    await asyncio.wait_for(self.flush(), STALL_S)
                except TimeoutError as error:
                    self.detach().close()
                    raise ClientDisconnected from error

    def post(self, order: str) -> None:
        if order != "stop" or self._stop is None:
            raise HTTPError(404)
        self._stop()

    def on_connection_close(self) -> None:
        self._disconnected.set()


@dataclass(frozen=True)
class PageServer:
    """The address of a page that is being served on this machine."""

    port: int
    host: str = HOST
    token: str = field(default_factory=secrets.token_urlsafe, repr=False)
    single_use_tokens: list[str] = field(default_factory=list, repr=False)

    @property
    def url(self) -> str:
        """URL of the page, ending with "/"."""
        return f"{self._root}{self.token}/"

    @property
    def _root(self) -> str:
        """URL of the server, ending with "/"."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"

    def single_use_url(self) -> str:
        """Return a URL that leads to the page only once.

        The URL is used to start a browser, because other users of the machine can see the command
        line.
        """
        self.single_use_tokens.append(secrets.token_urlsafe())
        return f"{self._root}{self.single_use_tokens[-1]}/"


class _Guard:
    """Check of a request's URL and headers before its body is read."""

    def __init__(self, page: PageServer) -> None:
        self._page = page
        # The host name of a notebook's proxy is unknown, so it cannot be checked.
        is_proxied = cell_display() is not None or _HUB in os.environ
        self._names = None if is_proxied else names_of_machine(page.host) | {page.host.lower()}

    def __call__(self, start_line: RequestStartLine, headers: HTTPHeaders) -> Refusal | None:
        """Return a refusal, or None to accept the request.

        A single-use URL is answered with a redirect to the page.
        """
        path = start_line.path.partition("?")[0]
        token = "".join(path.split("/")[1:2])
        is_good_once = token in self._page.single_use_tokens
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
            self._page.single_use_tokens.remove(token)
            return Refusal(HTTPStatus.FOUND, headers={"Location": self._page.url})
        return None


@contextmanager
def page_server(
    source: AnswerSource,
    port: int = PORT,
    stop: Callable[[], None] | None = None,
    *,
    index: str = VIEWER,
    host: str = HOST,
) -> Iterator[PageServer]:
    """Serve a page in a thread while the context is active.

    Parameters
    ----------
    source
        Computes the answers to the requests of the page.
    port
        Port to use. If it is taken, the next free port is used. 0 selects any free port.
    stop
        Called if the user of the page stops the run.
    index
        Name of the page's HTML file. The viewer of a job is at ``job/NUMBER/``, and its requests
        start with the same prefix.
    host
        Address to listen on.
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
            "large": SlowRequestSlots(),
            "searches": SlowRequestSlots(),
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
    """Listen on a port or the next free port.

    If the port is 0 or no port is free, listen on any port.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    candidates = range(port, min(port + _PORTS_TRIED, 65_536)) if port else range(0)
    for candidate in candidates:
        with suppress(OSError):
            return socket.create_server((host, candidate), family=family, backlog=128)
    return socket.create_server((host, 0), family=family, backlog=128)


@contextmanager
def announce_page(
    page: PageServer, words: str, browser: bool, *, on_stdout: bool = False
) -> Iterator[None]:
    """Print the URL of a page or display the page in a notebook while the context is active.

    The URL is printed to stderr, or to stdout if `on_stdout` is set. If `browser` is set and there
    is a desktop, a browser opens the page.
    """
    display = cell_display()
    if display is None:
        click.echo(words, err=not on_stdout)
        if browser:
            open_browser(page.single_use_url())
        yield
        return
    shown = display.display(display.HTML(notebook_html(page, words)), display_id=True)
    try:
        yield
    finally:
        shown.update(display.HTML(""))


def notebook_html(page: PageServer, words: str) -> str:
    """Return the HTML of a notebook cell that links to the page and shows it in a frame."""
    url = page.url
    words = escape(words)
    if hub := os.environ.get(_HUB):  # 127.0.0.1 would be the machine of the user's browser
        url = f"{hub.rstrip('/')}/proxy/{page.port}/{page.token}/"
        words += (
            " The frame requires jupyter-server-proxy. Without it, run ssh -L "
            f"{page.port}:{HOST}:{page.port} HOST on your computer, where HOST is the name of this "
            "machine, and open the address."
        )
    link = f'<a href="{url}" target="_blank">{words}</a>'
    return f'{link}<br><iframe src="{url}" style="width:100%;height:640px;border:0"></iframe>'


def open_browser(url: str) -> None:
    """Open a page in a browser if there is a desktop."""
    desktop = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if "SSH_CONNECTION" in os.environ or (sys.platform.startswith("linux") and not desktop):
        return  # a text-mode browser would take over the terminal
    webbrowser.open(url)
