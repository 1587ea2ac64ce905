"""Errors for tasks whose inputs cannot be unpickled on their worker.

Dask lets such a task wait forever. In an experiment, ``b.submit(use, a.submit(f))``, where the
result of ``f`` could be unpickled only in the process that had made it, never ended, nor did a map
of a map. The worker of ``use`` logs the error, keeps the input in its state "error", and tells the
scheduler that the input has failed. The scheduler ignores this message, because the input is in the
memory of another worker. This module reacts to the message.

A worker fetches several inputs in one request, and if one cannot be unpickled, it reports all of
them. Therefore it is asked to fetch each input alone. Tasks with inputs that it can read are sent
to it again.
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

READ_S = 60.0  # seconds for a worker to fetch an input alone
MAX_ATTEMPTS = 10  # how often a worker fetches an input that it can read alone, but not with others


class UnreadableInputs:
    """The scheduler's side, for the partitions of `names`, which are read each time."""

    def __init__(self, scheduler: Any, names: Set[str]) -> None:
        self.scheduler = scheduler
        self._names = names
        self._rules = MethodRules()
        self._attempts: Counter[tuple[Any, str]] = Counter()  # keys as of `_open`
        # {(key of an input, address of a worker): the question whether the worker can read it}
        self._open: dict[tuple[Any, str], asyncio.Task[None]] = {}
        add_failed_fetch_rule(self._rules, scheduler, self._examine_soon)

    def uninstall(self) -> None:
        """Take the rule back."""
        self._rules.remove_all()

    def _examine_soon(self, task: Any, worker: str) -> None:
        """Ask a worker about an input that it could not fetch, unless it is being asked."""
        question = task.key, worker
        if question not in self._open and self._waiting(task, worker):
            self._open[question] = asyncio.ensure_future(self._examine(task, worker))
            self._open[question].add_done_callback(lambda _: self._open.pop(question))

    def _waiting(self, task: Any, worker: str) -> list[Any]:
        """Return the tasks of partitions that wait on a worker for the result of a task."""
        return [
            waiting
            for waiting in task.dependents
            if waiting.processing_on is not None
            and waiting.processing_on.address == worker
            and requires_any(waiting, self._names)
        ]

    async def _examine(self, task: Any, worker: str) -> None:
        """Let tasks that wait for a result fail if their worker cannot unpickle the result."""
        holder = next(iter(task.who_has)).address
        request = call_worker(self.scheduler, worker, why_unreadable, key=task.key, holder=holder)
        try:
            async with asyncio.timeout(READ_S):
                error = await request
        except (OSError, TimeoutError):  # one of the workers has died, or is busy
            error = ""
        state = self.scheduler.workers.get(worker)
        if state is None:  # Dask runs its tasks elsewhere
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
