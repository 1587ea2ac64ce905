"""Tasks of a partition lend their slots while they wait for other tasks.

A task that waits for tasks which it has submitted to its own partition holds what these need. So
while it waits, its slots are there for others, and its thread if it has one of the worker's:

- in `Future.result`, `Client.gather`, `distributed.wait`, `as_completed`, for a collection or a
  `Partition.map`: at once;
- in every other call of the scheduler that waits, such as `Queue.get`, `Variable.get`,
  `Event.wait`, `Lock.acquire`, `Pipe.get` and `Pipe.put`: once a nested task, or a task that wants
  its own slots or thread back, is waiting on this worker. A nested task is one that another task of
  a partition has submitted. A long task on a worker without nested tasks keeps its slots. So a
  producer and a consumer that a client submits need a slot each.

A loan lasts to the end of the wait. Then the task gets slots and thread back before it goes on,
even if the wait ended by a time-out. From the end of its wait until it has them, no other task may
start in them. Of several tasks that want slots back on one worker, the first to ask is the first to
get them. Do not hold a `threading.Lock` while you wait: a task that borrows the slot may want it.

A task that waits in another way, such as a loop over `Future.done`, lends nothing. If a task that
it has submitted waits for slots meanwhile, all clients get a warning.

Lending happens in the worker, because only the worker counts free slots. The scheduler knows a task
that has lent its slots as one that runs. Only tasks of partitions lend: other users' tasks that
hold a resource keep it, as in Dask without poolpart.

Coroutines, and threads that a task starts itself, do not lend.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import pickle
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from distributed import Status, rejoin, secede
from distributed.diagnostics.plugin import WorkerPlugin
from distributed.protocol.pickle import dumps

from ..internals.client import install_wait_hooks
from ..internals.scheduler import Resources, SubmittingTask, call_worker
from ..internals.worker import (
    count_slots,
    current_task,
    is_running,
    release_slots,
    reserve_slots,
    resources_of,
    submitter_of,
    threads_of,
)

logger = logging.getLogger(__name__)

WARN_AFTER_S = 5.0  # seconds that a nested task waits for slots before clients are warned
_CHECK_EVERY_S = 1.0  # whether the worker still exists
_ENDING = (Status.closing, Status.closed, Status.failed)

_lock = threading.Lock()
_lenders: dict[Any, Lender] = {}  # {worker of this process: its lender}
_thread = threading.local()


@dataclass
class _Loan:
    """Slots that a task has lent, and whether the task has the slots back."""

    key: Any  # key of the task
    slots: Resources
    returned: threading.Event = field(default_factory=threading.Event)


@dataclass(frozen=True)
class _NestedTask:
    """A task that waits for slots of this worker, with its submitting task."""

    submitter: SubmittingTask
    since: float  # time.monotonic()


class Lender:
    """Lends the slots of a worker's tasks, in the worker's event loop."""

    def __init__(self, worker: Any) -> None:
        self.worker = worker
        self.names: set[str] = set()  # partitions whose tasks lend
        self.waiters: set[threading.Event] = set()  # threads that lend once slots are wanted
        self._nested: dict[Any, _NestedTask] = {}  # {key: a task that waits for slots}
        self._loans: Counter[Any] = Counter()  # {key of a task: its loans under way}
        self._returning: deque[_Loan] = deque()  # loans whose tasks wait for their slots
        self._rejoining: set[Any] = set()  # keys of tasks that wait for a thread of the worker
        self._lent: set[Any] = set()  # keys of running tasks that have lent before
        self._warned: set[Any] = set()  # keys of submitting tasks that clients were warned of
        self._next_look: Any = None  # handle of the event loop

    # -- loans -------------------------------------------------------------------------

    def lend(self, loan: _Loan) -> None:
        """Make the slots of a loan free for further tasks."""
        self._loans[loan.key] += 1
        self._lent.add(loan.key)
        release_slots(self.worker, loan.slots)
        self.return_slots()

    def take_back(self, loan: _Loan) -> None:
        """Reserve the slots of a loan, and set `returned` of the loan once the slots are free."""
        self._loans[loan.key] -= 1
        if not self._loans[loan.key]:
            del self._loans[loan.key]
        reserve_slots(self.worker, loan.slots)
        self._returning.append(loan)
        self.return_slots()

    def begin_rejoin(self, key: Any) -> None:
        """Note a task that has its slots back, and waits for a thread."""
        self._rejoining.add(key)
        self._notify()

    def end_rejoin(self, key: Any) -> None:
        """Note a task that has a thread again."""
        self._rejoining.discard(key)

    def return_slots(self) -> None:
        """Give slots back to returning tasks in order, as far as the slots are free.

        After the last partition has ended, all returning tasks go on at once.
        """
        while self._returning and (not self.names or self._are_free(self._returning[0].slots)):
            self._returning.popleft().returned.set()
        self._notify()

    def _are_free(self, slots: Resources) -> bool:
        """Return whether a returning task may have these slots, {resource: number}, back.

        `take_back` has taken the slots of all returning tasks from the available slots, which may
        be below 0: the sum of both is what further tasks leave.
        """
        for name, number in slots.items():
            available, total = count_slots(self.worker, name)
            free = available + sum(loan.slots.get(name, 0) for loan in self._returning)
            # The total may be smaller than the loan: the partition has changed.
            if free < min(number, total):
                return False
        return True

    # -- who wants slots ---------------------------------------------------------------

    def slots_wanted(self) -> bool:
        """Return whether nested or returning tasks wait for slots, or a task for its thread."""
        return bool(self._nested or self._returning or self._rejoining)

    def lends_at_once(self, loan: _Loan) -> bool:
        """Return whether a task must lend in each wait, although nobody waits for slots.

        True for a task that has lent before, on a worker with more slots than threads. Dask counts
        a task that has seceded as long-running to its end, also after it has rejoined the worker's
        threads: a nested task may have started in a free slot, and wait for this task's thread. The
        nested task does not wait for slots, so that `slots_wanted` does not see it.
        """
        slots = sum(count_slots(self.worker, name)[1] for name in loan.slots)
        return loan.key in self._lent and slots > threads_of(self.worker)

    def _notify(self) -> None:
        """Wake the threads that would lend, if slots are wanted."""
        if self.slots_wanted():
            for waiter in tuple(self.waiters):
                waiter.set()

    def transition(self, key: Any, finish: str) -> None:
        """Follow the tasks of the worker.

        Tasks in the state "constrained" wait for slots.
        """
        self._nested.pop(key, None)
        if finish not in ("executing", "long-running"):
            self._lent.discard(key)
        if finish == "constrained" and (submitter := submitter_of(self.worker, key)) is not None:
            self._nested[key] = _NestedTask(submitter, time.monotonic())
            if self._next_look is None:
                self._look_later()
        self.return_slots()

    def stop(self) -> None:
        """End with the last partition: forget waiting tasks, and warn no more."""
        self._nested.clear()
        if self._next_look is not None:
            self._next_look.cancel()
            self._next_look = None

    # -- warnings ----------------------------------------------------------------------

    def _look_later(self) -> None:
        """Call `_look` in half of `WARN_AFTER_S`."""
        loop = asyncio.get_running_loop()
        self._next_look = loop.call_later(WARN_AFTER_S / 2, self._look)

    def _look(self) -> None:
        """Ask for each task that has waited long whether its submitter holds slots."""
        self._next_look = None
        looked_at = time.monotonic()
        for key, nested in self._nested.items():
            if (
                looked_at - nested.since >= WARN_AFTER_S
                and nested.submitter.key not in self._warned
            ):
                self._warned.add(nested.submitter.key)
                self.worker.loop.add_callback(self._warn, key, nested.submitter)
        if self._nested:
            self._look_later()
        else:
            self._warned.clear()

    def holds_slots(self, key: Any) -> bool:
        """Return whether a task runs here and holds its slots."""
        waits = any(loan.key == key for loan in self._returning)
        return is_running(self.worker, key) and not (self._loans[key] or waits)

    async def _warn(self, key: Any, submitter: SubmittingTask) -> None:
        """Warn all clients if the submitter of a waiting task, on whichever worker, holds slots."""
        try:
            holds = await call_worker(
                self.worker, submitter.worker, _holds_slots, key=submitter.key
            )
        except (OSError, ValueError):  # the worker has left, or the submitter's is not known
            holds = False
        if not holds or key not in self._nested:
            self._warned.discard(submitter.key)
            return
        restrictions = resources_of(self.worker.state.tasks[key])
        names = " and ".join(repr(name) for name in restrictions)
        message = (
            f"Task {submitter.key!r} of partition {names} holds a slot while task {key!r}, which "
            "it has submitted, waits for a slot. If the first task polls, for example by calling "
            "`Future.done` in a loop, both tasks wait forever. Use `Future.result`, "
            "`distributed.wait`, `as_completed` or `Pipe.get`, which lend the slot while they wait."
        )
        logger.warning(message)
        self.worker.log_event("warn", {"message": pickle.dumps(message)})


def _holds_slots(key: Any, dask_worker: Any = None) -> bool:
    """Return whether a task holds slots of a worker.

    Runs on that worker.
    """
    lender = _lenders.get(dask_worker)
    return lender is not None and lender.holds_slots(key)


# -- waits -------------------------------------------------------------------------------


def _loan_of_thread() -> tuple[Lender, _Loan] | None:
    """Return the lender and a new loan for the task of this thread, or None without slots."""
    running = current_task()
    if running is None or getattr(_thread, "in_loan", False):
        return None
    worker, task = running
    lender = _lenders.get(worker)
    if lender is None:
        return None
    slots = {name: n for name, n in resources_of(task).items() if name in lender.names}
    return (lender, _Loan(task.key, slots)) if slots else None


class _WaitHooks:
    """Hooks that the waits of clients call, as `internals.client.WaitHooks` describes."""

    def may_lend(self) -> bool:
        """Return whether the task of this thread has slots to lend."""
        return _loan_of_thread() is not None

    def wait_until_wanted(self, answer: concurrent.futures.Future[Any]) -> None:
        """Wait until a call has its answer, or further tasks want the slots."""
        loan_of_task = _loan_of_thread()
        if loan_of_task is None:
            return
        lender, loan = loan_of_task
        waiter = threading.Event()
        answer.add_done_callback(lambda _: waiter.set())
        lender.waiters.add(waiter)
        try:
            # The worker's event loop first notes who wants slots, and then sets the waiters that
            # there are: with this order no wish is missed.
            while not (waiter.is_set() or lender.slots_wanted() or lender.lends_at_once(loan)):
                waiter.wait(_CHECK_EVERY_S)
                if lender.worker.status is Status.closed:
                    return
        finally:
            lender.waiters.discard(waiter)

    @contextmanager
    def lend(self, waits: bool = True) -> Iterator[None]:
        """Lend the slots and the thread of this thread's task within the block, if `waits`.

        At the end of the block the thread waits until the task has them back.
        """
        loan_of_task = _loan_of_thread() if waits else None
        if loan_of_task is None:
            yield
            return
        lender, loan = loan_of_task
        worker = lender.worker
        _thread.in_loan = True
        has_thread = False
        # After `worker_client`, or in the user's executor, the worker did not start this thread.
        with suppress(KeyError, AttributeError):
            secede()
            has_thread = True
        worker.loop.add_callback(lender.lend, loan)
        try:
            yield
        finally:
            _thread.in_loan = False
            worker.loop.add_callback(lender.take_back, loan)
            while not loan.returned.wait(_CHECK_EVERY_S) and worker.status is not Status.closed:
                pass
            # Not before: tasks that have borrowed the slots need the worker's threads to end. While
            # this one waits for a thread, tasks that wait in one lend theirs.
            if has_thread and worker.status not in _ENDING:  # then the threads end as well
                worker.loop.add_callback(lender.begin_rejoin, loan.key)
                rejoin()
                worker.loop.add_callback(lender.end_rejoin, loan.key)


WAIT_HOOKS = _WaitHooks()


# -- on and off --------------------------------------------------------------------------


def begin_lending(worker: Any, name: str) -> Lender:
    """Let the tasks of a partition lend on a worker, in the worker's event loop."""
    with _lock:
        install_wait_hooks(WAIT_HOOKS)
        lender = _lenders.setdefault(worker, Lender(worker))
    lender.names.add(name)
    return lender


def end_lending(worker: Any, name: str) -> None:
    """Let the tasks of a partition keep their slots again, in the worker's event loop."""
    with _lock:
        lender = _lenders[worker]
        lender.names.discard(name)
        if not lender.names:
            del _lenders[worker]
            lender.stop()
        lender.return_slots()


def lending_plugin(name: str) -> bytes:
    """Return a pickled plugin that has workers lend until it is removed.

    A joining worker gets tasks before a request can reach the worker, and plugins before its tasks.
    Workers without this package ignore the plugin.
    """

    class LendingPlugin(WorkerPlugin):
        # A class within a function is sent by value.
        lender: Any = None

        def setup(self, worker: Any) -> None:
            try:
                from poolpart.extras.lending import begin_lending
                from poolpart.internals.names import NESTED, missing_names
            except ImportError:
                return
            if not missing_names(NESTED):  # another version of Dask than the scheduler's
                self.lender = begin_lending(worker, name)

        def teardown(self, worker: Any) -> None:
            if self.lender is not None:
                from poolpart.extras.lending import end_lending
                from poolpart.registration import forget_registrations

                end_lending(worker, name)
                # The scheduler has removed the registrations of all clients.
                forget_registrations(name)

        def transition(self, key: Any, start: str, finish: str, **kwargs: Any) -> None:
            if self.lender is not None:
                self.lender.transition(key, finish)

    plugin: bytes = dumps(LendingPlugin())
    return plugin
