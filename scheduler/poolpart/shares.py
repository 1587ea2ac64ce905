"""Let the clients of a partition take turns, by holding tasks back until a slot is free.

Dask assigns a task that requests a resource to a worker as soon as its inputs are available, so a
client that submits 1,000 tasks would be served before all clients that follow. In a partition, the
scheduler keeps such tasks in the state "no-worker" instead, until a worker has room for another
task (`share_policy.has_room`). Then `SharePolicy` decides which client is next. The tasks of one
client are assigned in Dask's order, which includes their priorities.

The priority of an assigned task begins with a number that increases with each assignment, so that
its worker runs tasks in this order as well. It restarts with the original priority if it has to be
assigned again.

A task counts for the client that was the first to submit it, and a nested task for the client of
the task that has submitted it. Clients with the same name are the same client.

A task that waits for a nested task only lends its slots if the nested task waits on the same
worker (see `extras.lending`). Therefore, one nested task more than there are slots may be assigned
to the worker of the task that has submitted it. The same applies to tasks that are bound to
workers, because they could not use a slot of another worker in the meantime. These are called tied
tasks in this module.

A task with the annotation `MEMORY` is only assigned to a worker whose other assigned tasks leave
enough of its memory limit. If the task whose turn it is needs more memory than is free, the worker
with the most free memory is reserved: other tasks that hold memory are not assigned to it until
the first one is. The memory of a task that has lent its slots can only be used by nested tasks. All
of this is part of the scheduler's `valid_workers`, so that it also applies to tasks that are moved.

A task that may have blocked its worker is assigned to a worker without other tasks (`isolate`). If
there is none, one worker gets no further tasks until its tasks have ended.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import math
import time
from collections.abc import Collection, Iterable, Mapping, Set
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from distributed.diagnostics.plugin import SchedulerPlugin

from .errors import PoolError
from .features import FEATURES, Feature
from .internals.held_tasks import (
    LOANS,
    add_holding_rules,
    assign_held_tasks,
    hold_task,
    priority_of_assigned,
    priority_of_waiting,
    refresh_waiting_times,
)
from .internals.method_rules import MethodRules, workers_without_fences
from .internals.names import SHARES, require_feature
from .internals.placing import (
    can_run,
    earliest_worker,
    holders_of_inputs,
    memory_limit,
    workers_declaring,
)
from .internals.scheduler import SUBMITTER, SubmittingTask, is_moving
from .limits import TIMEOUT, memory_of
from .partition_stats import ClientStats
from .share_policy import SharePolicy, has_room

NAME = "poolpart-shares"
CHECK_EVERY_S = 0.5  # interval between checks for tasks that run longer than expected
MAX_COMPARED = 10  # number of workers that are compared for a task
MAX_HOLDERS = 50  # number of copies of inputs that are considered for a task
_UUID_LETTERS = 36
_ALONE_S = 3600.0  # expected slot time of a task behind which no other tasks are assigned


class _Bounds(NamedTuple):
    """What restricts the workers of a task, apart from its partition."""

    is_tied: bool = False  # whether the task is nested or bound to workers
    is_isolated: bool = False  # whether the task requires a worker without other tasks
    workers: frozenset[str] | None = None
    hosts: frozenset[str] | None = None
    memory: int = 0  # memory that it holds, in bytes

    @property
    def is_restricted(self) -> bool:
        """Whether some workers of the partition may not be valid."""
        return bool(self.workers or self.hosts or self.memory)

    @property
    def needs_no_room(self) -> bool:
        """Whether the task may be assigned to a worker that has no room for others."""
        return self.is_tied or self.is_isolated


_ANY_WORKER = _Bounds()


@dataclass(slots=True)
class _HeldTask:
    """Task that waits on the scheduler."""

    client: str
    bounds: _Bounds
    since: float  # time.monotonic()
    task: Any


class _Reservation(NamedTuple):
    """Worker that is kept for a held task."""

    worker: Any
    key: Any  # of the task


@dataclass(slots=True)
class _Assignment:
    """Task that is assigned to a worker, with its contribution to the load of the worker."""

    worker: Any
    slots: float
    seconds: float  # expected slot time
    is_tied: bool
    memory: int = 0  # in bytes
    is_lent: bool = False


@dataclass(slots=True)
class _Load:
    """Slots and memory that the assigned tasks of a worker request."""

    used: float = 0.0
    tied: float = 0.0  # slots that tied tasks request, which are included in `used`
    seconds: float = 0.0  # expected slot time of the tasks
    free: float = 0.0  # number of slots without a task
    memory: int = 0  # in bytes, without tasks that have lent their slots
    lent_memory: int = 0  # in bytes, of tasks that have lent their slots


@dataclass
class PartitionQueue:
    """Tasks of a partition that wait on the scheduler, and the load of its workers."""

    name: str
    policy: SharePolicy = field(default_factory=SharePolicy)
    held: dict[Any, _HeldTask] = field(default_factory=dict)  # by key
    # {client: {bounds: heap of (priority, number, key)}}. Entries of other tasks are skipped.
    heaps: dict[str, dict[_Bounds, list[tuple[Any, int, Any]]]] = field(default_factory=dict)
    pushed: int = 0  # number of entries that were added to the heaps
    assigned: dict[Any, _Assignment] = field(default_factory=dict)  # by key
    loads: dict[Any, _Load] = field(default_factory=dict)  # by worker
    # Workers that have room for a task, starting with the one that has had room the longest.
    with_room: dict[Any, None] = field(default_factory=dict)
    reserved: _Reservation | None = None  # other tasks do not get memory of the worker
    cleared: _Reservation | None = None  # no other task is assigned to the worker
    held_without_room: int = 0  # number of tasks among `held` that need no room
    free_slots: float = 0.0  # number of slots without a task
    _idle_s: float = 0.0  # time until the last change for which slots had no task, times slots
    _changed_at: float = field(default_factory=time.monotonic)  # last change of `free_slots`

    # -- workers -----------------------------------------------------------------------

    def update_worker(self, worker: Any) -> None:
        """Determine whether a worker has room, after its load or its slots have changed."""
        slots = worker.resources.get(self.name, 0)
        load = self.loads.get(worker)
        if load is None:
            if not slots:
                self.with_room.pop(worker, None)
                return
            load = self.loads[worker] = _Load()
        # One tied task may wait in addition. Otherwise, tied tasks would keep tasks of others off
        # the worker.
        used = load.used - min(load.tied, 1) if load.tied else load.used
        had_room = worker in self.with_room
        is_cleared = self.cleared is not None and self.cleared.worker is worker
        room = slots and not is_cleared and has_room(slots, used, load.seconds, had_room)
        if bool(room) != had_room:
            if had_room:
                del self.with_room[worker]
            else:
                self.with_room[worker] = None
        if load.free or load.used < slots:
            self._set_free(load, max(0.0, slots - load.used))

    def forget_worker(self, worker: Any) -> None:
        """Forget a worker that has left. Its tasks have been released before."""
        if load := self.loads.pop(worker, None):
            self._set_free(load, 0.0)
        self.with_room.pop(worker, None)
        if self.cleared is not None and self.cleared.worker is worker:
            self.cleared = None

    def clear_worker(self, worker: Any, key: Any) -> None:
        """Keep further tasks off a worker until a held task has it for itself."""
        self._end_clearing()
        self.cleared = _Reservation(worker, key)
        self.update_worker(worker)

    def _end_clearing(self) -> None:
        if self.cleared is not None:
            worker = self.cleared.worker
            self.cleared = None
            self.update_worker(worker)

    def _set_free(self, load: _Load, slots: float) -> None:
        if slots != load.free:
            self._idle_s = self.idle_s()
            self._changed_at = time.monotonic()
            self.free_slots += slots - load.free
            load.free = slots

    def idle_s(self) -> float:
        """Return the total time for which slots had no task, times the number of these slots."""
        return self._idle_s + self.free_slots * (time.monotonic() - self._changed_at)

    def assign(self, key: Any, assignment: _Assignment) -> None:
        """Add a task to the load of its worker."""
        self.assigned[key] = assignment
        self._add_load(assignment, 1)

    def unassign(self, key: Any) -> Any:
        """Remove a task from the load of its worker, which is returned."""
        assignment = self.assigned.pop(key)
        self._add_load(assignment, -1)
        return assignment.worker

    def set_lent(self, key: Any, lent: bool) -> None:
        """Record that a task has lent its slots, or has them back."""
        assignment = self.assigned.get(key)
        if assignment is not None and assignment.is_lent != lent:
            self._add_load(assignment, -1)
            assignment.is_lent = lent
            self._add_load(assignment, 1)

    def move(self, key: Any, worker: Any) -> None:
        """Record that an assigned task was moved to another worker."""
        assignment = self.assigned[key]
        self._add_load(assignment, -1)
        assignment.worker = worker
        self._add_load(assignment, 1)

    def _add_load(self, assignment: _Assignment, sign: int) -> None:
        load = self.loads.get(assignment.worker)
        if load is None:
            load = self.loads[assignment.worker] = _Load()
        if assignment.is_lent:
            load.lent_memory += sign * assignment.memory
            return
        load.memory += sign * assignment.memory
        load.used += sign * assignment.slots
        load.seconds += sign * assignment.seconds
        if assignment.is_tied:
            load.tied += sign * assignment.slots
        self.update_worker(assignment.worker)

    # -- held tasks --------------------------------------------------------------------

    def hold(self, task: Any, held: _HeldTask) -> None:
        """Add a task that waits for a slot."""
        self.held[task.key] = held
        self.held_without_room += held.bounds.needs_no_room
        heap = self.heaps.setdefault(held.client, {}).setdefault(held.bounds, [])
        self.pushed += 1
        heapq.heappush(heap, (task.priority, self.pushed, task.key))
        self.policy.add_waiting(held.client, time.monotonic())

    def release(self, key: Any) -> _HeldTask | None:
        """Remove a task that no longer waits, and return its entry, if any."""
        held = self.held.pop(key, None)
        if held is not None:
            self.held_without_room -= held.bounds.needs_no_room
            if self.reserved is not None and self.reserved.key == key:
                self.reserved = None
            if self.cleared is not None and self.cleared.key == key:
                self._end_clearing()
            if not self.held:
                self.heaps.clear()  # entries of canceled tasks would remain
        return held

    def heads(self, client: str) -> list[_HeldTask]:
        """Return the first task of a client for each kind of bounds, in their order."""
        heaps = self.heaps.get(client, {})
        heads: list[_HeldTask] = []
        for bounds, heap in [*heaps.items()]:
            while heap:
                held = self.held.get(heap[0][2])
                if held is not None and held.client == client and held.bounds == bounds:
                    heads.append(held)
                    break
                heapq.heappop(heap)
            else:
                del heaps[bounds]
        if not heaps:
            self.heaps.pop(client, None)
        if len(heads) > 1:
            heads.sort(key=lambda held: heaps[held.bounds][0])
        return heads


class Shares(SchedulerPlugin):
    """Scheduler plugin that assigns the tasks of partitions to workers."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.queues: dict[str, PartitionQueue] = {}
        self.weights: dict[str, float] = {}
        self._clients: dict[Any, str] = {}  # {task key: name of its client}
        self._assigned_in: dict[Any, PartitionQueue] = {}  # {task key: queue of its partition}
        # {worker: {key of a canceled task with a time limit: (its annotations, time)}}
        self.canceled: dict[Any, dict[Any, tuple[Any, float]]] = {}
        self._isolated: set[Any] = set()  # keys of tasks that must not share a worker
        self._chosen: dict[Any, Any] = {}  # {task that is being assigned: its worker}
        # {task with memory: worker to which it may be moved}
        self._moves: dict[Any, Any] = {}
        self._numbers = itertools.count()  # numbers of assignments
        self._check: asyncio.TimerHandle | None = None
        self._is_dispatch_due = False  # whether a dispatch is scheduled
        self._present: set[str] = set()  # names of connected clients
        self._rules = MethodRules()
        self._update_present()
        scheduler.add_plugin(self)

    def add_partition(self, name: str) -> None:
        """Hold back tasks of a partition from now on."""
        if not self.queues:
            add_holding_rules(
                self._rules,
                self.scheduler,
                choose=self.choose,
                is_held=self._is_held,
                admit=self._admit,
                restrict=self._with_memory,
                record_move=self._record_move,
            )
        queue = self.queues[name] = PartitionQueue(name)
        for client, weight in self.weights.items():
            queue.policy.set_weight(client, weight)
        for worker in workers_declaring(self.scheduler, name):
            for task in worker.processing:
                if name in (task.resource_restrictions or ()):
                    now = time.monotonic()
                    held = _HeldTask(self._client_of(task), self._bounds_of(task), now, task)
                    queue.policy.add_waiting(held.client, now)
                    self._start(queue, held, worker, now)
            queue.update_worker(worker)
        if self._check is None:
            self._schedule_check()

    def remove_partition(self, name: str) -> None:
        """Assign the held tasks of a partition at once, and leave its tasks to Dask."""
        queue = self.queues.pop(name)
        for key in queue.assigned:
            del self._assigned_in[key]
        assign_held_tasks(self.scheduler, [held.task for held in queue.held.values()])
        if not self.queues:
            self._rules.remove_all()
            self._clients.clear()
            if self._check is not None:
                self._check.cancel()
                self._check = None
            if not self.weights:
                self.scheduler.remove_plugin(NAME)

    def set_weight(self, client: str, weight: float) -> None:
        """Set the weight of a client in all partitions."""
        self.weights[client] = weight
        if weight == 1:
            del self.weights[client]
        for queue in self.queues.values():
            queue.policy.set_weight(client, weight)

    # -- clients -----------------------------------------------------------------------

    def update_graph(
        self, scheduler: Any, *, client: str, tasks: Iterable[Any], **kwargs: Any
    ) -> None:
        """Record the client of each new task of a partition."""
        name = client_name(client)
        states = scheduler.tasks
        for key in tasks:
            task = states[key]
            resources = task.resource_restrictions
            if resources and key not in self._clients:
                submitter = submitter_of(task)
                self._clients[key] = (
                    name if submitter is None else self._clients.get(submitter.key, name)
                )

    def isolate(self, key: Any) -> None:
        """Assign a task to a worker of its own from the next time on.

        Nested and bound tasks may have to wait on the same worker as others. They only use all of
        its slots.
        """
        self._isolated.add(key)

    def keeps_free(self, worker: Any) -> bool:
        """Return whether other tasks are kept off a worker because of an isolated task."""
        if not self._isolated:
            return False
        cleared = (queue.cleared for queue in self.queues.values())
        return any(entry is not None and entry.worker is worker for entry in cleared) or any(
            task.key in self._isolated for task in worker.processing
        )

    def client_of_key(self, key: Any) -> str | None:
        """Return the client for which a task counts, or None if the task is unknown."""
        return self._clients.get(key)

    def _client_of(self, task: Any) -> str:
        """Return the client that a task counts for.

        If the client has left, the task counts for another client that wants it.
        """
        client = self._clients.get(task.key)
        if client is not None and (client in self._present or not task.who_wants):
            return client
        wanted_by = sorted(client_name(state.client_key) for state in task.who_wants or ())
        client = next(iter(wanted_by), client or "")
        self._clients[task.key] = client
        return client

    def _update_present(self) -> None:
        self._present = {client_name(client) for client in self.scheduler.clients}

    def add_client(self, scheduler: Any, client: str) -> None:
        """Record that a client has connected."""
        self._update_present()

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Let held tasks of a client that has left count for other clients that want them."""
        self._update_present()
        name = client_name(client)
        if name not in self._present:
            for queue in self.queues.values():
                self._hand_over(queue, name)

    # -- events of the scheduler -------------------------------------------------------

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
        """Update the accounts after a task has ended or no longer waits."""
        if start == "processing":
            if (queue := self._assigned_in.pop(key, None)) is not None:
                self._end(queue, key, finish, kwargs)
        elif start == "no-worker" and finish != "processing":
            for queue in self.queues.values():
                if held := queue.release(key):
                    queue.policy.remove_waiting(held.client)
        if finish == "forgotten":
            self._clients.pop(key, None)
            self._isolated.discard(key)

    def _end(self, queue: PartitionQueue, key: Any, finish: str, report: Mapping[str, Any]) -> None:
        """Charge a client for the time that its task has run."""
        worker = queue.unassign(key)
        lost = worker.address not in self.scheduler.workers
        seconds = None
        if finish in ("memory", "erred"):
            spans = report.get("startstops") or ()
            computing = [s["stop"] - s["start"] for s in spans if s["action"] == "compute"]
            seconds = sum(computing) if computing else None
        now = time.monotonic()
        queue.policy.finish(key, now, seconds, lost=lost)
        if finish == "released" and not lost:
            annotations = self.scheduler.tasks[key].annotations
            if annotations and TIMEOUT in annotations:  # its function may still be running
                self.canceled.setdefault(worker, {})[key] = annotations, now
        if queue.held and (queue.with_room or queue.cleared is not None):
            self._dispatch_soon()

    def log_event(self, topic: str, msg: Any) -> None:
        """Record that a task has lent its slots, or has them back."""
        if topic == LOANS:
            now = time.monotonic()
            for queue in self.queues.values():
                queue.set_lent(msg["key"], msg["lent"])
                (queue.policy.lend if msg["lent"] else queue.policy.take_back)(msg["key"], now)
            if msg["lent"]:
                self._dispatch_soon()

    def _admit(self, worker: Any) -> None:
        """Assign tasks to a worker that has joined, or has received or lost slots."""
        for queue in self.queues.values():
            queue.update_worker(worker)
        self._dispatch_soon()

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Assign tasks to a worker that has joined."""
        self._admit(scheduler.workers[worker])

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Forget a worker that has left."""
        for queue in self.queues.values():
            for state in [state for state in queue.loads if state.address == worker]:
                queue.forget_worker(state)
        for state in [state for state in self.canceled if state.address == worker]:
            del self.canceled[state]

    def restart(self, scheduler: Any) -> None:
        """Forget all tasks after `Client.restart`. Clients keep their weights."""
        self._assigned_in.clear()
        self._isolated.clear()
        for name in [*self.queues]:
            self.add_partition(name)
        self._clients.clear()

    # -- choosing ----------------------------------------------------------------------

    def _is_held(self, task: Any) -> bool:
        return any(task.key in queue.held for queue in self.queues.values())

    def _queue_of(self, task: Any) -> PartitionQueue | None:
        resources = task.resource_restrictions
        if not resources or len(resources) > 1 or task.actor:
            return None
        [(name, slots)] = resources.items()
        return self.queues.get(name) if slots else None

    def choose(self, task: Any) -> Any:
        """Return the worker of a task, None to hold the task, or NotImplemented to let Dask decide.

        Dask calls this rule whenever a task could be assigned to a worker.
        """
        worker = self._chosen.pop(task, None)
        if worker is not None:
            return worker
        queue = self._queue_of(task)
        if queue is None:
            return NotImplemented
        if task.key in queue.held:
            return None
        task.priority = priority_of_waiting(task)
        now = time.monotonic()
        held = _HeldTask(self._client_of(task), self._bounds_of(task), now, task)
        if not queue.held and (worker := self._worker_for(queue, held)) is not None:
            queue.policy.add_waiting(held.client, now)
            self._start(queue, held, worker, now)
            return worker
        queue.hold(task, held)
        if task.state == "waiting":
            hold_task(self.scheduler, task, now)
        if queue.with_room or held.bounds.needs_no_room:
            self._dispatch_soon()
        return None

    def _bounds_of(self, task: Any) -> _Bounds:
        workers, hosts = task.worker_restrictions, task.host_restrictions
        is_tied = bool(workers) or submitter_of(task) is not None
        is_isolated = not is_tied and task.key in self._isolated
        memory = memory_of(task)
        if not (is_tied or is_isolated or hosts or memory):
            return _ANY_WORKER
        return _Bounds(
            is_tied,
            is_isolated,
            frozenset(workers) if workers else None,
            frozenset(hosts) if hosts else None,
            memory,
        )

    def _start(
        self,
        queue: PartitionQueue,
        held: _HeldTask,
        worker: Any,
        now: float,
        passed_over: Collection[str] = (),
    ) -> None:
        """Charge a client for a task, and add the task to the load of a worker."""
        task = held.task
        key = task.key
        bounds = held.bounds
        slots = task.resource_restrictions[queue.name]
        waited_s = now - held.since
        charge = queue.policy.start(
            key, held.client, task.prefix.name, slots, now, waited_s, passed_over
        )
        seconds = slots * charge.expected_s
        if key in self._isolated:
            slots, seconds = worker.resources.get(queue.name, slots), _ALONE_S
        queue.assign(key, _Assignment(worker, slots, seconds, bounds.is_tied, bounds.memory))
        self._assigned_in[key] = queue
        task.priority = priority_of_assigned(self.scheduler, task, next(self._numbers))

    def _worker_for(self, queue: PartitionQueue, held: _HeldTask) -> Any:
        """Return a worker that has room for a task, or None."""
        task = held.task
        bounds = held.bounds
        slots = task.resource_restrictions[queue.name]
        if bounds.is_isolated:
            return self._empty_worker(queue, held)
        allowed = None
        if bounds.is_restricted:
            allowed = self.scheduler.valid_workers(task) or ()
        if queue.with_room:
            worker = self._worker_with_room(queue, task, slots, allowed)
            if worker is not None:
                return worker
        return self._worker_for_tied(queue, task, slots, allowed) if bounds.is_tied else None

    def _worker_with_room(
        self, queue: PartitionQueue, task: Any, slots: float, allowed: Any
    ) -> Any:
        holders = holders_of_inputs(task) if task.dependencies else ()
        if holders and len(holders) <= MAX_HOLDERS:
            candidates = [
                worker
                for worker in holders
                if worker in queue.with_room and (allowed is None or worker in allowed)
            ]
            candidates = [w for w in candidates if can_run(self.scheduler, w, queue.name, slots)]
            if candidates:
                return earliest_worker(self.scheduler, task, candidates)
        free: list[Any] = []
        others: list[Any] = []
        for worker in queue.with_room if allowed is None else allowed:
            if allowed is not None and worker not in queue.with_room:
                continue
            if can_run(self.scheduler, worker, queue.name, slots):
                enough = queue.loads[worker].used + slots <= worker.resources[queue.name]
                (free if enough else others).append(worker)
                if len(free) == MAX_COMPARED:
                    break
                if len(others) == MAX_COMPARED and not queue.free_slots:
                    break
        candidates = free or others[:MAX_COMPARED]
        if len(candidates) <= 1:
            return candidates[0] if candidates else None
        return earliest_worker(self.scheduler, task, candidates)

    def _empty_worker(self, queue: PartitionQueue, held: _HeldTask) -> Any:
        """Return a worker without other tasks, or None after one was chosen that will be."""
        key = held.task.key
        slots = held.task.resource_restrictions[queue.name]
        allowed = self.scheduler.valid_workers(held.task) if held.bounds.is_restricted else None
        candidates = [
            worker
            for worker in queue.loads
            if (allowed is None or worker in allowed)
            and can_run(self.scheduler, worker, queue.name, slots)
        ]
        other = None
        if queue.cleared is not None and queue.cleared.key != key:
            other = queue.cleared.worker
        for worker in candidates:
            # `processing` lacks tasks that are being assigned, and `used` those that lend slots.
            is_empty = not worker.processing and not queue.loads[worker].used
            if is_empty and worker is not other:
                return worker
        if candidates and other is None and key in queue.held:
            loads = queue.loads
            best = min(candidates, key=lambda worker: loads[worker].seconds)
            current = queue.cleared.worker if queue.cleared is not None else None
            if current not in candidates or loads[best].seconds < loads[current].seconds:
                queue.clear_worker(best, key)
        return None

    def _worker_for_tied(self, queue: PartitionQueue, task: Any, slots: float, allowed: Any) -> Any:
        """Return a worker on which a nested or bound task should wait, or None."""
        submitter = submitter_of(task)
        home = self.scheduler.workers.get(submitter.worker) if submitter is not None else None
        loads = queue.loads
        if home in loads and (allowed is None or home in allowed):
            candidates: Iterable[Any] = [home]
        else:
            candidates = loads if allowed is None else [w for w in allowed if w in loads]
        for worker in candidates:
            if loads[worker].tied < worker.resources.get(queue.name, 0) + 1 and can_run(
                self.scheduler, worker, queue.name, slots
            ):
                return worker
        return None

    # -- memory ------------------------------------------------------------------------

    def _with_memory(self, valid: Any, task: Any) -> Any:
        """Return the valid workers of a task that have enough memory for it."""
        memory = memory_of(task)
        queue = self._queue_of(task) if memory else None
        if queue is None:
            return valid
        self._settle_moves()
        is_nested = submitter_of(task) is not None
        valid = {worker for worker in valid if memory <= self._free_memory(worker, is_nested)}
        if queue.reserved is not None and queue.reserved.key != task.key and not is_nested:
            valid.discard(queue.reserved.worker)
        return valid

    def _free_memory(self, worker: Any, is_nested: bool) -> int:
        """Return the memory in bytes that a task could hold on a worker now."""
        free = memory_limit(worker)
        for queue in self.queues.values():
            if (load := queue.loads.get(worker)) is not None:
                free -= load.memory
                if not is_nested:
                    free -= load.lent_memory
        if self._moves:
            free -= sum(memory_of(task) for task, to in self._moves.items() if to is worker)
        return free

    def _record_move(self, result: Any, task: Any, victim: Any, target: Any) -> Any:
        """Record that a worker was asked to give up a task with memory to another worker."""
        if memory_of(task):
            self._moves[task] = target
        return result

    def _settle_moves(self) -> None:
        """Account for the moves that workers have confirmed or rejected."""
        for task in [task for task in self._moves if not is_moving(self.scheduler, task)]:
            del self._moves[task]
            queue = self._assigned_in.get(task.key)
            if queue is not None and task.processing_on is not None:
                queue.move(task.key, task.processing_on)

    def _reserve_memory(self, queue: PartitionQueue, task: Any, memory: int) -> None:
        """Keep the memory of a worker for a task, unless another task has precedence."""
        if queue.reserved is not None or submitter_of(task) is not None:
            return
        slots = task.resource_restrictions[queue.name]
        workers = [
            worker
            for worker in workers_without_fences(self.scheduler, task)
            if memory_limit(worker) >= memory and can_run(self.scheduler, worker, queue.name, slots)
        ]
        if workers:
            best = max(workers, key=lambda worker: self._free_memory(worker, False))
            queue.reserved = _Reservation(best, task.key)

    # -- dispatching -------------------------------------------------------------------

    def _dispatch_soon(self) -> None:
        """Assign tasks after the scheduler has finished its present step."""
        if not self._is_dispatch_due:
            self._is_dispatch_due = True
            asyncio.get_running_loop().call_soon(self.dispatch)

    def dispatch(self) -> None:
        """Assign held tasks to workers with room, as long as there are both."""
        self._is_dispatch_due = False
        for queue in self.queues.values():
            if queue.held and (queue.with_room or queue.held_without_room):
                self._dispatch_from(queue)

    def _dispatch_from(self, queue: PartitionQueue) -> None:
        chosen: list[Any] = []
        now = time.monotonic()
        while queue.held and (queue.with_room or queue.held_without_room):
            queue.reserved = None
            found = self._next_task(queue)
            if found is None:
                break
            held, worker, passed_over = found
            queue.release(held.task.key)
            self._start(queue, held, worker, now, passed_over)
            self._chosen[held.task] = worker
            chosen.append(held.task)
        if chosen:
            assign_held_tasks(self.scheduler, chosen)
            self._chosen.clear()

    def _next_task(self, queue: PartitionQueue) -> tuple[_HeldTask, Any, list[str]] | None:
        """Return the next task that can be assigned, its worker, and clients passed over."""
        passed_over: list[str] = []
        for client in queue.policy.clients_in_turn():
            for held in queue.heads(client):
                if not (queue.with_room or held.bounds.needs_no_room):
                    continue
                worker = self._worker_for(queue, held)
                if worker is not None:
                    in_turn = worker in queue.with_room
                    return held, worker, passed_over if in_turn else []
                if held.bounds.memory:
                    self._reserve_memory(queue, held.task, held.bounds.memory)
            passed_over.append(client)
        return None

    def _hand_over(self, queue: PartitionQueue, client: str) -> None:
        """Let the tasks of a client that has left count for other clients that want them."""
        for held in [held for held in queue.held.values() if held.client == client]:
            other = self._client_of(held.task)
            if other != client:
                queue.release(held.task.key)
                queue.policy.remove_waiting(client)
                queue.hold(held.task, _HeldTask(other, held.bounds, held.since, held.task))

    # -- checks ------------------------------------------------------------------------

    def _schedule_check(self) -> None:
        loop = asyncio.get_running_loop()
        self._check = loop.call_later(CHECK_EVERY_S, self._check_tasks)

    def _check_tasks(self) -> None:
        """Charge for long tasks, and find tasks that were moved to other workers."""
        self._schedule_check()
        now = time.monotonic()
        tasks = self.scheduler.tasks
        for queue in self.queues.values():
            queue.policy.charge_running(now)
            for key, assignment in queue.assigned.items():
                task = tasks.get(key)
                worker = task.processing_on if task is not None else None
                if worker is not None and worker is not assignment.worker:
                    queue.move(key, worker)
            for worker in [*queue.loads]:
                queue.update_worker(worker)
            queue.policy.remove_idle(self._present, now)
            if queue.loads:  # otherwise, there are no workers
                refresh_waiting_times(self.scheduler, (h.task for h in queue.held.values()))
        self._dispatch_soon()


def submitter_of(task: Any) -> SubmittingTask | None:
    """Return the task that has submitted a nested task, or None."""
    annotations = task.annotations
    return annotations.get(SUBMITTER) if annotations else None


def client_name(client_id: str) -> str:
    """Return the name that a client was given, or its ID if it has no name.

    Examples
    --------
    >>> client_name("Client-alice-35a2e6b8-cb20-11ef-9d0f-0242ac110002")
    'alice'
    """
    _, _, name = client_id[: -_UUID_LETTERS - 1].partition("-")
    return name or client_id


def shares_of(scheduler: Any) -> Shares:
    """Return the scheduler's plugin, which is added if necessary.

    Raises
    ------
    PoolError
        If this version of Dask lacks the private API that shares require.
    """
    require_feature(SHARES)
    shares: Shares = scheduler.plugins.get(NAME) or Shares(scheduler)
    return shares


def set_weight(name: str, weight: float, dask_scheduler: Any = None) -> None:
    """Set the weight of a client in all partitions. Runs on the scheduler."""
    shares_of(dask_scheduler).set_weight(name, weight)


def check_weight(weight: object) -> float:
    """Return a weight that a user has passed as a float.

    Raises
    ------
    PoolError
        If it is not a positive, finite number.
    """
    if isinstance(weight, int | float) and weight is not True and 0 < weight < math.inf:
        return float(weight)
    raise PoolError(f"Invalid weight {weight!r}. Expected a positive number, for example 3.")


class SlotUse(NamedTuple):
    """Slots of a partition that a client can use, and slots that nobody uses."""

    usable: float  # number of slots that the client can expect to get
    free: float  # number of slots without a task
    idle_s: float  # total time for which slots had no task, times the number of these slots


def slot_use(
    scheduler: Any, name: str, slots: float, client_id: str, task_key: Any = None
) -> SlotUse:
    """Return how many of a partition's slots a client can use at present.

    These are its fair share and, if others do not use theirs, the slots that it uses and those that
    nobody uses.

    Parameters
    ----------
    scheduler, name
        Scheduler and name of the partition.
    slots
        Number of slots of the partition.
    client_id, task_key
        ID of the client, and key of the task in which it is used, if any.
    """
    shares: Shares | None = scheduler.plugins.get(NAME)
    if shares is None or name not in shares.queues:
        return SlotUse(slots, 0.0, 0.0)
    queue = shares.queues[name]
    client = shares.client_of_key(task_key) or client_name(client_id)
    account = queue.policy.accounts.get(client)
    used = account.slots if account is not None else 0.0
    usable = max(queue.policy.fair_slots(client, slots), used + queue.free_slots)
    return SlotUse(min(slots, usable), queue.free_slots, queue.idle_s())


def clients_of(scheduler: Any, name: str) -> dict[str, ClientStats]:
    """Return the use of a partition by each client, largest share first."""
    shares: Shares | None = scheduler.plugins.get(NAME)
    if shares is None or name not in shares.queues:
        return {}
    policy = shares.queues[name].policy
    now = time.monotonic()
    clients = {
        client: ClientStats(
            weight=account.weight,
            share=policy.share(client, now),
            slots=int(account.slots),
            waiting=account.waiting,
            wait_s=account.recent_wait_s,
            seconds=account.seconds,
            queued_seconds=account.waited_s,
        )
        for client, account in policy.accounts.items()
    }
    return dict(sorted(clients.items(), key=lambda item: -item[1].share))


class _Sharing(Feature):
    """Feature that lets the clients of a partition take turns."""

    def enable(self, scheduler: Any, names: Iterable[str]) -> str:
        """Share the slots of the given partitions from now on."""
        try:
            shares = shares_of(scheduler)
        except PoolError as error:  # partitions are useful without this feature
            return f"Clients do not get fair shares. {error}"
        for name in names:
            if name not in shares.queues:
                shares.add_partition(name)
        return ""

    def disable(self, scheduler: Any, name: str) -> None:
        """Leave the tasks of a partition to Dask."""
        shares: Shares | None = scheduler.plugins.get(NAME)
        if shares is not None and name in shares.queues:
            shares.remove_partition(name)

    def names(self, scheduler: Any) -> Set[str]:
        """Return the names of the partitions with shares."""
        shares: Shares | None = scheduler.plugins.get(NAME)
        return frozenset() if shares is None else shares.queues.keys()


FEATURES.append(_Sharing())
