"""Base class of HTTP/1.1 services, which sensors provide on port 80.

Requests are small and come from few programs on a trusted network, but these programs may be
broken. Sizes, times and the number of connections are therefore limited, and each connection
carries one request. Requests from other websites are rejected, because the protocols have no
password.
"""

from __future__ import annotations

import asyncio
import json
from abc import abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import AddressValueError, IPv4Address
from typing import Any, Self
from urllib.parse import SplitResult, urlsplit

from lidarsim.environment.other_sites import names_of_machine, refusal
from lidarsim.packets.service import is_single_receiver

from .tcp_service import TcpService

HTTP_PORT = 80
_MAX_HEAD_BYTES = 16 << 10  # limit for the request line and headers
_MAX_BODY_BYTES = 64 << 10
_WITHIN_S = 5.0  # time limit from the connection to the response
_METHODS = ("GET", "POST", "PUT", "DELETE", "HEAD")
_READING = ("GET", "HEAD")

Headers = Mapping[str, str]  # {name in lower case: value}


@dataclass(frozen=True)
class Request:
    """A parsed HTTP request."""

    method: str
    path: str
    query: str
    body: bytes
    peer: str  # address of the client


@dataclass(frozen=True)
class Answer:
    """An HTTP response with JSON or text."""

    content: Any = None  # JSON-serializable data; None for no content
    status: int = HTTPStatus.OK
    text: str | None = None  # sent instead of JSON if set

    def encode(self) -> bytes:
        """Encode the response as HTTP."""
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


class RequestRefusedError(Exception):
    """A request that is refused with an error status and a reason."""

    def __init__(self, reason: str, status: int = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(reason)
        self.answer = Answer({"error": reason}, status)


class HttpService(TcpService):
    """Service that answers HTTP requests.

    The parameters are the same as in `TcpService`.
    """

    usual_port = HTTP_PORT
    example_port = 8080
    max_connections = 32
    buffer_bytes = _MAX_HEAD_BYTES

    @abstractmethod
    def answer(self, request: Request) -> Answer:
        """Return the response to a request.

        Raises RequestRefusedError if the request is not understood.
        """

    def changes_state(self, method: str, path: str) -> bool:
        """Return whether a request may change the state of the sensor."""
        return method not in _READING

    def __enter__(self) -> Self:
        self.names |= names_of_machine(self.host)
        return super().__enter__()

    @property
    def description(self) -> str:
        """Address of the service, with a hint for clients that always use port 80."""
        words = f"{self.name} at http://{self.host}:{self.port}"
        if self.port != HTTP_PORT:
            words += f" (for clients: http_proxy=http://{self.host}:{self.port})"
        return words

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer a single request on a connection, and close the connection."""
        try:
            with (
                suppress(OSError, TimeoutError, asyncio.IncompleteReadError),
                self.register_connection(),
            ):
                async with asyncio.timeout(_WITHIN_S):
                    writer.write((await self._answered(reader, writer)).encode())
                    await writer.drain()
                    writer.write_eof()
                    # Read what the client still sends, because unread data would reset the
                    # connection before the client has read the response.
                    while await reader.read(_MAX_HEAD_BYTES):
                        pass
        finally:
            writer.close()

    async def _answered(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Answer:
        """Read a request and return the answer."""
        try:
            try:
                head = await reader.readuntil(b"\r\n\r\n")
            except asyncio.LimitOverrunError as error:
                raise RequestRefusedError(
                    "the headers are too long", HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
                ) from error
            method, url, headers = _parsed(head)
            path = url.path or "/"
            self._refuse_other_sites(method, url, headers)
            size = _body_size(headers)
            if headers.get("expect", "").lower() == "100-continue":
                writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
            body = await reader.readexactly(size)
            peer = writer.get_extra_info("peername")[0]
            answer = self.answer(Request(method, path, url.query, body, peer))
            return Answer(status=answer.status) if method == "HEAD" else answer
        except RequestRefusedError as error:
            return error.answer

    def _refuse_other_sites(self, method: str, url: SplitResult, headers: Headers) -> None:
        """Raise RequestRefusedError if a request comes from another website."""
        reason = refusal(
            headers,
            self.names,
            url_authority=url.netloc,
            changes_state=self.changes_state(method, url.path),
        )
        if reason:
            raise RequestRefusedError(reason, HTTPStatus.FORBIDDEN)


def _parsed(head: bytes) -> tuple[str, SplitResult, Headers]:
    """Return the method, URL and headers of a request.

    The URL may be in absolute form, as sent to a proxy. Raises RequestRefusedError if the bytes
    are not a valid request.
    """
    line, *lines = head.decode("latin-1").rstrip("\r\n").split("\r\n")
    words = line.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        raise RequestRefusedError("this is not an HTTP/1.1 request")
    if words[0] not in _METHODS:
        raise RequestRefusedError(
            f"the method must be {' or '.join(_METHODS)}", HTTPStatus.METHOD_NOT_ALLOWED
        )
    headers: dict[str, str] = {}
    for entry in lines:
        name, separator, value = entry.partition(":")
        name = name.strip().lower()
        if not separator or not name:
            raise RequestRefusedError("a header has no colon")
        headers[name] = f"{headers[name]},{value.strip()}" if name in headers else value.strip()
    try:
        return words[0], urlsplit(words[1]), headers
    except ValueError as error:
        raise RequestRefusedError("the URL is invalid") from error


def _body_size(headers: Headers) -> int:
    """Return the body size that the headers announce.

    Raises RequestRefusedError if the size is missing, invalid or too large.
    """
    if "transfer-encoding" in headers:
        raise RequestRefusedError("Content-Length is required", HTTPStatus.LENGTH_REQUIRED)
    size = headers.get("content-length", "0")
    if not (size.isascii() and size.isdecimal()):
        raise RequestRefusedError("Content-Length must be a number")
    if len(size) > 9 or int(size) > _MAX_BODY_BYTES:
        raise RequestRefusedError("the body is too large", HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
    return int(size)


def receiver_of(name: str, value: Any) -> str:
    """Validate a parameter value that must be the IPv4 address of a single receiver.

    Raises RequestRefusedError for other values. `name` is the name of the parameter.
    """
    try:
        address = IPv4Address(str(value))
    except AddressValueError as error:
        raise RequestRefusedError(f"{name} is not an IPv4 address") from error
    if not is_single_receiver(address):
        raise RequestRefusedError(f"{name} is not the address of a single receiver")
    return str(address)


def receiver_port(name: str, value: Any) -> int:
    """Validate a parameter value that must be a port, or 0 if packets are not sent.

    Raises RequestRefusedError for other values. `name` is the name of the parameter.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 16:
        raise RequestRefusedError(f"{name} is not a port")
    return value
