"""Place tasks without a partition in a time that does not depend on the size of the cluster.

If a fence keeps a task out of a partition, Dask compares all workers that may run it. This takes
the scheduler several microseconds per worker (see `benchmarks.placing`). The rule in this module
only compares a few of these workers, using Dask's own objective function. They are the first
nonempty group of the following:

- workers that hold inputs of the task;
- workers with free threads, starting with the worker that has been free the longest;
- if all workers are busy, some workers in rotation.

The candidates are the workers outside all fences. Dask still places tasks if there are few of them
or no fences, tasks that are bound to workers or hosts, actors, and tasks with inputs on many
workers. If this rule fails, Dask places all tasks. Tasks of partitions are placed by `shares`.
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
    earliest_worker,
    free_threads_of,
    holders_of_inputs,
    only_resource_of,
)

NAME = "poolpart-choice"
MAX_COMPARED = 10  # number of workers that are compared for a task
_EXAMINED = 50  # number of workers that are examined for free slots
_WITHOUT_PARTITION: tuple[str, float] = ("", 1)  # resource of a task without a partition


class _Group:
    """Group of workers that can run the same tasks."""

    def __init__(self, version: Any, workers: list[Any]) -> None:
        self.version = version  # identifies the state of the cluster for which the group is valid
        self.workers = workers
        self.members = set(workers)
        self.free = dict.fromkeys(workers)  # ordered set of workers that may have free threads
        self._next_index = 0  # index of the first worker in the next result of `in_turn`

    def with_free_threads(self) -> list[Any]:
        """Return up to `MAX_COMPARED` workers with free threads.

        Workers without free threads are removed from the set of free workers.
        """
        workers: list[Any] = []
        for worker in list(islice(self.free, _EXAMINED)):
            if free_threads_of(worker) >= 1:
                workers.append(worker)
            else:
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
    """Scheduler plugin that chooses workers for tasks outside of fences."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self._changes = 0  # number of changes of the workers
        self._outside: _Group | None = None  # workers outside all fences, if there are fences
        self._rules = MethodRules()
        add_choice_rule(self._rules, scheduler, self.choose)
        scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Remove the rule and the plugin from the scheduler."""
        self._rules.remove_all()
        self.scheduler.remove_plugin(NAME)

    # -- the group ---------------------------------------------------------------------

    def invalidate_groups(self) -> None:
        """Invalidate the group after a worker has changed its declared resources."""
        self._changes += 1

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Invalidate the group after a worker has joined."""
        self._changes += 1

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Delete the group after a worker has left, so that it does not keep its state alive."""
        self._changes += 1
        self._outside = None

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, worker: str = "", **kwargs: Any
    ) -> None:
        """Record that a worker may have a free thread because a task has ended."""
        group = self._outside
        if group is not None and start == "processing":
            state = self.scheduler.workers.get(worker)
            if state in group.members:
                group.free[state] = None

    def _group(self) -> _Group | None:
        """Return the workers outside fences as a group, which is rebuilt after changes.

        The result is None if there are no fences.
        """
        fences: Fences | None = self.scheduler.plugins.get(FENCES)
        if fences is None:
            return None
        version = self._changes, fences.changes
        if self._outside is None or self._outside.version != version:
            workers = self.scheduler.workers.values()
            outside = [worker for worker in workers if worker not in fences.enclosed]
            self._outside = _Group(version, outside)
        return self._outside

    # -- the rule ----------------------------------------------------------------------

    def choose(self, task: Any) -> Any:
        """Choose the worker for a task, or return NotImplemented to let Dask decide."""
        if only_resource_of(task) != _WITHOUT_PARTITION:
            return NotImplemented
        group = self._group()
        if group is None or len(group.workers) <= 2 * MAX_COMPARED:
            return NotImplemented
        holders = holders_of_inputs(task)
        if len(holders) > _EXAMINED:
            return NotImplemented
        workers = self._permitted([worker for worker in holders if worker in group.members])
        workers = workers or self._permitted(group.with_free_threads())
        workers = workers or self._permitted(group.in_turn())
        return earliest_worker(self.scheduler, task, workers) if workers else NotImplemented

    def _permitted(self, workers: list[Any]) -> list[Any]:
        return [worker for worker in workers if can_run(self.scheduler, worker, "", 1)]


def invalidate_groups(scheduler: Any) -> None:
    """Notify the rule, if it is installed, that a worker has changed its declared resources."""
    choice: WorkerChooser | None = scheduler.plugins.get(NAME)
    if choice is not None:
        choice.invalidate_groups()
