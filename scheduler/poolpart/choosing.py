"""The worker of a task, chosen in a time that does not grow with the cluster.

For a task with a resource, and for a task that a fence keeps out of a partition, Dask compares all
workers that may take it, which takes the scheduler some microseconds for each worker
(`benchmarks.placing`). Here it compares a few workers of the group that may take the task:

- workers that hold inputs of the task;
- else workers that have free slots, the longest free worker first;
- else, all being busy, some workers in turn.

Dask's own objective decides between them. The groups are the partitions and, if there are fences,
the workers outside all fences. Small groups, tasks that are bound to workers or hosts, actors, and
tasks whose inputs many workers hold are left to Dask, and so are all tasks if this rule fails.
"""

from __future__ import annotations

from itertools import islice
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .fence import NAME as FENCES
from .fence import Fences
from .internals.method_rules import MethodRules, add_choice_rule
from .internals.placing import (
    can_run,
    count_declaring,
    earliest_worker,
    free_slots_of,
    holders_of_inputs,
    only_resource_of,
    workers_declaring,
)

NAME = "poolpart-choice"
MAX_COMPARED = 10  # workers that are compared for a task; smaller groups are left to Dask
_EXAMINED = 50  # workers that are examined for free slots
_OUTSIDE = ""  # name of the group of the workers outside all fences


class _Group:
    """Workers that may all take the same tasks."""

    def __init__(self, name: str, version: Any, workers: list[Any]) -> None:
        self.name = name
        self.version = version  # the state of the cluster when the group was made
        self.workers = workers
        self.members = set(workers)
        self.free = dict.fromkeys(workers)  # ordered set: workers that may have free slots
        self._next_index = 0  # the first worker that `in_turn` returns next

    def with_free_slots(self, slots: float) -> list[Any]:
        """Return up to `MAX_COMPARED` workers with enough free slots, and forget full workers."""
        workers: list[Any] = []
        for worker in list(islice(self.free, _EXAMINED)):
            free = free_slots_of(worker, self.name)
            if free >= slots:
                workers.append(worker)
            elif free < 1:
                del self.free[worker]
            if len(workers) == MAX_COMPARED:
                break
        return workers

    def in_turn(self) -> list[Any]:
        """Return `MAX_COMPARED` workers, evenly spread and different at each call."""
        number = len(self.workers)
        start = self._next_index
        self._next_index = (start + 1) % number
        return [
            self.workers[(start + n * number // MAX_COMPARED) % number] for n in range(MAX_COMPARED)
        ]


class WorkerChooser(SchedulerPlugin):
    """The rule: chooses workers for tasks of partitions, and for tasks outside fences."""

    name = NAME

    def __init__(self, scheduler: Any, names: set[str]) -> None:
        self.scheduler = scheduler
        self.names = names  # the partitions: the caller adds and removes names
        self._changes = 0  # how often workers, or what they declare, have changed
        self._groups: dict[str, _Group] = {}
        self._rules = MethodRules()
        add_choice_rule(self._rules, scheduler, self.choose)
        scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Take the rule back."""
        self._rules.remove_all()
        self.scheduler.remove_plugin(NAME)

    # -- groups ------------------------------------------------------------------------

    def invalidate_groups(self) -> None:
        """Note that a worker declares different resources than before."""
        self._changes += 1

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Note a worker that joins."""
        self._changes += 1

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Note a worker that has left, and keep no reference to its state."""
        self._changes += 1
        self._groups.clear()

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, worker: str = "", **kwargs: Any
    ) -> None:
        """Note a worker that has ended a task, and may have a free slot."""
        if start == "processing" and (state := self.scheduler.workers.get(worker)):
            for group in self._groups.values():
                if state in group.members:
                    group.free[state] = None

    def _group(self, name: str) -> _Group | None:
        """Return the group of the workers that may take tasks, made anew after changes."""
        fences: Fences | None = self.scheduler.plugins.get(FENCES)
        if name != _OUTSIDE:
            version = self._changes, count_declaring(self.scheduler, name)
        elif fences is not None:
            version = self._changes, fences.changes
        else:
            return None
        group = self._groups.get(name)
        if group is None or group.version != version:
            group = self._groups[name] = _Group(name, version, self._members(name))
        return group

    def _members(self, name: str) -> list[Any]:
        """States of the workers that belong to a group now."""
        if name != _OUTSIDE:
            return workers_declaring(self.scheduler, name)
        closed: set[Any] = self.scheduler.plugins[FENCES].closed
        return [worker for worker in self.scheduler.workers.values() if worker not in closed]

    # -- the rule ----------------------------------------------------------------------

    def choose(self, task: Any) -> Any:
        """Return the state of the worker for a task.

        Returns NotImplemented to leave the choice to Dask.
        """
        resource = only_resource_of(task)
        if resource is None:
            return NotImplemented
        name, slots = resource
        if name != _OUTSIDE and name not in self.names:
            return NotImplemented
        group = self._group(name)
        if group is None or len(group.workers) <= 2 * MAX_COMPARED:
            return NotImplemented
        holders = holders_of_inputs(task)
        if len(holders) > _EXAMINED:
            return NotImplemented
        workers = [worker for worker in holders if worker in group.members]
        workers = self._permitted(workers, name, slots)
        if not workers:
            workers = self._permitted(group.with_free_slots(slots), name, slots)
        if not workers:
            workers = self._permitted(group.in_turn(), name, slots)
        return earliest_worker(self.scheduler, task, workers) if workers else NotImplemented

    def _permitted(self, workers: list[Any], name: str, slots: float) -> list[Any]:
        return [worker for worker in workers if can_run(self.scheduler, worker, name, slots)]


def invalidate_groups(scheduler: Any) -> None:
    """Note that a worker of a scheduler declares different resources than before."""
    choice: WorkerChooser | None = scheduler.plugins.get(NAME)
    if choice is not None:
        choice.invalidate_groups()
