"""Move tasks that wait behind others to free slots, and end tasks that exceed their time limit.

Dask assigns a task to a worker before the worker has a free slot. Its work stealing estimates the
load of workers from average running times, and does not know canceled tasks that still run. A short
task can therefore wait for an hour-long one while other workers have free slots. Twice a second,
such tasks are moved to free slots with the protocol of work stealing, in which a worker gives up a
task only if it has not started it.

A task that runs longer than its `timeout_s` fails. Dask does not stop its function, so its worker
is restarted if the function does not return (see `cancelling.free_worker`).

The scheduler learns from heartbeats which tasks a worker runs, and since when. Workers in a small
cluster send two heartbeats per second.
"""

from __future__ import annotations

import asyncio
import heapq
import logging
import time
from collections.abc import Iterable, Set
from typing import Any

from ..errors import TaskTimeoutError
from ..internals.placing import workers_declaring
from ..internals.scheduler import (
    accepts_moves,
    fail_task,
    move_task,
    recount_used_resources,
    reported_tasks,
    resume_assigning,
    running_candidates,
    stop_assigning,
)
from ..limits import TIMEOUT
from ..pipe_states import fail_pipes_of_killed_task
from .cancelling import ANSWER_S, await_end, free_worker

logger = logging.getLogger(__name__)

WATCH_S = 0.5  # interval between checks
LATE_S = 0.9  # time after which a task that waits on a worker is moved to a free slot
SILENT_S = 5.0  # time without a heartbeat after which a worker is assumed to be blocked by a task
PATIENCE_S = 60.0  # time for other tasks to finish before a hung worker is restarted


class TaskWatch:
    """Periodic checks of all tasks in the partitions `names`, a set that the caller updates."""

    def __init__(self, scheduler: Any, names: Set[str]) -> None:
        self.scheduler = scheduler
        self._names = names
        # {task: (worker on which it waits, time.monotonic() when this was first seen)}
        self._waiting: dict[Any, tuple[Any, float]] = {}
        self._tried: dict[Any, set[Any]] = {}  # {waiting task: workers on which it has waited}
        self._ending: set[tuple[Any, Any]] = set()  # (worker, key) of tasks beyond their limit
        self._requests: set[asyncio.Task[None]] = set()
        self._loop = asyncio.ensure_future(self._run())

    def uninstall(self) -> None:
        """Stop all checks. Workers that are being restarted are not affected."""
        self._loop.cancel()

    def close(self) -> None:
        """Stop everything when the scheduler closes."""
        for task in (self._loop, *self._requests):
            task.cancel()

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(WATCH_S)
            try:
                self._check()
            except Exception:  # later checks may succeed
                logger.exception("The tasks of partitions %s were not checked.", self._names)

    def _check(self) -> None:
        waiting = self._waiting
        self._waiting = {}
        for name in self._names:
            members = workers_declaring(self.scheduler, name)
            self._end_late_tasks(name, members)
            for worker in members:
                # Dask attributes a stolen task to its first worker. Where many tasks wait, this
                # does not matter.
                if len(worker.processing) <= 2 * worker.resources[name]:
                    recount_used_resources(worker)
            free = {worker: _free_slots(worker, name) for worker in members}
            free = {worker: slots for worker, slots in free.items() if slots > 0}
            usable = {worker: n for worker, n in free.items() if worker in self.scheduler.running}
            if usable:
                self._move_late_tasks(name, members, usable, waiting)
        self._tried = {task: at for task, at in self._tried.items() if task in self._waiting}

    # -- waiting tasks -----------------------------------------------------------------

    def _move_late_tasks(
        self,
        name: str,
        members: Iterable[Any],
        free: dict[Any, float],
        before: dict[Any, tuple[Any, float]],
    ) -> None:
        """Move tasks that have been waiting for a while to free slots of other workers."""
        now = time.monotonic()
        late = []
        for worker in members:
            for task in self._stuck_tasks(worker, name):
                if before.get(task, (None, 0.0))[0] is not worker:
                    self._waiting[task] = worker, now
                else:
                    self._waiting[task] = before[task]
                    if now - before[task][1] >= LATE_S:
                        late.append(task)
        for task in heapq.nsmallest(int(sum(free.values())), late, key=lambda t: t.priority):
            self._move(task, name, free)

    def _stuck_tasks(self, worker: Any, name: str) -> list[Any]:
        """Return tasks that a worker has not started, unless it waits for their inputs."""
        if not worker.processing:
            return []
        reported = reported_tasks(worker)
        held = sum(slots_of(task, name) for task in reported - worker.long_running)
        blocked = worker not in self.scheduler.running or held >= worker.resources[name]
        return [
            task
            for task in worker.processing - reported
            if slots_of(task, name)
            and (blocked or all(worker in (i.who_has or ()) for i in task.dependencies))
        ]

    def _move(self, task: Any, name: str, free: dict[Any, float]) -> None:
        """Move a task to a worker with free slots on which it has not waited yet."""
        worker = task.processing_on
        tried = self._tried.setdefault(task, set())
        tried.add(worker)
        slots = slots_of(task, name)
        permitted = self.scheduler.valid_workers(task)
        others = [
            other
            for other, number in free.items()
            if number >= slots and other not in tried and (permitted is None or other in permitted)
        ]
        if not others or not accepts_moves(self.scheduler, task):
            return
        target = max(others, key=free.__getitem__)
        free[target] -= slots
        move_task(self.scheduler, task, target)

    # -- time limits -------------------------------------------------------------------

    def _end_late_tasks(self, name: str, members: Iterable[Any]) -> None:
        """Let tasks fail that have been running longer than their limit."""
        for worker in members:
            silent_s = time.time() - worker.last_seen
            for task, seconds in list(worker.executing.items()):
                self._check_limit(name, worker, task, seconds + silent_s)
            if silent_s > SILENT_S:  # a task may have started after the last heartbeat
                for task in running_candidates(worker) - worker.executing.keys():
                    self._check_limit(name, worker, task, silent_s - SILENT_S)

    def _check_limit(self, name: str, worker: Any, task: Any, seconds: float) -> None:
        limit_s = (task.annotations or {}).get(TIMEOUT)
        if limit_s is None or seconds <= limit_s or task.processing_on is not worker:
            return
        if (worker, task.key) in self._ending or not slots_of(task, name):
            return
        error = TaskTimeoutError(
            f"Task {task.key!r} ran for {seconds:.1f} s on worker {worker.name}. Its limit is "
            f"{limit_s:g} s (`timeout_s`)."
        )
        ending = worker, task.key
        self._ending.add(ending)
        request = asyncio.ensure_future(self._end(name, worker, task, error))
        self._requests.add(request)
        request.add_done_callback(self._requests.discard)
        request.add_done_callback(lambda _: self._ending.discard(ending))

    async def _end(self, name: str, worker: Any, task: Any, error: TaskTimeoutError) -> None:
        """Let a task fail, and restart its worker if the function does not return."""
        key = task.key
        annotations = task.annotations
        candidates = {candidate.key for candidate in running_candidates(worker)}
        was_running = worker in self.scheduler.running  # rather than paused
        is_silent = time.time() - worker.last_seen > SILENT_S
        if is_silent and len(worker.processing) > 1 and not task.suspicious:
            # Another task may be running, if the report that this one has finished is delayed.
            # Therefore, the task fails only if this happens again.
            task.suspicious += 1
            await free_worker(self.scheduler, worker, name, candidates, candidates)
            return
        if was_running:
            stop_assigning(self.scheduler, worker)  # a further run starts elsewhere
        fail_task(self.scheduler, task, worker.address, error)
        if was_running and not is_silent:
            resume_assigning(self.scheduler, worker)
        has_ended = await await_end(self.scheduler, worker, key, ANSWER_S)
        if was_running and is_silent:
            resume_assigning(self.scheduler, worker)
        if not has_ended:
            outcome = await free_worker(
                self.scheduler, worker, name, {key}, candidates, patience_s=PATIENCE_S
            )
            logger.warning("%s Its function did not return (%s).", error, outcome)
            if outcome.startswith("restarted"):
                fail_pipes_of_killed_task(self.scheduler, key, annotations)


def slots_of(task: Any, name: str) -> float:
    """Return how many slots of a partition a task occupies."""
    return float((task.resource_restrictions or {}).get(name, 0))


def _free_slots(worker: Any, name: str) -> float:
    """Return how many slots of a worker are free, as far as the scheduler knows."""
    total = float(worker.resources[name])
    if len(worker.processing) >= total:  # a quick check, because each task occupies a slot
        return 0.0
    return total - sum(slots_of(task, name) for task in worker.processing)
