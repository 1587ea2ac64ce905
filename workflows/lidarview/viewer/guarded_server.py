"""Serve HTTP requests after checking their headers, over a limited number of connections.

A request is refused before its body is read, so programs that do not know the address of the page
cannot make the server store data. Each request must arrive within a time limit. If too many
connections are open, the oldest connection without a complete request is closed.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import cast

from tornado.http1connection import HTTP1Connection, HTTP1ServerConnection
from tornado.httpserver import HTTPServer
from tornado.httputil import (
    HTTPConnection,
    HTTPHeaders,
    HTTPMessageDelegate,
    RequestStartLine,
    ResponseStartLine,
)
from tornado.iostream import IOStream
from tornado.web import Application

MAX_BODY_BYTES = 4096  # the pages of this package send no bodies
MAX_CONNECTIONS = 64  # a browser opens six at a time
REQUEST_WITHIN_S = 10.0  # time limit for a request, from the connection or the last response
_MAX_BUFFER_BYTES = 256 << 10  # buffer of a connection, for 64 kB of headers and a body
_PIECE = 1 << 16  # bytes of a refused request that are read and discarded at a time
_MAX_DIGITS = 9  # maximum number of digits in a Content-Length


@dataclass(frozen=True)
class Refusal:
    """A response that the server sends instead of passing the request to the application."""

    status: HTTPStatus
    reason: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)


# Returns a refusal, or None to pass the request to the application.
Check = Callable[[RequestStartLine, HTTPHeaders], Refusal | None]


def guarded_server(application: Application, check: Check) -> HTTPServer:
    """Return a server that passes requests to the application only if `check` returns None."""
    server = _GuardedServer(
        application, max_body_size=MAX_BODY_BYTES, max_buffer_size=_MAX_BUFFER_BYTES
    )
    server.check = check
    return server


class _GuardedServer(HTTPServer):
    """An HTTP server that limits its connections and checks the headers of each request."""

    check: Check

    def initialize(self, *arguments: object, **options: object) -> None:
        super().initialize(*arguments, **options)  # type: ignore[arg-type]
        self._open: set[object] = set()
        # Time limits of the connections whose request is incomplete, the oldest first.
        self._unfinished: dict[object, asyncio.TimerHandle] = {}

    def start_request(
        self, server_conn: object, request_conn: HTTPConnection
    ) -> HTTPMessageDelegate:
        """Start a request's time limit and return the delegate that receives the request."""
        self._open.add(server_conn)
        stream = cast(HTTP1ServerConnection, server_conn).stream
        timer = asyncio.get_running_loop().call_later(REQUEST_WITHIN_S, stream.close)
        self._unfinished[server_conn] = timer
        if len(self._open) > MAX_CONNECTIONS:
            oldest = next(iter(self._unfinished))
            self._forget(oldest)
            cast(HTTP1ServerConnection, oldest).stream.close()
        application_request = super().start_request(server_conn, request_conn)
        return _GuardedRequest(
            application_request,
            cast(HTTP1Connection, request_conn),
            self.check,
            lambda: self._finish(server_conn),
        )

    def on_close(self, server_conn: object) -> None:
        self._forget(server_conn)
        super().on_close(server_conn)

    def _forget(self, server_conn: object) -> None:
        self._finish(server_conn)
        self._open.discard(server_conn)

    def _finish(self, server_conn: object) -> None:
        timer = self._unfinished.pop(server_conn, None)
        if timer is not None:
            timer.cancel()


class _GuardedRequest(HTTPMessageDelegate):
    """A request that is passed to the application after its headers have been checked."""

    def __init__(
        self,
        request: HTTPMessageDelegate,
        connection: HTTP1Connection,
        check: Check,
        finished: Callable[[], None],
    ) -> None:
        self._request = request
        self._connection = connection
        self._check = check
        self._finished = finished
        self._is_handed_over = False

    def headers_received(
        self, start_line: RequestStartLine | ResponseStartLine, headers: HTTPHeaders
    ) -> Awaitable[None] | None:
        """Refuse the request or start passing it to the application."""
        start_line = cast(RequestStartLine, start_line)
        refusal = self._check(start_line, headers) or _too_large(headers)
        if refusal is not None:
            return _refuse(self._connection.detach(), refusal, start_line.method)
        self._is_handed_over = True
        return self._request.headers_received(start_line, headers)

    def data_received(self, chunk: bytes) -> Awaitable[None] | None:
        return self._request.data_received(chunk)

    def finish(self) -> None:
        self._finished()
        self._request.finish()

    def on_connection_close(self) -> None:
        if self._is_handed_over:
            self._request.on_connection_close()


async def _refuse(stream: IOStream, refusal: Refusal, method: str) -> None:
    """Send a refusal and close the connection.

    Further data from the client is discarded until the client or the server closes the connection.
    Closing it earlier would reset the connection, and the client might lose the response.
    """
    body = refusal.reason.encode()
    headers = {
        "Content-Type": "text/plain; charset=utf-8",
        "Content-Length": f"{len(body)}",
        "Connection": "close",
        "Cache-Control": "no-store",
        "Referrer-Policy": "no-referrer",  # the address may hold a token
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": "default-src 'none'",
        **refusal.headers,
    }
    lines = [f"HTTP/1.1 {refusal.status} {refusal.status.phrase}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    head = "\r\n".join([*lines, "", ""]).encode()
    with suppress(OSError):  # the client has disconnected, or the time limit has passed
        await stream.write(head if method == "HEAD" else head + body)
        stream.socket.shutdown(socket.SHUT_WR)
        while True:
            await stream.read_bytes(_PIECE, partial=True)


def _too_large(headers: HTTPHeaders) -> Refusal | None:
    """Return a refusal if the declared body is larger than `MAX_BODY_BYTES`."""
    size = headers.get("Content-Length", "0")
    is_number = size.isascii() and size.isdecimal()
    if is_number and (len(size) > _MAX_DIGITS or int(size) > MAX_BODY_BYTES):
        return Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request body is too large")
    return None
