"""Tasks of a partition lend their slots while they wait for other tasks.

A task that waits for tasks which it has submitted to its own partition holds what they need. So
while it waits in `Future.result`, `Client.gather`, `distributed.wait`, `as_completed`, for a
collection or for a `Partition.map`, its slots are there for others, and its thread if it has one of
the worker's. It gets both back before it goes on, also when the wait ends by a time-out; until then
no waiting task gets the slots. Of several that want slots back on one worker, the first to ask is
the first to get them.

That happens in the worker, because only the worker counts free slots. The scheduler knows a task
that has lent its slots as one that runs. Only tasks of partitions lend: other users' tasks that
hold a resource keep it, as in Dask without poolpart.

Coroutines, and threads that a task starts itself, do not lend.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from distributed import Status, rejoin, secede
from distributed.diagnostics.plugin import WorkerPlugin
from distributed.protocol.pickle import dumps

from .internals.client import let_waits_lend
from .internals.scheduler import Resources
from .internals.worker import free_slots, resources_of, slots_here, take_slots, task_of_thread

_LOOK_S = 1.0  # between looks whether the worker is still there

_lock = threading.Lock()
_lenders: dict[Any, Lender] = {}  # by worker of this process
_thread = threading.local()


@dataclass
class _Loan:
    """Slots that one task has lent, and whether it has them back."""

    slots: Resources
    ended: threading.Event = field(default_factory=threading.Event)


class Lender:
    """Lends the slots of a worker's tasks; its methods run in the worker's event loop."""

    def __init__(self, worker: Any) -> None:
        self.worker = worker
        self.names: set[str] = set()  # partitions whose tasks lend
        self._wanted: deque[_Loan] = deque()  # slots that tasks wait for, in the order of asking

    def lend(self, loan: _Loan) -> None:
        """Let other tasks have the slots."""
        free_slots(self.worker, loan.slots)
        self.serve()

    def take_back(self, loan: _Loan) -> None:
        """Let no other task start in these slots, and say when they are free."""
        take_slots(self.worker, loan.slots)
        self._wanted.append(loan)
        self.serve()

    def serve(self) -> None:
        """Give slots back, as far as they are free."""
        while self._wanted and (not self.names or self._are_free(self._wanted[0].slots)):
            self._wanted.popleft().ended.set()

    def _are_free(self, slots: Resources) -> bool:
        for name, number in slots.items():
            available, total = slots_here(self.worker, name)
            free = available + sum(loan.slots.get(name, 0) for loan in self._wanted)
            # All that there are may be fewer than before: the partition has changed.
            if free < min(number, total):
                return False
        return True


@contextmanager
def slots_lent(waits: bool = True) -> Iterator[None]:
    """Lend the slots and the thread of this thread's task, if it waits; elsewhere do nothing."""
    here = task_of_thread() if waits else None
    lender = _lenders.get(here[0]) if here else None
    if here is None or lender is None or getattr(_thread, "lends", False):
        yield
        return
    worker, task = here
    slots = {name: n for name, n in resources_of(task).items() if name in lender.names}
    if not slots:
        yield
        return
    loan = _Loan(slots)
    _thread.lends = True
    has_thread = False
    # This thread is none of the worker's after `worker_client`, or in an executor of the user's.
    with suppress(KeyError, AttributeError):
        secede()
        has_thread = True
    worker.loop.add_callback(lender.lend, loan)
    try:
        yield
    finally:
        _thread.lends = False
        worker.loop.add_callback(lender.take_back, loan)
        while not loan.ended.wait(_LOOK_S) and worker.status is not Status.closed:
            pass
        # Not before: those that have the slots need the worker's threads to end.
        if has_thread and worker.status is not Status.closed:
            rejoin()


# -- on and off --------------------------------------------------------------------------


def begin_lending(worker: Any, name: str) -> Lender:
    """Have the tasks of a partition lend on this worker; runs in its event loop."""
    with _lock:
        let_waits_lend(slots_lent)
        lender = _lenders.setdefault(worker, Lender(worker))
    lender.names.add(name)
    return lender


def end_lending(worker: Any, name: str) -> None:
    """Have them keep their slots again."""
    with _lock:
        lender = _lenders[worker]
        lender.names.discard(name)
        if not lender.names:
            del _lenders[worker]
            lender.serve()


def lending_plugin(name: str) -> bytes:
    """Plugin by which workers begin, and end; those without this package ignore it.

    A worker that joins gets tasks before any request can reach it. A plugin comes first.
    """

    class Lending(WorkerPlugin):
        # A class within a function is sent by value.
        lender: Any = None

        def setup(self, worker: Any) -> None:
            try:
                from poolpart.lending import begin_lending
            except ImportError:
                return
            self.lender = begin_lending(worker, name)

        def teardown(self, worker: Any) -> None:
            if self.lender is not None:
                from poolpart.lending import end_lending

                end_lending(worker, name)

        def transition(self, *args: Any, **kwargs: Any) -> None:
            if self.lender is not None:
                self.lender.serve()

    plugin: bytes = dumps(Lending())
    return plugin
