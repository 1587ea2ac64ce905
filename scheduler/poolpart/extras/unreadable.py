"""Raise errors for tasks whose inputs cannot be unpickled on their worker.

In plain Dask, such a task waits forever, for example in ``b.submit(use, a.submit(f))`` if the
result of ``f`` can only be unpickled in the process that created it, or in a map over a map. The
worker of ``use`` logs the error, keeps the input in the state "error", and reports to the scheduler
that the input has failed. The scheduler ignores the report, because the input is in the memory of
another worker. This module handles the report.

A worker fetches several inputs in one request. If one of them cannot be unpickled, it reports all
of them as failed. Therefore, the worker is asked to fetch each input individually. Tasks whose
inputs are readable are sent to the worker again.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Set
from typing import Any

from ..errors import PoolError
from ..internals.method_rules import MethodRules, add_failed_fetch_rule
from ..internals.scheduler import call_worker, fail_task, requires_any, reschedule_tasks
from ..internals.worker import why_unreadable

READ_S = 60.0  # time for a worker to fetch an input individually
MAX_ATTEMPTS = 10  # maximum attempts for an input that is only readable individually


class UnreadableInputs:
    """Scheduler rule that handles reports about unreadable inputs.

    `names` are the names of the partitions, a set that the caller updates.
    """

    def __init__(self, scheduler: Any, names: Set[str]) -> None:
        self.scheduler = scheduler
        self._names = names
        self._rules = MethodRules()
        self._attempts: Counter[tuple[Any, str]] = Counter()  # {(input key, worker address): count}
        # {(input key, worker address): request whether the worker can read the input}
        self._open: dict[tuple[Any, str], asyncio.Task[None]] = {}
        add_failed_fetch_rule(self._rules, scheduler, self._examine_soon)

    def uninstall(self) -> None:
        """Remove the rule from the scheduler."""
        self._rules.remove_all()

    def _examine_soon(self, task: Any, worker: str) -> None:
        """Examine an input that a worker could not fetch, unless this is already being done."""
        request = task.key, worker
        if request not in self._open and self._waiting(task, worker):
            self._open[request] = asyncio.ensure_future(self._examine(task, worker))
            self._open[request].add_done_callback(lambda _: self._open.pop(request))

    def _waiting(self, task: Any, worker: str) -> list[Any]:
        """Return a partition's tasks on a worker that wait for the result of another task."""
        return [
            waiting
            for waiting in task.dependents
            if waiting.processing_on is not None
            and waiting.processing_on.address == worker
            and requires_any(waiting, self._names)
        ]

    async def _examine(self, task: Any, worker: str) -> None:
        """Make tasks fail if their worker cannot unpickle a result for which they wait."""
        holder = next(iter(task.who_has)).address
        request = call_worker(self.scheduler, worker, why_unreadable, key=task.key, holder=holder)
        try:
            async with asyncio.timeout(READ_S):
                error = await request
        except (OSError, TimeoutError):  # one of the workers has died, or is busy
            error = ""
        state = self.scheduler.workers.get(worker)
        if state is None:  # Dask runs the tasks of the lost worker elsewhere
            return
        waiting = self._waiting(task, worker)
        self._attempts[task.key, worker] += 1
        if not error and self._attempts[task.key, worker] < MAX_ATTEMPTS:
            reschedule_tasks(self.scheduler, waiting)
            return
        del self._attempts[task.key, worker]
        for dependent in waiting:
            reason = error or "the worker log contains the error"
            message = (
                f"Task {dependent.key!r} cannot run, because worker {state.name} cannot unpickle "
                f"the result of task {task.key!r}: {reason}. Return plain data, or install the "
                "module that defines the result on all workers."
            )
            fail_task(self.scheduler, dependent, worker, PoolError(message))
