"""A fence around a partition keeps other tasks out.

A Dask resource works in one direction: tasks that ask for it run on workers that have it, but
all other tasks run there as well. A fence closes the other direction. Only tasks that take a slot
of the partition run on its workers; un-annotated tasks, dask collections, nested tasks, recomputed
and stolen ones, actors and the outputs of shuffles go to the rest of the cluster, whoever
submitted them and when.

A fence does not affect tasks that a worker already has, `Client.run`, which reaches all workers,
and data that is scattered, replicated or rebalanced (give ``workers=`` to keep it out). Dask may
place a task with ``allow_other_workers=True`` inside if none of its workers, or no worker outside,
has room.

The fence lives on the scheduler until it is lowered, also when the client has gone. Workers
that join late, are restarted or move between partitions are covered. Tasks that no worker outside
may take wait; the scheduler logs that, and every client gets a warning.

A fence is a rule that is called whenever the scheduler places a task (`internals.method_rules`).
Tasks and workers are not modified. Two approaches without such a rule were tried:
a resource that all workers outside declare, put on every task without one, and
`worker_restrictions` that name the workers outside. Both restrict every task, and Dask does not
hold back restricted tasks: the open worker got all of 200 root tasks at once, and its memory all
their results. With the rule it gets 2, and 198 wait.
"""

from __future__ import annotations

import logging
import pickle
import time
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .internals.method_rules import (
    MethodRules,
    add_fence_rules,
    remove_fence_rules,
    workers_without_fences,
)
from .internals.names import FENCES, require
from .internals.scheduler import admit_other_tasks

logger = logging.getLogger(__name__)

NAME = "poolpart-fences"
WARN_EVERY_S = 10.0
_EXPECTED = "poolpart-partition"  # key in the scheduler's state of a worker


def raise_fence(scheduler: Any, name: str) -> None:
    """Raise a fence: from now on, tasks without the resource of a partition stay out.

    Raises
    ------
    PoolError
        If this version of Dask places tasks in another way.
    """
    require(FENCES)
    fences: Fences = scheduler.plugins.get(NAME) or Fences(scheduler)
    fences.names.add(name)
    fences.update_workers()


def set_expected_partition(scheduler: Any, worker: Any, name: str | None) -> None:
    """Record the future partition of a worker, which is behind its fence from now on."""
    worker.extra.pop(_EXPECTED, None)
    if name is not None:
        worker.extra[_EXPECTED] = name
    if fences := scheduler.plugins.get(NAME):
        fences.update_worker(worker)


def lower_fence(scheduler: Any, name: str) -> None:
    """Lower a fence, and uninstall the scheduler plugin if no fences remain."""
    fences: Fences | None = scheduler.plugins.get(NAME)
    if fences is None or name not in fences.names:
        return
    fences.names.discard(name)
    if not fences.names:
        fences.uninstall()
    fences.update_workers()


def fence_names(scheduler: Any) -> frozenset[str]:
    """Return the names of the raised fences."""
    fences: Fences | None = scheduler.plugins.get(NAME)
    return frozenset(fences.names) if fences else frozenset()


class Fences(SchedulerPlugin):
    """The rule: a worker behind a fence takes only tasks that ask for the fence's resource."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self.closed: set[Any] = set()  # states of the workers behind fences
        self.changes = 0  # changes of the set `closed`
        self._rules = MethodRules()
        self._warned_at = float("-inf")  # time.monotonic()
        add_fence_rules(self._rules, scheduler, self.closed, self.keeps_out)
        scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Remove all rules."""
        remove_fence_rules(self._rules, self.scheduler)
        self.scheduler.remove_plugin(NAME)

    # -- who is behind a fence ---------------------------------------------------------

    def update_workers(self) -> None:
        """Enclose or release each worker, after a change of the fences."""
        for worker in self.scheduler.workers.values():
            self.update_worker(worker)

    def update_worker(self, worker: Any) -> None:
        """Enclose or release a worker, by its resources and its future partition."""
        declares = any(worker.resources.get(name) for name in self.names)
        if declares or worker.extra.get(_EXPECTED) in self.names:
            self.changes += worker not in self.closed
            self.closed.add(worker)
            self.scheduler.idle_task_count.discard(worker)
        elif worker in self.closed:
            self.closed.discard(worker)
            self.changes += 1
            admit_other_tasks(self.scheduler, worker)

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Enclose a worker that joins, if necessary."""
        self.update_worker(scheduler.workers[worker])

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Forget a worker that has left."""
        self.closed.intersection_update(scheduler.workers.values())

    # -- the rule ----------------------------------------------------------------------

    def keeps_out(self, task: Any) -> bool:
        """Return whether fences keep a task out: the task asks for no resource of a fence."""
        resources = task.resource_restrictions
        return not resources or self.names.isdisjoint(resources)

    # -- warnings ----------------------------------------------------------------------

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
        """Warn when a task waits because of fences."""
        if finish not in ("no-worker", "queued"):
            return
        # Queued tasks may also wait just for their turn.
        if finish == "queued" and not self.scheduler.running <= self.closed:
            return
        task = self.scheduler.tasks[key]
        elapsed_s = time.monotonic() - self._warned_at
        if elapsed_s < WARN_EVERY_S or not self.keeps_out(task):
            return
        if not workers_without_fences(self.scheduler, task):  # it waits also without fences
            return
        self._warned_at = time.monotonic()
        fences = ", ".join(sorted(self.names))
        message = (
            f"Tasks such as {key!r} are waiting, because all workers that could run them belong "
            f"to exclusive partitions ({fences}). Start more workers, submit the tasks to a "
            "partition, or create a partition that is not exclusive."
        )
        logger.warning(message)
        self.scheduler.log_event("warn", {"message": pickle.dumps(message)})
