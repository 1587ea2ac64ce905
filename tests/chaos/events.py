"""What a run passes, written down as it happens, and faults carried out at those points.

The log must survive the process that writes it: each event is one line, appended in one
system call, to a file of the process. Faults are armed as files in a folder: a process that
comes to the point takes the file away, so that exactly one carries the fault out, and one
that was restarted meanwhile knows as much as the others.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed.diagnostics.plugin import WorkerPlugin
from distributed.worker import thread_state

from lidarpool.base.tracing import trace_to

Event = dict[str, Any]

KILL, TERM, SEGV, STOP, RETIRE, RESTART = KINDS = (
    "kill",  # SIGKILL
    "term",  # SIGTERM
    "segv",  # segmentation fault
    "stop",  # SIGSTOP, and SIGCONT some time later
    "retire",  # the worker leaves gracefully; one of its name joins
    "restart",  # its nanny is told to start it again
)
SIGNALS = {
    KILL: signal.SIGKILL,
    TERM: signal.SIGTERM,
    SEGV: signal.SIGSEGV,
    STOP: signal.SIGSTOP,
}

HOLD_S = 5.0  # longest time that a point is held for somebody else to carry a fault out
_EVENTS, _ARMED, _FIRED = "events", "armed", "fired"


@dataclass(frozen=True)
class Order:
    """A fault that waits for a process to come to a point.

    Parameters
    ----------
    number
        Tells faults apart.
    kind
        One of `KINDS`.
    point
        Where to carry it out.
    scan
        At the first pass there that is about this scan or a later one.
    worker
        Whose pass; "" for anybody's.
    """

    number: int
    kind: str
    point: str
    scan: int = 0
    worker: str = ""

    @property
    def file_name(self) -> str:
        """The order as the name of its file: nothing has to be read."""
        return f"{self.number:05d}~{self.kind}~{self.point}~{self.scan}~{self.worker}"

    @classmethod
    def parse(cls, name: str) -> Order:
        """Inverse of `file_name`; anything may follow."""
        number, kind, point, scan, worker = name.split("~")[:5]
        return cls(int(number), kind, point, int(scan), worker)


@dataclass(frozen=True)
class Fired:
    """An order that a process has taken.

    `path` can be removed to tell the process, which may be waiting, to go on.
    """

    order: Order
    pid: int
    worker: str
    path: Path


class Board:
    """The folder that all processes share: events that happened, orders that wait."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in (_EVENTS, _ARMED, _FIRED):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def arm(self, order: Order) -> None:
        """Have the next process that comes to the point carry it out."""
        (self.folder / _ARMED / order.file_name).touch()

    def disarm(self) -> list[Order]:
        """Take back the orders that nobody has come to."""
        left = []
        for path in sorted((self.folder / _ARMED).iterdir()):
            with suppress(FileNotFoundError):  # taken at this moment
                path.unlink()
                left.append(Order.parse(path.name))
        return left

    def claim(self, point: str, scan: int, worker: str) -> Fired | None:
        """Take an order for this point, if there is one that nobody else takes."""
        for name in sorted(path.name for path in (self.folder / _ARMED).iterdir()):
            order = Order.parse(name)
            mine = order.worker in ("", worker)
            if mine and order.point == point and scan >= order.scan:
                path = self.folder / _FIRED / f"{name}~{os.getpid()}~{worker}"
                try:
                    (self.folder / _ARMED / name).rename(path)
                except FileNotFoundError:
                    continue
                return Fired(order, os.getpid(), worker, path)
        return None

    def fired(self) -> Iterator[Fired]:
        """Orders that were taken and whose files are still there."""
        for path in sorted((self.folder / _FIRED).iterdir()):
            *_, pid, worker = path.name.split("~")
            yield Fired(Order.parse(path.name), int(pid), worker, path)

    def log(self, event: Event) -> None:
        """Append an event to this process's file."""
        path = self.folder / _EVENTS / f"{event['pid']}.jsonl"
        line = json.dumps(event, default=str) + "\n"
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(descriptor, line.encode())
        finally:
            os.close(descriptor)

    def events(self, run: str | None = None) -> list[Event]:
        """All events so far, or those of a run: by process, in the order they happened there."""
        lines = (
            line
            for path in sorted((self.folder / _EVENTS).iterdir())
            for line in path.read_text().splitlines()
        )
        events = [json.loads(line) for line in lines if run is None or run in line]
        return [event for event in events if run is None or event.get("run") == run]

    @property
    def has_events(self) -> bool:
        """Whether anything was logged."""
        return any((self.folder / _EVENTS).iterdir())

    def forget_events(self) -> None:
        """Start over with an empty log."""
        for path in (self.folder / _EVENTS).iterdir():
            path.unlink()


class Sink:
    """What `trace_to` is given: it logs a point, slows it down, strikes there.

    Parameters
    ----------
    board
        Where to log, and where orders are.
    worker
        Name of the worker, or of whoever else this process is.
    strike
        Carries an order out that was taken here.
    pauses
        Seconds to hold the thread at some points, by name, for each scan that it is about: it
        paces a run that would be over before anything could happen to it.
    """

    def __init__(
        self,
        board: Board,
        worker: str,
        strike: Callable[[Fired], None],
        pauses: Mapping[str, float] | None = None,
    ) -> None:
        self.board, self.worker = board, worker
        self.strike, self.pauses = strike, dict(pauses or {})

    def __call__(self, point: str, fields: Mapping[str, Any]) -> None:
        scans = fields.get("scans", ())
        self.board.log(
            {
                "t": time.time(),
                "pid": os.getpid(),
                "worker": self.worker,
                "key": str(getattr(thread_state, "key", "")),
                "point": point,
                **fields,
            }
        )
        if pause := self.pauses.get(point):
            time.sleep(pause * len(scans))
        if fired := self.board.claim(point, max(scans, default=0), self.worker):
            self.strike(fired)


def strike_self(fired: Fired) -> None:
    """End or stop this process, or hold this thread until somebody has done what is ordered."""
    kind = fired.order.kind
    if kind == SEGV:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        ctypes.string_at(0)
    elif kind in SIGNALS:
        os.kill(os.getpid(), SIGNALS[kind])
    deadline = time.monotonic() + HOLD_S
    while fired.path.exists() and time.monotonic() < deadline:
        time.sleep(0.005)


class ChaosPlugin(WorkerPlugin):
    """Has every worker, also one that joins later, log its points and obey orders."""

    name = "chaos"

    def __init__(self, folder: str, pauses: Mapping[str, float] | None = None) -> None:
        self.folder, self.pauses = folder, dict(pauses or {})

    def setup(self, worker: Any) -> None:
        """Listen to this worker's points, for as long as its process lasts.

        Not only until it is torn down: its long tasks go on for a moment after that.
        """
        logging.disable(logging.CRITICAL)  # that workers die here is no news
        board = Board(Path(self.folder))
        trace_to(Sink(board, str(worker.name), strike_self, self.pauses))
