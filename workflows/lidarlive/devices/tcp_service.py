"""Base class of TCP services, such as HTTP, that run an event loop on a thread."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ClassVar, Self

from lidarsim.errors import LidarError
from lidarsim.packets.service import Destination, Service

_BACKLOG = 128  # number of connections that can wait to be accepted


class TcpService(Service):
    """Service that accepts TCP connections on a thread until the context exits.

    If there are more than `max_connections`, the oldest connection is closed. Clients that keep
    connections open without completing a request therefore cannot block other clients.

    Parameters
    ----------
    address
        HOST:PORT to listen on. If only HOST is given, the usual port is used, or a free port if the
        usual port is unavailable.
    destination, send_to
        As in `Service`.
    """

    name: ClassVar[str]  # name of the service in messages
    usual_port: ClassVar[int]
    example_port: ClassVar[int]  # port that is suggested in error messages
    max_connections: ClassVar[int]
    buffer_bytes: ClassVar[int] = 1 << 16  # buffer size of a connection

    def __init__(
        self, address: str, destination: Destination, send_to: Callable[[Destination], None]
    ) -> None:
        super().__init__(destination, send_to)
        self.host, _, port = address.partition(":")
        self.port = int(port) if port else None  # None until a port is found
        self._loop: asyncio.AbstractEventLoop
        self._thread: threading.Thread
        self._server: asyncio.Server
        self._connections: dict[asyncio.Task[None], None] = {}  # serving tasks, oldest first

    @abstractmethod
    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the requests on a connection, and close the connection."""

    @contextmanager
    def register_connection(self) -> Iterator[Callable[[], None]]:
        """Register the current task's connection.

        Close the oldest connection if there are too many.

        Yields a function that marks the connection as the newest.
        """
        task = asyncio.current_task()
        assert task is not None

        def renew() -> None:
            self._connections.pop(task, None)
            self._connections[task] = None

        renew()
        if len(self._connections) > self.max_connections:
            oldest = next(iter(self._connections))
            del self._connections[oldest]
            oldest.cancel()
        try:
            yield renew
        finally:
            self._connections.pop(task, None)

    def __enter__(self) -> Self:
        listener = self._listening_socket()
        self.port = listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=self.name, daemon=True)
        self._thread.start()
        starting = asyncio.start_server(
            self.serve, sock=listener, limit=self.buffer_bytes, backlog=_BACKLOG
        )
        self._server = asyncio.run_coroutine_threadsafe(starting, self._loop).result()
        return self

    def __exit__(self, *error: object) -> None:
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _listening_socket(self) -> socket.socket:
        """Return a socket bound to the address.

        Raises LidarError if the address cannot be used.
        """
        ports = [self.usual_port, 0] if self.port is None else [self.port]
        for port in ports:
            listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((self.host, port))
                listener.listen(_BACKLOG)
            except OSError as error:
                listener.close()
                is_taken = error.errno in (errno.EACCES, errno.EADDRINUSE)
                if is_taken and port != ports[-1]:
                    continue
                raise LidarError(
                    f"{self.name} cannot listen at {self.host}:{port} "
                    f"({os.strerror(error.errno or 0)}). Use a different address, such as --api "
                    f"127.0.0.1:{self.example_port}."
                ) from error
            return listener
        raise AssertionError("the last port returns or raises")

    async def _close(self) -> None:
        """Stop listening and close all connections."""
        self._server.close()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
