"""Place tasks on workers in a time that does not depend on the size of the cluster.

If a task requires a resource, or if a fence keeps it out of a partition, Dask compares all workers
that may run it. This takes the scheduler several microseconds per worker (see
`benchmarks.placing`). The rule in this module only compares a few of these workers, using Dask's
own objective function. They are the first nonempty group of the following:

- workers that hold inputs of the task;
- workers with free slots, starting with the worker that has been free the longest;
- if all workers are busy, some workers in rotation.

The candidates come from one group of workers, which is a partition or, if there are fences, all
workers outside fences. Dask still places tasks of small groups, tasks that are bound to workers or
hosts, actors, and tasks with inputs on many workers. If this rule fails, Dask places all tasks.
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
MAX_COMPARED = 10  # number of workers that are compared for a task
_EXAMINED = 50  # number of workers that are examined for free slots
_OUTSIDE = ""  # name of the group of workers outside all fences


class _Group:
    """Group of workers that can run the same tasks."""

    def __init__(self, name: str, version: Any, workers: list[Any]) -> None:
        self.name = name
        self.version = version  # identifies the state of the cluster for which the group is valid
        self.workers = workers
        self.members = set(workers)
        self.free = dict.fromkeys(workers)  # ordered set of workers that may have free slots
        self._next_index = 0  # index of the first worker in the next result of `in_turn`

    def with_free_slots(self, slots: float) -> list[Any]:
        """Return up to `MAX_COMPARED` workers with enough free slots.

        Workers without any free slot are removed from the set of free workers.
        """
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
        """Return `MAX_COMPARED` evenly spaced workers, which differ from call to call."""
        number = len(self.workers)
        start = self._next_index
        self._next_index = (start + 1) % number
        return [
            self.workers[(start + n * number // MAX_COMPARED) % number] for n in range(MAX_COMPARED)
        ]


class WorkerChooser(SchedulerPlugin):
    """Scheduler plugin that chooses workers for tasks, considering partitions and fences."""

    name = NAME

    def __init__(self, scheduler: Any, names: set[str]) -> None:
        self.scheduler = scheduler
        self.names = names  # names of the partitions, a set that the caller updates
        self._changes = 0  # number of changes of the workers and their declared resources
        self._groups: dict[str, _Group] = {}
        self._rules = MethodRules()
        add_choice_rule(self._rules, scheduler, self.choose)
        scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Remove the rule and the plugin from the scheduler."""
        self._rules.remove_all()
        self.scheduler.remove_plugin(NAME)

    # -- groups ------------------------------------------------------------------------

    def invalidate_groups(self) -> None:
        """Invalidate all groups after a worker has changed its declared resources."""
        self._changes += 1

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Invalidate all groups after a worker has joined."""
        self._changes += 1

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Delete all groups after a worker has left, so that they do not keep its state alive."""
        self._changes += 1
        self._groups.clear()

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, worker: str = "", **kwargs: Any
    ) -> None:
        """Record that a worker may have a free slot because a task has ended."""
        if start == "processing" and (state := self.scheduler.workers.get(worker)):
            for group in self._groups.values():
                if state in group.members:
                    group.free[state] = None

    def _group(self, name: str) -> _Group | None:
        """Return the workers of a partition as a group, which is rebuilt after changes.

        For `_OUTSIDE`, the group contains the workers outside all fences. The result is None if
        there are no fences.
        """
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
        if name != _OUTSIDE:
            return workers_declaring(self.scheduler, name)
        enclosed: set[Any] = self.scheduler.plugins[FENCES].enclosed
        return [worker for worker in self.scheduler.workers.values() if worker not in enclosed]

    # -- the rule ----------------------------------------------------------------------

    def choose(self, task: Any) -> Any:
        """Choose the worker for a task, or return NotImplemented to let Dask decide."""
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
    """Notify the rule, if it is installed, that a worker has changed its declared resources."""
    choice: WorkerChooser | None = scheduler.plugins.get(NAME)
    if choice is not None:
        choice.invalidate_groups()
