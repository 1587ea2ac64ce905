"""Plan of faults that is generated from a seed, and the nemesis that injects them."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain, cycle
from pathlib import Path

import psutil
from distributed import Worker

from lidarpool.processes.tracing import trace_to

from .arena import TIME_TO_LIVE_S, Arena
from .events import (
    CLIENT,
    DAMAGE,
    KINDS,
    LINK,
    PAUSE,
    PIPE_WAIT_S,
    RANDOM,
    RESTART,
    RETIRE,
    SIGNALS,
    STOP,
    Fault,
    Fired,
    Sink,
    die_at_pipe,
)

PARTITIONS = ("GPU", "LIDAR", "OTHER")
ALL_AT_ONCE = 0.15  # part of the faults at random times that come together with the one before
SHORT_STOPS_S = 0.1, 2.0
LONG_STOP_S = 2.1 * TIME_TO_LIVE_S
LONG_STOPS = 0.1  # part of them
LOOK_EVERY_S = 0.005
WAKE_MOST_S = 30.0  # for those who are to stop to have stopped, when all is over


def make_plan(
    seed: int, count: int, worker_points: Sequence[str], driver_points: Sequence[str], scans: int
) -> list[Fault]:
    """Choose faults, which depend only on the arguments.

    The first faults cover every point and every kind. Then each kind occurs at each point of the
    workers, and all remaining faults occur at random times. Workers inject faults into themselves
    at their points. At its points, the driver injects faults into a worker.
    """
    chance = random.Random(seed)
    turned = [KINDS[turn:] + KINDS[:turn] for turn in range(len(KINDS))]
    first, *others = [
        [(kind, point, "") for kind, point in zip(cycle(kinds), worker_points, strict=False)]
        for kinds in turned
    ]
    at = [  # (kind, point, partition)
        *first,
        *((chance.choice(KINDS), point, "GPU") for point in driver_points),
        *((chance.choice(KINDS), RANDOM, partition) for partition in PARTITIONS),
        *chain.from_iterable(others),
        *((chance.choice(KINDS), point, "LIDAR") for point in driver_points),
    ]
    at = [place for place in at if _is_possible(*place[:2])]
    while len(at) < count:
        at.append((KINDS[len(at) % len(KINDS)], RANDOM, chance.choice(PARTITIONS)))
    at = [
        (kind, point, "LIDAR" if kind == CLIENT and partition else partition)
        for kind, point, partition in at[:count]
    ]
    chance.shuffle(at)
    return [_fault(chance, scans, number, *choice) for number, choice in enumerate(at)]


def _is_possible(kind: str, point: str) -> bool:
    """Return whether this kind of fault can occur at a point.

    No parts exist yet when a stage starts, and casting tasks have no pipes.
    """
    if kind == DAMAGE:
        return not point.endswith(".start")
    return kind != CLIENT or not point.startswith("intersect.")


def _fault(
    chance: random.Random, scans: int, number: int, kind: str, point: str, partition: str
) -> Fault:
    long = chance.random() < LONG_STOPS
    together = chance.random() < ALL_AT_ONCE
    return Fault(
        number,
        kind,
        point,
        # A stage that starts, or says hello, is about no scan yet.
        scan=0 if point.endswith((".start", ".hello")) else chance.randrange(scans * 9 // 10),
        after_s=0.0 if together else chance.uniform(0.05, 1.5),
        partition=partition,
        pick=chance.random(),
        stop_s=LONG_STOP_S if long else chance.uniform(*SHORT_STOPS_S),
    )


class Nemesis:
    """Context manager that injects faults into a run whose driver is in this process.

    The run keeps its parts in the folder `parts`. Links lead from there to the run in the folder
    `stranger`.

    Faults at points are armed at the start. Faults at random times are injected one after another,
    starting when any process passes a point.
    """

    def __init__(self, arena: Arena, faults: Sequence[Fault], parts: Path, stranger: Path) -> None:
        self.arena = arena
        self.parts = parts
        self.stranger = stranger
        self.faults = {fault.number: fault for fault in faults}
        self.done: Counter[tuple[str, str]] = Counter()  # {(kind, point): times}
        self.left: list[Fault] = []  # afterwards: those that were not carried out
        self.run = ""  # the run that the driver's last point told of
        self._carried_out: set[int] = set()
        self._stopped: dict[int, float] = {}  # {pid: when it is to go on}
        self._lock = threading.Lock()
        self._helpers: list[threading.Thread] = []
        self._over = threading.Event()
        self._looker = threading.Thread(target=self._watch, name="nemesis")

    def __enter__(self) -> Nemesis:
        for fault in self.faults.values():
            if fault.point != RANDOM:
                self.arena.board.arm(fault)
        trace_to(_DriverSink(self))
        self._looker.start()
        return self

    def __exit__(self, *_: object) -> None:
        trace_to(None)
        self._over.set()
        self._looker.join()
        self.arena.board.disarm()
        for fired in self.arena.board.fired():
            fault = self.faults[fired.number]
            if not fault.given_up and fault.kind != CLIENT:  # nobody has done that
                self._note(fault)
            fired.path.unlink()
            if fault.kind == STOP and not fault.partition:
                self._stopped[fired.pid] = 0.0
        for helper in self._helpers:
            helper.join()
        deadline = time.monotonic() + WAKE_MOST_S
        while self._stopped and time.monotonic() < deadline:
            self._wake(float("inf"))
            time.sleep(LOOK_EVERY_S)
        self.left = [f for number, f in self.faults.items() if number not in self._carried_out]

    # -- in the nemesis' own thread ----------------------------------------------------

    def _watch(self) -> None:
        due = float("inf")
        timed = [fault for fault in self.faults.values() if fault.point == RANDOM]
        while not self._over.is_set():
            if due == float("inf") and self.arena.board.has_events:  # it has begun
                due = time.monotonic()
            # One that finds nobody there waits until somebody is.
            while timed and time.monotonic() >= due + timed[0].after_s and self.strike(timed[0]):
                due = time.monotonic()
                timed.pop(0)
            for fired in self.arena.board.fired():
                self._answer(fired)
            self._wake(time.monotonic())
            self._over.wait(LOOK_EVERY_S)

    def _answer(self, fired: Fired) -> None:
        """Complete a fault that the process at its point cannot complete by itself."""
        fault = self.faults[fired.number]
        if fault.partition:  # the driver does that in its own thread
            return
        do = self._files.get(fault.kind)
        if fault.kind != CLIENT and (do is None or do(fault)):
            self._note(fault)
        fired.path.unlink()
        if fault.kind == STOP:
            if fault.given_up:
                while _is_going(fired.pid):
                    time.sleep(LOOK_EVERY_S)
                self.arena.give_up(fired.pid)
            with self._lock:
                self._stopped[fired.pid] = time.monotonic() + fault.stop_s
        elif fault.kind == CLIENT:
            self._start_helper(self._note_death, fault, fired.pid)
        elif fault.kind in (RETIRE, RESTART, PAUSE):
            self._help(fault, fired.worker)

    def _wake(self, now: float) -> None:
        """Continue the processes that have been stopped for long enough."""
        with self._lock:
            over = [pid for pid, until in self._stopped.items() if until <= now]
            # A process that is slow to stop itself would not hear it, and stay stopped.
            over = [pid for pid in over if not _is_going(pid)]
            for pid in over:
                del self._stopped[pid]
        for pid in over:
            _send(pid, signal.SIGCONT)

    # -- in either thread --------------------------------------------------------------

    def strike(self, fault: Fault) -> bool:
        """Inject a fault into a worker of its partition.

        Return False if no worker is running.

        Only workers that have joined are chosen, because a nanny exits if its worker dies before.
        """
        names = [name for name in self.arena.names(fault.partition) if self.arena.address(name)]
        if not names:
            return False
        name = names[int(fault.pick * len(names))]
        if fault.kind == CLIENT:
            return self._kill_at_pipe(fault, name)
        if fault.kind in self._files:
            done = self._files[fault.kind](fault)
        else:
            done = (self._signal if fault.kind in SIGNALS else self._help)(fault, name)
        if done:
            self._note(fault)
        return done

    def _signal(self, fault: Fault, name: str) -> bool:
        pid = self.arena.pid(name)
        if pid is None or not _send(pid, SIGNALS[fault.kind]):
            return False
        if fault.kind == STOP:
            with self._lock:
                self._stopped[pid] = time.monotonic() + fault.stop_s
        return True

    @property
    def _files(self) -> dict[str, Callable[[Fault], bool]]:
        return {DAMAGE: self._damage, LINK: self._link}

    def _link(self, fault: Fault) -> bool:
        """Add a link to a foreign file, under a name that the run might use for its own files."""
        for mark in self.parts.glob("*-mark"):
            link = mark.with_name(mark.name.replace("mark", f"probe-{fault.number:08x}"))
            link.symlink_to(self.stranger / "run.owner")
            return True
        return False

    def _damage(self, fault: Fault) -> bool:
        """Flip a bit in one of the parts.

        Return False if there are no parts.
        """
        parts = sorted(self.parts.glob("*.npz"))
        with suppress(FileNotFoundError):  # just removed, as one that came twice
            if parts:
                path = parts[int(fault.pick * len(parts))]
                data = bytearray(path.read_bytes())
                data[int(fault.pick * 1e6) % len(data)] ^= 1 << fault.number % 8
                path.write_bytes(data)
                return True
        return False

    def _help(self, fault: Fault, name: str) -> bool:
        """Retire, restart or pause a worker in a new thread.

        Return False if the worker is down.
        """
        address = self.arena.address(name)
        if address is None:
            return False
        acts = {RETIRE: self._retire, RESTART: self._restart, PAUSE: self._pause}
        self._start_helper(acts[fault.kind], name, address, fault.stop_s)
        return True

    def _start_helper(self, act: Callable[..., None], *arguments: object) -> None:
        helper = threading.Thread(target=act, args=arguments, name=act.__name__)
        self._helpers.append(helper)
        helper.start()

    def _kill_at_pipe(self, fault: Fault, name: str) -> bool:
        """Make a worker kill itself as soon as it waits at a pipe.

        Return False if the worker is down.
        """
        pid = self.arena.pid(name)
        address = self.arena.address(name)
        if pid is None or address is None:
            return False

        def ask_and_note() -> None:
            with suppress(OSError, ValueError):  # the worker has died by another fault
                self.arena.client.run(die_at_pipe, workers=[address], on_error="ignore")
                self._note_death(fault, pid)

        self._start_helper(ask_and_note)
        return True

    def _note_death(self, fault: Fault, pid: int) -> None:
        """Record a fault once its process has died.

        Nothing is recorded if the process has not waited at a pipe.
        """
        deadline = time.monotonic() + PIPE_WAIT_S
        while time.monotonic() < deadline:
            if not psutil.pid_exists(pid):
                self._note(fault)
                return
            time.sleep(LOOK_EVERY_S)

    def _pause(self, name: str, address: str, seconds: float) -> None:
        def pause_at(fraction: float, dask_worker: Worker) -> None:
            dask_worker.memory_manager.memory_pause_fraction = fraction

        for fraction in (1e-9, 0.8):
            with suppress(OSError, ValueError):  # it died by another fault
                self.arena.client.run(pause_at, fraction, workers=[address], on_error="ignore")
            if fraction < 0.8:
                self._over.wait(seconds)

    def _retire(self, name: str, address: str, _: float) -> None:
        self.arena.client.retire_workers([address], close_workers=True)
        there = False
        while not there:
            with suppress(RuntimeError):  # the new one was struck before its nanny had heard of it
                self.arena.revive(name)
            there = name not in self.arena.deserted

    def _restart(self, name: str, address: str, _: float) -> None:
        with suppress(KeyError, ValueError, TimeoutError):  # it left by another fault
            self.arena.client.restart_workers([address], timeout=30, raise_for_error=False)

    def _note(self, fault: Fault) -> None:
        with self._lock:
            if fault.number not in self._carried_out:
                self._carried_out.add(fault.number)
                self.done[fault.kind, fault.point] += 1


class _DriverSink(Sink):
    """Sink of the driver, which injects its faults into a worker."""

    def __init__(self, nemesis: Nemesis) -> None:
        super().__init__(nemesis.arena.board, "driver", self._strike)
        self._nemesis = nemesis

    def __call__(self, point: str, fields: dict[str, object]) -> None:  # type: ignore[override]
        self._nemesis.run = str(fields.get("run", ""))
        super().__call__(point, fields)

    def _strike(self, fired: Fired) -> None:
        fired.path.unlink(missing_ok=True)
        self._nemesis.strike(self._nemesis.faults[fired.number])


def _is_going(pid: int) -> bool:
    """Return whether a process exists and is not stopped."""
    try:
        status = psutil.Process(pid).status()
    except psutil.NoSuchProcess:
        return False
    return status not in (psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)


def _send(pid: int, number: signal.Signals) -> bool:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True
