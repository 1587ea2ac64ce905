"""Processes on this machine that apply a function to items.

A process receives one item at a time through a socket, and the socket is closed when the process
dies. The item that it was processing is therefore known.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

import cloudpickle

from .lost_workers import LostWorkersError

_WINDOW = 2  # items in flight for each process; results that are complete wait for earlier ones
_MAX_TRIES = 2
# Processes share the cores, so numerical libraries are limited to one thread.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
# The main script of this process is not imported, because it may not have a main guard.
_SCRIPT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from lidarfiles.work.serving_process import serve; serve(int(sys.argv[2]))"
)


class _Item(NamedTuple):
    number: int
    content: bytes  # pickled
    name: str  # for messages
    tries: int = 1


class ProcessPool:
    """Processes that are started when they are needed.

    Parameters
    ----------
    count
        Maximum number of processes.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._idle: list[_Process] = []
        self._in_use = set[_Process]()

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield the results of a function for all items, in order.

        The function and the items are pickled. An exception of the function is raised in place of
        its result. A message about an item contains its attribute `label`, if it has one.

        Raises
        ------
        LostWorkersError
            If an item kills its process twice.
        """
        calls = _Calls(self, cloudpickle.dumps(function), items)
        try:
            yield from calls.results()
        finally:
            calls.abandon()

    @property
    def has_room(self) -> bool:
        """Whether another process can be taken."""
        return len(self._in_use) < self.count

    def take(self) -> _Process:
        """Return an idle process, or start one."""
        process = self._idle.pop() if self._idle else _Process()
        self._in_use.add(process)
        return process

    def put_back(self, process: _Process) -> None:
        """Return an idle process."""
        self._in_use.remove(process)
        self._idle.append(process)

    def discard(self, process: _Process) -> str:
        """Kill a process, and return how it ended."""
        self._in_use.discard(process)
        return process.kill()

    def close(self) -> None:
        """Kill all processes."""
        for process in (*self._idle, *self._in_use):
            process.kill()
        self._idle.clear()
        self._in_use.clear()


class _Calls:
    """Calls of a function, of which a limited number is in flight."""

    def __init__(self, pool: ProcessPool, function: bytes, items: Iterable[Any]) -> None:
        self._pool = pool
        self._function = function
        self._items = iter(items)
        self._started = 0  # number of items that were taken from the iterable
        self._retries = deque[_Item]()  # items whose process died
        self._busy: dict[Connection, tuple[_Process, _Item]] = {}
        self._outcomes: dict[int, _Outcome] = {}  # by item number, until they are yielded

    def results(self) -> Iterator[Any]:
        """Yield the results in the order of the items."""
        yielded = 0
        while True:
            while yielded in self._outcomes:
                yield self._outcomes.pop(yielded).result()
                yielded += 1
            self._start_calls(yielded)
            if not self._busy:
                return
            for connection in wait([*self._busy]):
                self._receive(connection)  # type: ignore[arg-type]

    def abandon(self) -> None:
        """Kill the processes whose results are not needed."""
        while self._busy:
            _, (process, _) = self._busy.popitem()
            self._pool.discard(process)

    def _start_calls(self, yielded: int) -> None:
        """Send items to processes.

        An item whose process died is tried again while no other item is processed, because several
        processes may have run out of memory together.
        """
        if self._retries:
            if not self._busy:
                self._send(self._retries.popleft())
            return
        if any(item.tries > 1 for _, item in self._busy.values()):
            return
        # Without a busy process, this call starts one in any case. Otherwise, two nested calls
        # would wait for each other.
        while self._started - yielded < _WINDOW * self._pool.count and (
            self._pool.has_room or not self._busy
        ):
            if (item := self._next_item()) is None:
                return
            self._send(item)

    def _next_item(self) -> _Item | None:
        try:
            value = next(self._items)
        except StopIteration:
            return None
        number = self._started
        self._started += 1
        name = getattr(value, "label", None) or f"item {number}"
        return _Item(number, cloudpickle.dumps(value), name)

    def _send(self, item: _Item) -> None:
        process = self._pool.take()
        self._busy[process.connection] = process, item
        with suppress(OSError):  # a dead process is noticed when its outcome is received
            process.send(self._function, item.content)

    def _receive(self, connection: Connection) -> None:
        process, item = self._busy.pop(connection)
        try:
            self._outcomes[item.number] = process.receive()
        except (EOFError, OSError):
            ending = self._pool.discard(process)
            if item.tries == _MAX_TRIES:
                raise LostWorkersError(
                    f"Two processes ended ({ending}) while they processed {item.name}, probably "
                    "because they ran out of memory. Use fewer workers, or a machine with more "
                    "memory."
                ) from None
            self._retries.append(item._replace(tries=item.tries + 1))
        else:
            self._pool.put_back(process)


class _Outcome(NamedTuple):
    """What a process has returned for an item."""

    content: bytes  # a pickled result, or a pickled exception and its traceback
    is_error: bool

    def result(self) -> Any:
        """Return the result, or raise the exception."""
        if not self.is_error:
            return cloudpickle.loads(self.content)
        error, traceback = cloudpickle.loads(self.content)
        error.__cause__ = _ProcessTracebackError(traceback)
        raise error


class _ProcessTracebackError(Exception):
    """Traceback of an exception in a worker process."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class _Process:
    """A process that applies functions to items."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _SCRIPT, json.dumps(sys.path), str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=os.environ | _ENVIRONMENT,
                process_group=0,  # a terminal sends Ctrl-C to this process only
            )
        self.connection = Connection(ours.detach())
        self._function: bytes | None = None

    def send(self, function: bytes, item: bytes) -> None:
        """Send an item, and the function if it differs from the last one."""
        if self._function is not function:
            self.connection.send_bytes(b"function")
            self.connection.send_bytes(function)
            self._function = function
        self.connection.send_bytes(b"item")
        self.connection.send_bytes(item)

    def receive(self) -> _Outcome:
        """Return the outcome of the last item, or raise EOFError if the process has died."""
        kind = self.connection.recv_bytes()
        return _Outcome(self.connection.recv_bytes(), kind == b"error")

    def kill(self) -> str:
        """End the process, and return how it ended."""
        self.connection.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.05)  # a process that has died already states why
        self._process.kill()
        code = self._process.wait()
        return f"exit code {code}" if code >= 0 else signal.Signals(-code).name
