"""Log of the points that a run passes, and faults that are injected at these points.

The log must survive the process that writes it. Each event is therefore one line that is appended
to a file of the process in one system call. Armed faults are files in a folder. A process that
reaches the point of a fault moves its file away, so that exactly one process injects the fault, and
a process that was restarted knows as much as the others.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from distributed.diagnostics.plugin import WorkerPlugin
from distributed.worker import thread_state

from lidarpool.processes.tracing import trace_to
from poolpart import pipe

Event = dict[str, Any]

KILL, TERM, SEGV, STOP, RETIRE, RESTART, PAUSE, DAMAGE, LINK, CLIENT = KINDS = (
    "kill",  # SIGKILL
    "term",  # SIGTERM
    "segv",  # segmentation fault
    "stop",  # SIGSTOP, and SIGCONT some time later
    "retire",  # the worker leaves gracefully; one of its name joins
    "restart",  # its nanny is told to start it again
    "pause",  # as Dask does if memory is short, and on again some time later
    "damage",  # a bit of a part in storage is flipped; the run is resumed once it has ended
    "link",  # the run's folder gets a link to another's; the run is resumed with and without it
    "client",  # SIGKILL while a thread waits in `Pipe.get`, `Pipe.put` or the like
)
SIGNALS = {KILL: signal.SIGKILL, TERM: signal.SIGTERM, SEGV: signal.SIGSEGV, STOP: signal.SIGSTOP}

RANDOM = "random time"  # in place of a point
HOLD_S = 5.0  # longest time that a point is held for somebody else to carry a fault out
PIPE_WAIT_S = 10.0  # longest time until a worker of the LIDAR stages waits at a pipe
# Functions of poolpart/pipe.py in which a thread waits for the scheduler's answer. They are
# private: stacks of threads name them, and nobody else should call them.
REQUESTS = {pipe._ask.__code__, pipe._ask_until.__code__}
_EVENTS = "events"
_ARMED = "armed"
_FIRED = "fired"


@dataclass(frozen=True)
class Fault:
    """Fault to inject into a run."""

    number: int  # tells faults apart
    kind: str  # of KINDS
    point: str  # at which it happens, or RANDOM
    scan: int = 0  # at a point: at the first pass that is about this scan or a later one
    worker: str = ""  # at a point: who is to come to it; "" for anybody
    partition: str = ""  # whose worker; "" for the one that passes the point
    pick: float = 0.0  # which of the partition's workers, from 0 to 1
    after_s: float = 0.0  # at a random time: seconds after the one before
    stop_s: float = 0.5  # until it goes on
    # Whether the scheduler is to give the stopped worker up meanwhile, at once. Its time to live
    # can then be so long that no other worker is given up for being slow.
    given_up: bool = False


@dataclass(frozen=True)
class Fired:
    """Fault that a process has claimed.

    If the process waits, it continues when `path` is removed.
    """

    number: int
    kind: str
    pid: int
    worker: str
    path: Path


class Board:
    """Folder shared by all processes, with the logged events and the faults to inject."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in (_EVENTS, _ARMED, _FIRED):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def arm(self, fault: Fault) -> None:
        """Arm a fault, so that the next process that reaches its point injects it.

        The name of the file contains everything that the process needs to know.
        """
        name = f"{fault.number:05d}~{fault.kind}~{fault.point}~{fault.scan}~{fault.worker}"
        (self.folder / _ARMED / name).touch()

    def disarm(self) -> None:
        """Withdraw the faults that no process has claimed."""
        for path in (self.folder / _ARMED).iterdir():
            path.unlink(missing_ok=True)  # it may be taken at this moment

    def claim(self, point: str, scan: int, worker: str) -> Fired | None:
        """Claim an armed fault for this point, or return None if there is none."""
        for name in sorted(path.name for path in (self.folder / _ARMED).iterdir()):
            number, kind, where, first, whose = name.split("~")
            if where == point and scan >= int(first) and whose in ("", worker):
                path = self.folder / _FIRED / f"{number}~{kind}~{os.getpid()}~{worker}"
                with suppress(FileNotFoundError):
                    (self.folder / _ARMED / name).rename(path)
                    return Fired(int(number), kind, os.getpid(), worker, path)
        return None

    def fired(self) -> Iterator[Fired]:
        """Yield the claimed faults whose files still exist."""
        for path in sorted((self.folder / _FIRED).iterdir()):
            number, kind, pid, worker = path.name.split("~")
            yield Fired(int(number), kind, int(pid), worker, path)

    def log(self, event: Event) -> None:
        """Append an event to the log file of this process."""
        path = self.folder / _EVENTS / f"{event['pid']}.jsonl"
        line = json.dumps(event, default=str) + "\n"
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(descriptor, line.encode())
        finally:
            os.close(descriptor)

    def events(self, run: str) -> list[Event]:
        """Return a run's events so far, grouped by process and in order of time."""
        lines = (
            line
            for path in sorted((self.folder / _EVENTS).iterdir())
            for line in path.read_text().splitlines()
        )
        events = [json.loads(line) for line in lines if run in line]
        return [event for event in events if event.get("run") == run]

    @property
    def has_events(self) -> bool:
        """Whether any event was logged."""
        return any((self.folder / _EVENTS).iterdir())

    def forget_events(self) -> None:
        for path in (self.folder / _EVENTS).iterdir():
            path.unlink()


class Sink:
    """Callback for `trace_to` that logs points, slows the run down, and injects faults.

    `strike` injects a fault that was claimed here. `pauses` maps points to the seconds per scan for
    which the thread is held there, because a run would otherwise end before faults can occur.
    """

    def __init__(
        self,
        board: Board,
        worker: str,
        strike: Callable[[Fired], None],
        pauses: Mapping[str, float] | None = None,
    ) -> None:
        self.board = board
        self.worker = worker
        self.strike = strike
        self.pauses = dict(pauses or {})

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


def die_at_pipe() -> None:
    """Start a thread that kills this process as soon as another thread waits at a pipe.

    The scheduler is then left with a request from a dead client.
    """

    def waits_at_pipe() -> bool:
        for frame in sys._current_frames().values():
            caller: FrameType | None = frame
            while caller is not None:
                if caller.f_code in REQUESTS:
                    return True
                caller = caller.f_back
        return False

    def kill_when_waiting() -> None:
        deadline = time.monotonic() + PIPE_WAIT_S
        while time.monotonic() < deadline:
            if waits_at_pipe():
                os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(0.001)

    threading.Thread(target=kill_when_waiting, name="die at pipe", daemon=True).start()


def strike_self(fired: Fired) -> None:
    """Kill or stop this process, or hold this thread until the nemesis has injected the fault."""
    if fired.kind == CLIENT:
        die_at_pipe()  # the thread of the point has to go on to the pipe
        return
    if fired.kind == SEGV:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        ctypes.string_at(0)
    elif fired.kind in SIGNALS:
        os.kill(os.getpid(), SIGNALS[fired.kind])
    deadline = time.monotonic() + HOLD_S
    while fired.path.exists() and time.monotonic() < deadline:
        time.sleep(0.005)


class ChaosPlugin(WorkerPlugin):
    """Plugin that makes all current and future workers log their points and inject faults."""

    name = "chaos"

    def __init__(self, folder: str, pauses: Mapping[str, float] | None = None) -> None:
        self.folder = folder
        self.pauses = dict(pauses or {})

    def setup(self, worker: Any) -> None:
        """Trace the points of this worker until its process ends.

        Tracing continues after the worker is closed, because its long tasks run for a moment
        longer.
        """
        logging.disable(logging.CRITICAL)  # that workers die here is no news
        board = Board(Path(self.folder))
        trace_to(Sink(board, str(worker.name), strike_self, self.pauses))
