"""Services over HTTP/1.1, as makers' sensors have them on port 80.

Requests are small and come from few programs on a network without enemies, or from a program that
is broken: sizes, times and the number of connections have limits, and each connection carries one
request. A browser's page of another site is refused, as the protocols have no password.
"""

from __future__ import annotations

import asyncio
import json
from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import AddressValueError, IPv4Address
from typing import Any
from urllib.parse import SplitResult, urlsplit

from .service import Destination
from .tcp_service import TcpService

HTTP_PORT = 80
BROADCAST = "255.255.255.255"
_MAX_HEAD_BYTES = 16 << 10  # of the request line and headers
_MAX_BODY_BYTES = 64 << 10
_WITHIN_S = 5.0  # from the connection to the answer
_METHODS = ("GET", "POST", "PUT", "DELETE", "HEAD")


@dataclass(frozen=True)
class Request:
    """A request that was understood."""

    method: str
    path: str
    query: str
    body: bytes
    peer: str  # address of the client


@dataclass(frozen=True)
class Answer:
    """An answer: JSON, or text."""

    content: Any = None  # plain data for JSON; None for no content
    status: int = HTTPStatus.OK
    text: str | None = None  # in place of JSON

    def encode(self) -> bytes:
        """Return the answer as bytes of HTTP."""
        body = b""
        kind = "application/json"
        if self.text is not None:
            body = self.text.encode()
            kind = "text/plain"
        elif self.content is not None:
            body = json.dumps(self.content).encode()
        reason = HTTPStatus(self.status).phrase
        head = (
            f"HTTP/1.1 {int(self.status)} {reason}\r\nContent-Type: {kind}\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        )
        return head.encode() + body


class RefusedError(Exception):
    """A request that is answered by an error, and the reason for the client."""

    def __init__(self, reason: str, status: int = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(reason)
        self.answer = Answer({"error": reason}, status)


class HttpService(TcpService):
    """Answers requests of HTTP; parameters are those of `TcpService`."""

    usual_port = HTTP_PORT
    example_port = 8080
    max_connections = 32
    buffer_bytes = _MAX_HEAD_BYTES

    def __init__(
        self, address: str, destination: Destination, send_to: Callable[[Destination], None]
    ) -> None:
        super().__init__(address, destination, send_to)
        self._connections = 0

    @abstractmethod
    def answer(self, request: Request) -> Answer:
        """Return the answer to a request; RefusedError for what is not understood."""

    @property
    def description(self) -> str:
        """The address, and how a client whose port is 80 reaches another port."""
        words = f"{self.name} at http://{self.host}:{self.port}"
        if self.port != HTTP_PORT:
            words += f" (for clients: http_proxy=http://{self.host}:{self.port})"
        return words

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the request of a connection, and close it; drop a connection too many."""
        self._connections += 1
        try:
            if self._connections <= self.max_connections:
                with suppress(OSError, TimeoutError, asyncio.IncompleteReadError):
                    async with asyncio.timeout(_WITHIN_S):
                        writer.write((await self._answered(reader, writer)).encode())
                        await writer.drain()
                        writer.write_eof()
                        # What the client still sends must not reset the connection before the
                        # client has read the answer.
                        while await reader.read(_MAX_HEAD_BYTES):
                            pass
        finally:
            self._connections -= 1
            writer.close()

    async def _answered(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Answer:
        """Read a request, and return its answer."""
        try:
            try:
                head = await reader.readuntil(b"\r\n\r\n")
            except asyncio.LimitOverrunError as error:
                raise RefusedError(
                    "the headers are too long", HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
                ) from error
            method, url, headers = _parsed(head)
            size = _body_size(headers)
            if headers.get("expect", "").lower() == "100-continue":
                writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
            body = await reader.readexactly(size)
            peer = writer.get_extra_info("peername")[0]
            path = url.path or "/"
            answer = self.answer(Request(method, path, url.query, body, peer))
            return Answer(status=answer.status) if method == "HEAD" else answer
        except RefusedError as error:
            return error.answer


def _parsed(head: bytes) -> tuple[str, SplitResult, Mapping[str, str]]:
    """Return method, URL and headers {name: value} of a request; RefusedError for other bytes.

    The URL may be in absolute form, as for a proxy.
    """
    line, *lines = head.decode("latin-1").rstrip("\r\n").split("\r\n")
    words = line.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        raise RefusedError("this is no request of HTTP/1.1")
    if words[0] not in _METHODS:
        raise RefusedError(f"use {', '.join(_METHODS)}", HTTPStatus.METHOD_NOT_ALLOWED)
    headers = {}
    for entry in lines:
        name, separator, value = entry.partition(":")
        if not separator or not name.strip():
            raise RefusedError("a header has no colon")
        headers[name.strip().lower()] = value.strip()
    if "origin" in headers:
        raise RefusedError("pages of other sites are not answered", HTTPStatus.FORBIDDEN)
    try:
        return words[0], urlsplit(words[1]), headers
    except ValueError as error:
        raise RefusedError("the URL is not understood") from error


def _body_size(headers: Mapping[str, str]) -> int:
    """Return the size of the body that headers announce; RefusedError for other encodings."""
    if "transfer-encoding" in headers:
        raise RefusedError("give a Content-Length", HTTPStatus.LENGTH_REQUIRED)
    size = headers.get("content-length", "0")
    if not (size.isascii() and size.isdecimal()):
        raise RefusedError("the Content-Length is no number")
    if len(size) > 9 or int(size) > _MAX_BODY_BYTES:
        raise RefusedError("the body is too large", HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
    return int(size)


def receiver_of(name: str, value: Any) -> str:
    """Return the IPv4 address of one receiver; RefusedError for others, `name` is the parameter."""
    try:
        address = IPv4Address(str(value))
    except AddressValueError as error:
        raise RefusedError(f"{name} is no IPv4 address") from error
    if address.is_multicast or address.is_unspecified or str(address) == BROADCAST:
        raise RefusedError(f"{name} is not the address of one receiver")
    return str(address)


def receiver_port(name: str, value: Any) -> int:
    """Return a port, or 0 for packets that are not sent; RefusedError for other values."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 16:
        raise RefusedError(f"{name} is no port")
    return value
