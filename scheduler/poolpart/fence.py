"""A fence around a partition: other tasks stay out.

A Dask resource is a fence in one direction: tasks that ask for it run on workers that have
it, and all other tasks run there as well. A raised fence closes the other direction. Only
tasks that take a slot of the partition run on its workers; un-annotated ones, dask
collections, tasks submitted from inside other tasks, recomputed and stolen ones, actors and
the outputs of shuffles go to the remainder of the cluster, whoever submitted them and when.

What a fence does not concern: tasks that a worker was given before go on there; `Client.run`
reaches all workers; data that is scattered, replicated or rebalanced may be put anywhere
(give ``workers=`` to keep it out). A task with ``allow_other_workers=True`` is Dask's to place
where none of the workers that it names, or no worker outside, has room.

The fence lives on the scheduler until it is lowered, also when the client has gone. Workers
that join late, are restarted or move between partitions need nothing else. Tasks that no worker
outside may take wait; the scheduler logs that, and every client gets a warning.

A fence is a rule that is asked whenever the scheduler decides where a task goes, see
`internals.py`; nothing is written on tasks or workers. Two ways that need no such rule were tried:
a resource that all workers outside declare, put on every task without one, and
`worker_restrictions` that name the workers outside. Both make every task a restricted one, and
Dask holds no restricted tasks back: of 200 root tasks all 200 were given to the open worker at
once, whose memory then holds all their results. With the rule it is 2, and 198 wait.
"""

from __future__ import annotations

import logging
import pickle
import time
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .internals import Rules, could_take, open_to_all, rule_for_fences, take_back_fences

logger = logging.getLogger(__name__)

NAME = "poolpart-fences"
COMPLAIN_EVERY_S = 10.0
_EXPECTED = "poolpart-partition"  # in what the scheduler knows of a worker


def enclose(scheduler: Any, name: str) -> None:
    """Raise a fence: from now on no task comes in.

    Raises
    ------
    PoolError
        If this version of Dask decides by other means.
    """
    fences: Fences | None = scheduler.plugins.get(NAME)
    if fences is None:
        fences = Fences(scheduler)
    fences.names.add(name)
    fences.look_again()


def expect(scheduler: Any, worker: Any, name: str | None) -> None:
    """Note to which partition a worker is to belong: it is behind its fence from now on."""
    worker.extra.pop(_EXPECTED, None)
    if name is not None:
        worker.extra[_EXPECTED] = name
    if fences := scheduler.plugins.get(NAME):
        fences.look_at(worker)


def lower(scheduler: Any, name: str) -> None:
    """Lower a fence; the last one takes the rule with it."""
    fences: Fences | None = scheduler.plugins.get(NAME)
    if fences is None or name not in fences.names:
        return
    fences.names.discard(name)
    if not fences.names:
        fences.uninstall()
    fences.look_again()


def fences_of(scheduler: Any) -> frozenset[str]:
    """Names of the fences that are raised."""
    fences: Fences | None = scheduler.plugins.get(NAME)
    return frozenset(fences.names) if fences else frozenset()


class Fences(SchedulerPlugin):
    """The rule: a worker behind a fence takes tasks only that ask for the fence's resource."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self.closed: set[Any] = set()  # states of the workers behind fences
        self._rules = Rules()
        self._complained_at = float("-inf")
        rule_for_fences(self._rules, scheduler, self.closed, self.stop)
        scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Take everything back."""
        take_back_fences(self._rules, self.scheduler)
        self.scheduler.remove_plugin(NAME)

    # -- who is behind a fence ---------------------------------------------------------

    def look_again(self) -> None:
        """Find out which workers are behind fences."""
        for worker in self.scheduler.workers.values():
            self.look_at(worker)

    def look_at(self, worker: Any) -> None:
        """Enclose a worker, or open it, by what it declares and where it is to belong."""
        declares = any(worker.resources.get(name) for name in self.names)
        if declares or worker.extra.get(_EXPECTED) in self.names:
            self.closed.add(worker)
            self.scheduler.idle_task_count.discard(worker)
        elif worker in self.closed:
            self.closed.discard(worker)
            open_to_all(self.scheduler, worker)

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Enclose a worker that joins, if it is to be."""
        self.look_at(scheduler.workers[worker])

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Forget a worker that has left."""
        self.closed.intersection_update(scheduler.workers.values())

    # -- the rule ----------------------------------------------------------------------

    def stop(self, task: Any) -> bool:
        """Whether fences keep a task out: it asks for none of their resources."""
        asked = task.resource_restrictions
        return not asked or self.names.isdisjoint(asked)

    def holds_up(self, task: Any) -> bool:
        """Whether fences are why no worker may take a task now."""
        could: set[Any] = could_take(self.scheduler, task) if self.stop(task) else set()
        return bool(could) and could <= self.closed

    # -- never silently ----------------------------------------------------------------

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
        """Say so when a task waits because of fences."""
        if finish not in ("no-worker", "queued"):
            return
        # In the queue tasks wait for their turn as well.
        if finish == "queued" and not self.scheduler.running <= self.closed:
            return
        now = time.monotonic()
        task = self.scheduler.tasks[key]
        if now - self._complained_at < COMPLAIN_EVERY_S or not self.holds_up(task):
            return
        self._complained_at = now
        fences = ", ".join(sorted(self.names))
        complaint = (
            f"Tasks wait, such as {key!r}: all workers that could take them are kept for "
            f"exclusive partitions ({fences}). Start more workers, submit to a partition, or "
            "make a partition that is not exclusive."
        )
        logger.warning(complaint)
        self.scheduler.log_event("warn", {"message": pickle.dumps(complaint)})
