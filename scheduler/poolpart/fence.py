"""Fences that keep other tasks off the workers of exclusive partitions.

A Dask resource only works in one direction. Tasks that request it run on workers that have it, but
all other tasks can run there as well. A fence adds the other direction. Only tasks that take a slot
of the partition run on its workers. All other tasks run on the rest of the cluster, regardless of
when and by which client they were submitted. This includes tasks without annotations, collections,
nested tasks, recomputed and stolen tasks, actors, and the outputs of shuffles.

A fence does not affect tasks that are already assigned to a worker, and it does not affect
`Client.run`, which reaches all workers. It does not restrict data that is scattered, replicated or
rebalanced either (pass ``workers=`` to keep it out). Dask may place a task with
``allow_other_workers=True`` inside the fence if none of its workers, or no worker outside, has
capacity.

The fence exists on the scheduler until it is lowered, even if the client has closed. It includes
workers that join later, are restarted, or move between partitions. Tasks that no worker outside the
fence can run have to wait. In this case, the scheduler logs a warning and sends it to all clients.

A fence is a rule that is called whenever the scheduler places a task (see
`internals.method_rules`). Tasks and workers are not modified. Two approaches without such a rule
were rejected: a resource that all outside workers declare and all other tasks request, and
`worker_restrictions` that list the outside workers. Both restrict every task, and Dask does not
queue restricted tasks on the scheduler. In an experiment, the outside worker received all of 200
root tasks at once and had to store all their results. With the rule, it receives two, and 198 are
queued.
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
from .internals.names import FENCES, require_feature
from .internals.scheduler import admit_other_tasks
from .limits import memory_of

logger = logging.getLogger(__name__)

NAME = "poolpart-fences"
WARN_EVERY_S = 10.0
_EXPECTED = "poolpart-partition"  # key in the scheduler's state of a worker: its future partition


def raise_fence(scheduler: Any, name: str) -> None:
    """From now on, keep tasks that do not request a partition's resource off its workers.

    Raises
    ------
    PoolError
        If this version of Dask lacks the private API that fences require.
    """
    require_feature(FENCES)
    fences: Fences = scheduler.plugins.get(NAME) or Fences(scheduler)
    fences.names.add(name)
    fences.update_workers()


def set_expected_partition(scheduler: Any, worker: Any, name: str | None) -> None:
    """Record a worker's future partition, and enclose the worker in its fence immediately."""
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
    """Return the names of the partitions that have a fence."""
    fences: Fences | None = scheduler.plugins.get(NAME)
    return frozenset(fences.names) if fences else frozenset()


class Fences(SchedulerPlugin):
    """Scheduler plugin that reserves fenced workers for tasks that request their resource."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self.enclosed: set[Any] = set()  # states of the enclosed workers
        self.changes = 0  # number of changes of `enclosed`
        self._rules = MethodRules()
        self._warned_at = float("-inf")  # time.monotonic()
        add_fence_rules(self._rules, scheduler, self.enclosed, self.keeps_out)
        scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Remove all rules and the plugin from the scheduler."""
        remove_fence_rules(self._rules, self.scheduler)
        self.scheduler.remove_plugin(NAME)

    # -- enclosed workers --------------------------------------------------------------

    def update_workers(self) -> None:
        """Enclose or release each worker after a fence was raised or lowered."""
        for worker in self.scheduler.workers.values():
            self.update_worker(worker)

    def update_worker(self, worker: Any) -> None:
        """Enclose or release a worker, depending on its resources and its future partition."""
        declares = any(worker.resources.get(name) for name in self.names)
        if declares or worker.extra.get(_EXPECTED) in self.names:
            self.changes += worker not in self.enclosed
            self.enclosed.add(worker)
            self.scheduler.idle_task_count.discard(worker)
        elif worker in self.enclosed:
            self.enclosed.discard(worker)
            self.changes += 1
            admit_other_tasks(self.scheduler, worker)

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Enclose a joining worker if it belongs to a fence."""
        self.update_worker(scheduler.workers[worker])

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Forget a worker that has left."""
        self.enclosed.intersection_update(scheduler.workers.values())

    # -- the rule ----------------------------------------------------------------------

    def keeps_out(self, task: Any) -> bool:
        """Return whether fences exclude a task because it does not request their resources."""
        resources = task.resource_restrictions
        return not resources or self.names.isdisjoint(resources)

    # -- warnings ----------------------------------------------------------------------

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
        """Warn if a task has to wait because of a fence."""
        if finish not in ("no-worker", "queued"):
            return
        # A queued task may also be waiting for other tasks to finish.
        if finish == "queued" and not self.scheduler.running <= self.enclosed:
            return
        task = self.scheduler.tasks[key]
        elapsed_s = time.monotonic() - self._warned_at
        if elapsed_s < WARN_EVERY_S or not self.keeps_out(task):
            return
        if memory_of(task) or self.scheduler.valid_workers(task):
            return  # it waits for a slot, or for memory, of another partition
        if not workers_without_fences(self.scheduler, task):  # it would wait without fences, too
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
