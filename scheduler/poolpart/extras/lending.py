"""Let tasks lend their slots while they wait for other tasks of their partition.

A task that waits for tasks that it has submitted to its own partition occupies the slots that these
tasks need. Therefore, while it waits, other tasks can use its slots and its worker thread:

- In `Future.result`, `Client.gather`, `distributed.wait` and `as_completed`, and for collections
  and `Partition.map`, the task lends its slots immediately.
- In all other calls of the scheduler that wait, for example `Queue.get`, `Variable.get`,
  `Event.wait`, `Lock.acquire`, `Pipe.get` and `Pipe.put`, the task lends its slots as soon as
  another task needs them on this worker. This is either a nested task, which another task of a
  partition has submitted, or a task that waits to get its own slots or thread back. On a worker
  without nested tasks, a long-running task keeps its slots. Therefore, a producer and a consumer
  that a client has submitted need one slot each.
- A task that has left the worker's thread pool with `distributed.secede`, as nested calls of joblib
  do, lends its slots in the same cases, until it rejoins the pool or ends.

The loan of a waiting task lasts until the end of the wait. The task then gets its slots and thread
back before it continues, even if the wait has timed out. From the end of the wait until then, no
other task can start in these slots. If several tasks on a worker wait for their slots, they get
them back in the order in which their waits ended. Do not hold a `threading.Lock` during a wait,
because a task that borrows the slot may try to acquire it.

A task that waits in another way, for example by calling `Future.done` in a loop, does not lend its
slots. If a task that it has submitted waits for slots in the meantime, all clients receive a
warning.

Slots are lent on the worker, because only the worker counts free slots. For the scheduler, a task
that has lent its slots is still running. Only tasks of partitions lend slots. Other tasks that
occupy a resource keep it, as in plain Dask. Coroutines, and threads that a task has started, do not
lend slots.
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

from ..internals.client import install_wait_hooks, name_submitter_in_coroutines
from ..internals.held_tasks import LOANS
from ..internals.names import CLIENTS, missing_names
from ..internals.partition_client import show_partitions_to_tasks
from ..internals.scheduler import Resources, SubmittingTask, call_worker
from ..internals.worker import (
    count_slots,
    current_task,
    is_running,
    release_slots,
    reserve_slots,
    resources_of,
    seceded_tasks,
    set_resources_to_release,
    submitter_of,
    threads_of,
)

logger = logging.getLogger(__name__)

WARN_AFTER_S = 5.0  # time that a nested task waits for slots before clients are warned
_CHECK_EVERY_S = 1.0  # interval between checks whether the worker still exists
_SECEDED_EVERY_S = 0.2  # interval between checks for tasks that have left or rejoined the threads
_ENDING = (Status.closing, Status.closed, Status.failed)

_lock = threading.Lock()
_lenders: dict[Any, Lender] = {}  # lenders by worker of this process
_thread = threading.local()


@dataclass
class _Loan:
    """Slots that a task lends to other tasks."""

    key: Any  # key of the task
    slots: Resources
    returned: threading.Event = field(default_factory=threading.Event)  # set with the slots back


@dataclass(frozen=True)
class _NestedTask:
    """Nested task that waits for slots on this worker, and the task that has submitted it."""

    submitter: SubmittingTask
    since: float  # time.monotonic()


class Lender:
    """Manages loans of slots on a worker. Methods that change its state run in the event loop."""

    def __init__(self, worker: Any) -> None:
        self.worker = worker
        self.names: set[str] = set()  # partitions whose tasks lend their slots
        self.waiters: set[threading.Event] = set()  # events of threads that lend on demand
        self._nested: dict[Any, _NestedTask] = {}  # nested tasks that wait for slots, by key
        self._loans: Counter[Any] = Counter()  # {task key: number of current loans}
        self._returning: deque[_Loan] = deque()  # loans whose tasks wait to get their slots back
        self._rejoining: set[Any] = set()  # keys of tasks that wait for a thread of the worker
        self._lent: set[Any] = set()  # keys of running tasks that have lent their slots before
        self.lending: set[Any] = set()  # keys of tasks in a `lend` block
        self._seceded: dict[Any, Resources] = {}  # {key of a seceded task: slots that it has lent}
        self._updates_soon = False  # whether an update of `_seceded` is scheduled
        self._warned: set[Any] = set()  # keys of submitting tasks with a warning
        self._next_check: Any = None  # timer handle of the next check

    # -- loans -------------------------------------------------------------------------

    def lend(self, loan: _Loan) -> None:
        """Release the slots of a loan, so that other tasks can use them."""
        self._loans[loan.key] += 1
        self._lent.add(loan.key)
        self._report(loan.key, True)
        release_slots(self.worker, loan.slots)
        self.return_slots()

    def take_back(self, loan: _Loan) -> None:
        """Reclaim the slots of a loan, and set its `returned` event once they are free."""
        self._loans[loan.key] -= 1
        if not self._loans[loan.key]:
            del self._loans[loan.key]
        self._report(loan.key, False)
        reserve_slots(self.worker, loan.slots)
        self._returning.append(loan)
        self.return_slots()

    def begin_rejoin(self, key: Any) -> None:
        """Record that a task has its slots back but still waits for a thread."""
        self._rejoining.add(key)
        self._notify()

    def end_rejoin(self, key: Any) -> None:
        """Record that a waiting task has a thread again."""
        self._rejoining.discard(key)

    def _report(self, key: Any, lent: bool) -> None:
        """Report to the scheduler that a task has lent its slots, or has taken them back."""
        self.worker.log_event(LOANS, {"key": key, "lent": lent})

    def return_slots(self) -> None:
        """Return free slots to waiting tasks in the order in which the tasks asked for them.

        If lending has ended in all partitions, all waiting tasks continue immediately.
        """
        while self._returning and (not self.names or self._are_free(self._returning[0].slots)):
            self._returning.popleft().returned.set()
        self._notify()

    def _are_free(self, slots: Resources) -> bool:
        """Return whether a waiting task can have its slots back.

        The available slots may be negative, because `take_back` has subtracted the slots of all
        waiting tasks. The sum of both is the number of slots that running tasks do not occupy.
        """
        for name, number in slots.items():
            available, total = count_slots(self.worker, name)
            free = available + sum(loan.slots.get(name, 0) for loan in self._returning)
            # The total may be smaller than the loan if the partition has changed.
            if free < min(number, total):
                return False
        return True

    def update_seceded(self) -> None:
        """Let seceded tasks lend their slots on demand, and take slots back from the others.

        A task that has rejoined continues immediately, so its slots are reserved even if they are
        in use.
        """
        self._updates_soon = False
        seceded = {task.key: task for task in seceded_tasks(self.worker)}
        for key in self._seceded.keys() - seceded.keys():
            slots = self._seceded.pop(key)
            task = self.worker.state.tasks.get(key)
            if is_running(self.worker, key):  # otherwise, Dask has released the other resources
                slots = {n: s for n, s in slots.items() if count_slots(self.worker, n)[1]}
                set_resources_to_release(task, {**task.resource_restrictions, **slots})
                reserve_slots(self.worker, slots)
                self._report(key, False)
        if not self.has_slot_requests():
            return
        for key in seceded.keys() - self._seceded.keys() - self.lending:
            task = seceded[key]
            slots = {name: n for name, n in resources_of(task).items() if name in self.names}
            if slots:
                others = {n: s for n, s in task.resource_restrictions.items() if n not in slots}
                set_resources_to_release(task, others)
                self._seceded[key] = slots
                self._report(key, True)
                release_slots(self.worker, slots)

    # -- demand for slots --------------------------------------------------------------

    def has_slot_requests(self) -> bool:
        """Return whether any task waits for new slots, or for the slots or thread that it lent."""
        return bool(self._nested or self._returning or self._rejoining)

    def lends_at_once(self, loan: _Loan) -> bool:
        """Return whether a task must lend its slots whenever it waits, even if nobody needs them.

        This is the case if the task has lent its slots before and the worker has more slots than
        threads. Dask counts a task that has seceded as long-running until it ends, even after it
        has rejoined the worker's threads. Therefore, a nested task may have started in a free slot
        and wait for the thread of this task. It does not wait for slots, so `has_slot_requests`
        does not include it.
        """
        slots = sum(count_slots(self.worker, name)[1] for name in loan.slots)
        return loan.key in self._lent and slots > threads_of(self.worker)

    def _notify(self) -> None:
        """If slots are needed, wake the threads that lend their slots on demand."""
        if self.has_slot_requests():
            for waiter in tuple(self.waiters):
                waiter.set()
        if (self._seceded or self.has_slot_requests()) and not self._updates_soon:
            self._updates_soon = True  # not now, because Dask may be in the middle of a transition
            self.worker.loop.add_callback(self.update_seceded)

    def transition(self, key: Any, finish: str) -> None:
        """Track the state of a task, because tasks in the state "constrained" wait for slots."""
        self._nested.pop(key, None)
        if finish not in ("executing", "long-running"):
            self._lent.discard(key)
        if finish == "constrained" and (submitter := submitter_of(self.worker, key)) is not None:
            self._nested[key] = _NestedTask(submitter, time.monotonic())
            if self._next_check is None:
                self._schedule_check()
        self.return_slots()

    def stop(self) -> None:
        """Forget all waiting tasks and stop the checks, after lending has ended everywhere."""
        self._nested.clear()
        if self._next_check is not None:
            self._next_check.cancel()
            self._next_check = None

    # -- warnings ----------------------------------------------------------------------

    def _schedule_check(self) -> None:
        """Schedule the next check for tasks that have waited too long."""
        loop = asyncio.get_running_loop()
        seconds = min(WARN_AFTER_S / 2, _SECEDED_EVERY_S)
        self._next_check = loop.call_later(seconds, self._check_nested)

    def _check_nested(self) -> None:
        """For each task that has waited too long, check whether its submitter occupies slots.

        A task that secedes again, or rejoins, changes no state of the worker, so this is checked as
        well.
        """
        self._next_check = None
        self.update_seceded()
        looked_at = time.monotonic()
        for key, nested in self._nested.items():
            if (
                looked_at - nested.since >= WARN_AFTER_S
                and nested.submitter.key not in self._warned
            ):
                self._warned.add(nested.submitter.key)
                self.worker.loop.add_callback(self._warn, key, nested.submitter)
        if (self._nested or self._seceded) and self._next_check is None:
            self._schedule_check()
        if not self._nested:
            self._warned.clear()

    def holds_slots(self, key: Any) -> bool:
        """Return whether a task is running on this worker and has not lent its slots."""
        waits = any(loan.key == key for loan in self._returning)
        lends = self._loans[key] or key in self._seceded or waits
        return is_running(self.worker, key) and not lends

    async def _warn(self, key: Any, submitter: SubmittingTask) -> None:
        """Warn all clients if the submitter of a waiting task occupies slots on some worker."""
        try:
            holds = await call_worker(
                self.worker, submitter.worker, _holds_slots, key=submitter.key
            )
        except (OSError, ValueError):  # a worker has left, or the submitter's worker is unknown
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
    """Return whether a task occupies slots on a worker. Runs on that worker."""
    lender = _lenders.get(dask_worker)
    return lender is not None and lender.holds_slots(key)


# -- waits -------------------------------------------------------------------------------


def _loan_of_thread() -> tuple[Lender, _Loan] | None:
    """Return the lender and a new loan for this thread's task, or None if it has no slots."""
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
    """Implementation of `internals.client.WaitHooks`, which Dask's clients call while waiting."""

    def may_lend(self) -> bool:
        """Return whether this thread's task has slots to lend."""
        return _loan_of_thread() is not None

    def wait_until_wanted(self, answer: concurrent.futures.Future[Any]) -> None:
        """Wait until a call has been answered or another task needs this task's slots."""
        loan_of_task = _loan_of_thread()
        if loan_of_task is None:
            return
        lender, loan = loan_of_task
        waiter = threading.Event()
        answer.add_done_callback(lambda _: waiter.set())
        lender.waiters.add(waiter)
        try:
            # The worker's event loop records a demand before it sets the waiters. Since this thread
            # adds its waiter before it checks the demand, no demand is missed.
            while not (waiter.is_set() or lender.has_slot_requests() or lender.lends_at_once(loan)):
                waiter.wait(_CHECK_EVERY_S)
                if lender.worker.status is Status.closed:
                    return
        finally:
            lender.waiters.discard(waiter)

    @contextmanager
    def lend(self, waits: bool = True) -> Iterator[None]:
        """If `waits` is true, lend the slots and thread of the current task within the block.

        At the end of the block, the thread waits until the task has its slots and thread back.
        """
        loan_of_task = _loan_of_thread() if waits else None
        if loan_of_task is None:
            yield
            return
        lender, loan = loan_of_task
        worker = lender.worker
        _thread.in_loan = True
        lender.lending.add(loan.key)  # before the thread leaves, which `update_seceded` detects
        has_thread = False
        # After `worker_client`, or in a custom executor, the task does not occupy a worker thread.
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
            # The task rejoins only after its slots are back, because tasks that have borrowed the
            # slots need the worker's threads to finish. While it waits for a thread, other waiting
            # tasks lend theirs. If the worker is closing, its threads end and there are none left.
            if has_thread and worker.status not in _ENDING:
                worker.loop.add_callback(lender.begin_rejoin, loan.key)
                rejoin()
                worker.loop.add_callback(lender.end_rejoin, loan.key)
            lender.lending.discard(loan.key)


WAIT_HOOKS = _WaitHooks()


# -- enabling and disabling --------------------------------------------------------------


def begin_lending(worker: Any, name: str) -> Lender:
    """Let a partition's tasks lend their slots. Runs in the worker's event loop."""
    with _lock:
        install_wait_hooks(WAIT_HOOKS)
        name_submitter_in_coroutines()
        if not missing_names(CLIENTS):
            show_partitions_to_tasks()
        lender = _lenders.setdefault(worker, Lender(worker))
    lender.names.add(name)
    return lender


def end_lending(worker: Any, name: str) -> None:
    """Let a partition's tasks keep their slots again. Runs in the worker's event loop."""
    with _lock:
        lender = _lenders[worker]
        lender.names.discard(name)
        if not lender.names:
            del _lenders[worker]
            lender.stop()
        lender.return_slots()


def lending_plugin(name: str) -> bytes:
    """Return a pickled worker plugin that enables lending in a partition until it is removed.

    The plugin also measures the peak memory of the partition's stages (see `peaks.py`).

    A plugin is used because a joining worker receives plugins before its first tasks, whereas a
    request could arrive after them. Workers on which poolpart is not installed ignore the plugin.
    """

    class LendingPlugin(WorkerPlugin):
        # The class is defined in a function so that it is pickled by value.
        lender: Any = None
        peaks: Any = None

        def setup(self, worker: Any) -> None:
            try:
                from poolpart.extras.lending import begin_lending
                from poolpart.extras.peaks import PeakMemory
                from poolpart.internals.names import NESTED, missing_names
            except ImportError:
                return
            if not missing_names(NESTED):  # the worker's version of Dask may differ
                self.lender = begin_lending(worker, name)
                self.peaks = PeakMemory(worker, name)

        def teardown(self, worker: Any) -> None:
            if self.lender is not None:
                from poolpart.extras.lending import end_lending
                from poolpart.registration import forget_registrations

                self.peaks.stop()
                end_lending(worker, name)
                # The scheduler has removed the registrations of all clients for the partition.
                forget_registrations(name)

        def transition(self, key: Any, start: str, finish: str, **kwargs: Any) -> None:
            if self.lender is not None:
                self.lender.transition(key, finish)
                self.peaks.transition(key, start)

    plugin: bytes = dumps(LendingPlugin())
    return plugin
