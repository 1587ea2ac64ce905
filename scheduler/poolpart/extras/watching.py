"""Move tasks that wait behind others to free slots, and end tasks that exceed their time limit.

Dask assigns a task to a worker before the worker has a free slot. Its work stealing estimates the
load of workers from average running times, and does not know canceled tasks that still run. A short
task can therefore wait for an hour-long one while other workers have free slots. Twice a second,
such tasks are moved to free slots with the protocol of work stealing, in which a worker gives up a
task only if it has not started it.

A task that runs longer than its `timeout_s` fails. Dask does not stop its function, so its worker
is restarted if the function does not return (see `cancelling.free_worker`). A task whose client was
killed is canceled, and its function may hang as well. Its limit is then measured from the
cancellation.

The scheduler learns from heartbeats which tasks a worker runs, and since when. Workers in a small
cluster send two heartbeats per second. If a task may have exceeded its limit according to the last
heartbeat, the scheduler asks the worker. A worker that does not respond may be blocked by any of
its tasks, and may have finished others without being able to report it. It is restarted, and all of
its tasks run again, each on a worker of its own. A task fails if it was alone on its worker, or if
it may have blocked more than three workers.
"""

from __future__ import annotations

import asyncio
import heapq
import logging
import time
from collections import Counter
from collections.abc import Coroutine, Iterable, Iterator, Set
from contextlib import contextmanager
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
from ..shares import NAME as SHARES
from .cancelling import ANSWER_S, await_end, free_worker, request_load

logger = logging.getLogger(__name__)

WATCH_S = 0.5  # interval between checks
LATE_S = 0.9  # time after which a task that waits on a worker is moved to a free slot
SILENT_S = 5.0  # time without a heartbeat after which unreported tasks may be running
PATIENCE_S = 60.0  # time for other tasks to finish before a hung worker is restarted
RETRY_S = 15.0  # interval between attempts to restart a hung worker
MOST_BLOCKED = 3  # a task fails if it may have blocked more workers, even if it was not alone
_ENDED = "memory", "erred", "released", "forgotten"  # states of tasks


class TaskWatch:
    """Periodic checks of all tasks in the partitions `names`, a set that the caller updates."""

    def __init__(self, scheduler: Any, names: Set[str]) -> None:
        self.scheduler = scheduler
        self._names = names
        # {task: (worker on which it waits, time.monotonic() when this was first seen)}
        self._waiting: dict[Any, tuple[Any, float]] = {}
        self._tried: dict[Any, set[Any]] = {}  # {waiting task: workers on which it has waited}
        self._ending: set[tuple[Any, Any]] = set()  # (worker, key) of tasks beyond their limit
        self._failed: dict[Any, set[Any]] = {}  # {worker: keys of these tasks that have not ended}
        self._asked: set[Any] = set()  # workers that are being asked which tasks they run
        self._blocked: Counter[Any] = Counter()  # {task: workers that it may have blocked}
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
            self._end_canceled_tasks(name, members)
            for worker in members:
                # Dask attributes a stolen task to its first worker. Where many tasks wait, this
                # does not matter.
                if len(worker.processing) <= 2 * worker.resources[name]:
                    recount_used_resources(worker)
            free = {worker: _free_slots(worker, name) for worker in members}
            free = {worker: slots for worker, slots in free.items() if slots > 0}
            shares = self.scheduler.plugins.get(SHARES)
            usable = {
                worker: slots
                for worker, slots in free.items()
                if worker in self.scheduler.running
                and not (shares is not None and shares.keeps_free(worker))
            }
            if usable:
                self._move_late_tasks(name, members, usable, waiting)
        self._tried = {task: at for task, at in self._tried.items() if task in self._waiting}
        for task in [task for task in self._blocked if task.state in _ENDED]:
            del self._blocked[task]

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
            for task, seconds in list(worker.executing.items()):
                if self._is_late(name, worker, task, seconds):
                    self._end_soon(name, worker, task, seconds)
            if worker not in self._asked and self._possibly_late(name, worker):
                self._asked.add(worker)
                self._start(self._ask(name, worker))

    def _possibly_late(self, name: str, worker: Any) -> dict[Any, float]:
        """Return tasks that may be late if nothing has changed since the last heartbeat.

        The result maps each task to the number of seconds for which it may have been running.
        """
        silent_s = time.time() - worker.last_seen
        running = {task: seconds + silent_s for task, seconds in worker.executing.items()}
        # A task may have started after the last heartbeat, and the worker may have been unable to
        # report that the tasks before it have finished.
        if silent_s > SILENT_S:
            for task in worker.processing - running.keys():
                running[task] = silent_s - SILENT_S
        return {t: s for t, s in running.items() if self._is_late(name, worker, t, s)}

    def _is_late(self, name: str, worker: Any, task: Any, seconds: float) -> bool:
        limit_s = (task.annotations or {}).get(TIMEOUT)
        return (
            limit_s is not None
            and seconds > limit_s
            and task.processing_on is worker
            and (worker, task.key) not in self._ending
            and bool(slots_of(task, name))
        )

    def _end_canceled_tasks(self, name: str, members: Iterable[Any]) -> None:
        """Restart workers whose canceled tasks have run beyond their limits."""
        shares = self.scheduler.plugins.get(SHARES)
        if shares is None or not shares.canceled:
            return
        now = time.monotonic()
        for worker in members:
            canceled = shares.canceled.get(worker, {})
            for key, (limits, since) in [*canceled.items()]:
                if now - since > limits[TIMEOUT]:
                    del canceled[key]
                    self._start(self._end_canceled(name, worker, key, limits, since))
            if not canceled:
                shares.canceled.pop(worker, None)

    async def _end_canceled(
        self, name: str, worker: Any, key: Any, annotations: Any, since: float
    ) -> None:
        """Restart a worker if the function of a canceled task is still running there."""
        load = await request_load(self.scheduler, worker)
        task = self.scheduler.tasks.get(key)
        if task is not None and task.processing_on is worker:  # it was submitted again
            return
        if load is None:
            seconds = time.monotonic() - since
        elif key in load.running:
            seconds = load.running[key]
        else:
            return
        error = _timeout_error(key, worker, seconds, annotations)
        with self._failing(worker, key):
            await self._end_function(name, worker, key, annotations, error)

    async def _ask(self, name: str, worker: Any) -> None:
        """Ask a worker about tasks that may have exceeded their limits since its last heartbeat."""
        try:
            load = await request_load(self.scheduler, worker)
            if load is None:
                await self._free_blocked(name, worker)
                return
            for key, seconds in load.running.items():
                task = self.scheduler.tasks.get(key)
                if task is not None and self._is_late(name, worker, task, seconds):
                    self._end_soon(name, worker, task, seconds)
        finally:
            self._asked.discard(worker)

    async def _free_blocked(self, name: str, worker: Any) -> None:
        """Restart a worker that does not respond, and let a task fail if it is the only cause."""
        late = self._possibly_late(name, worker)
        assigned = [*worker.processing]
        reported = [task for task in late if task in worker.executing or task in self._blocked]
        is_alone = len(assigned) == 1
        causes = [t for t in reported if is_alone or self._blocked[t] >= MOST_BLOCKED]
        if causes:
            for task in causes:
                self._end_soon(name, worker, task, late[task])
        elif late:
            shares = self.scheduler.plugins.get(SHARES)
            for task in assigned:
                if shares is not None:
                    shares.isolate(task.key)
            candidates = {task.key for task in running_candidates(worker)}
            outcome = await self._free(name, worker, set(), candidates)
            if outcome.startswith("restarted") or not worker.nanny:
                self._blocked.update(assigned)
                keys = {task.key for task in assigned}
                logger.warning("One of the tasks %s blocks its worker (%s).", keys, outcome)

    def _end_soon(self, name: str, worker: Any, task: Any, seconds: float) -> None:
        error = _timeout_error(task.key, worker, seconds, task.annotations)
        ending = worker, task.key
        self._ending.add(ending)
        request = self._start(self._end(name, worker, task, error))
        request.add_done_callback(lambda _: self._ending.discard(ending))

    async def _end(self, name: str, worker: Any, task: Any, error: TaskTimeoutError) -> None:
        """Let a task fail, and restart its worker if the function does not return."""
        with self._failing(worker, task.key):
            has_ended = await self._fail(worker, task, error)
            if not has_ended:
                await self._end_function(name, worker, task.key, task.annotations, error)

    @contextmanager
    def _failing(self, worker: Any, key: Any) -> Iterator[None]:
        """Record that a task has ended for the scheduler, while its function may be running."""
        failed = self._failed.setdefault(worker, set())
        failed.add(key)
        try:
            yield
        finally:
            failed.discard(key)
            if not failed:
                self._failed.pop(worker, None)

    async def _fail(self, worker: Any, task: Any, error: TaskTimeoutError) -> bool:
        """Let a task fail, and return whether its function has returned soon afterwards."""
        key = task.key
        was_running = worker in self.scheduler.running  # rather than paused
        is_silent = time.time() - worker.last_seen > SILENT_S
        if was_running:
            stop_assigning(self.scheduler, worker)  # a further run starts elsewhere
        try:
            fail_task(self.scheduler, task, worker.address, error)
            if is_silent:  # other tasks would wait for it
                return await await_end(self.scheduler, worker, key, ANSWER_S)
        finally:
            if was_running:
                resume_assigning(self.scheduler, worker)
        return await await_end(self.scheduler, worker, key, ANSWER_S)

    async def _end_function(
        self, name: str, worker: Any, key: Any, annotations: Any, error: TaskTimeoutError
    ) -> None:
        """Restart a worker whose function has not returned, as soon as this is possible."""
        earlier = ""
        has_ended = False
        while not has_ended:
            candidates = {candidate.key for candidate in running_candidates(worker)} | {key}
            patience_s = 0.0 if earlier else PATIENCE_S
            outcome = await self._free(name, worker, self._failed[worker], candidates, patience_s)
            if outcome != earlier:
                logger.warning("%s Its function did not return (%s).", error, outcome)
            earlier = outcome
            if outcome.startswith("restarted"):
                fail_pipes_of_killed_task(self.scheduler, key, annotations)
                return
            has_ended = await await_end(self.scheduler, worker, key, RETRY_S)

    async def _free(
        self,
        name: str,
        worker: Any,
        ended: set[Any],
        candidates: set[Any],
        patience_s: float = 0.0,
    ) -> str:
        """Restart a worker. Its results may be computed again only if it does not respond."""
        return await free_worker(
            self.scheduler,
            worker,
            name,
            ended,
            candidates,
            recompute_if_silent=True,
            patience_s=patience_s,
        )

    def _start(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a coroutine until it ends or the scheduler closes."""
        request = asyncio.ensure_future(coroutine)
        self._requests.add(request)
        request.add_done_callback(self._requests.discard)
        return request


def _timeout_error(key: Any, worker: Any, seconds: float, annotations: Any) -> TaskTimeoutError:
    return TaskTimeoutError(
        f"Task {key!r} ran for {seconds:.1f} s on worker {worker.name}. Its limit is "
        f"{annotations[TIMEOUT]:g} s (`timeout_s`)."
    )


def slots_of(task: Any, name: str) -> float:
    """Return how many slots of a partition a task occupies."""
    return float((task.resource_restrictions or {}).get(name, 0))


def _free_slots(worker: Any, name: str) -> float:
    """Return how many slots of a worker are free, as far as the scheduler knows."""
    total = float(worker.resources[name])
    if len(worker.processing) >= total:  # a quick check, because each task occupies a slot
        return 0.0
    return total - sum(slots_of(task, name) for task in worker.processing)
