"""A fence around a partition: other tasks stay out.

A Dask resource is a fence in one direction: tasks that ask for it run on workers that have
it, and all other tasks run there as well. A raised fence closes the other direction. Only
tasks that take a slot of the partition run on its workers; un-annotated ones, dask
collections, tasks submitted from inside other tasks, recomputed and stolen ones, actors and
the outputs of shuffles go to the remainder of the cluster, whoever submitted them and when.

What a fence does not concern: tasks that a worker was given before go on there; `Client.run`
reaches all workers; data that is scattered, replicated or rebalanced may be put anywhere
(give ``workers=`` to keep it out).

The fence lives on the scheduler until it is lowered, also when the client has gone. It
follows what the workers declare, so workers that join late, are restarted or move between
partitions need nothing else. Tasks that no worker outside may take wait; the scheduler logs
that, every client gets a warning, and statistics count them.

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
from itertools import islice
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .internals import FenceRules, open_to_all
from .remote import on_scheduler

logger = logging.getLogger(__name__)

NAME = "poolpart-fences"
COMPLAIN_EVERY_S = 10.0
_LOOK_AT_MOST = 1000


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
        fences.install()
    fences.names.add(name)
    fences.look_again()


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


def kept_out(scheduler: Any) -> int:
    """Count tasks that wait because only workers behind fences could take them.

    Of those that no worker may take at all, the first thousand are looked at.
    """
    fences: Fences | None = scheduler.plugins.get(NAME)
    if fences is None:
        return 0
    waiting = sum(map(fences.holds_up, islice(scheduler.unrunnable, _LOOK_AT_MOST)))
    return waiting + (0 if fences.remainder else len(scheduler.queued))


class Fences(SchedulerPlugin):
    """The rule: a worker behind a fence takes tasks only that ask for the fence's resource."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self.closed: set[Any] = set()  # states of the workers behind fences
        self._rules = FenceRules(scheduler, self.closed, self.stop, self._look_at)
        self._complained_at = float("-inf")

    # -- coming and going --------------------------------------------------------------

    def install(self) -> None:
        """Have a say in what the scheduler decides.

        Raises
        ------
        PoolError
            If this version of Dask decides by other means.
        """
        self._rules.install()
        self.scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Take everything back."""
        self._rules.uninstall()
        self.scheduler.remove_plugin(NAME)

    # -- who is behind a fence ---------------------------------------------------------

    @property
    def remainder(self) -> set[Any]:
        """Workers that all tasks may run on now."""
        remainder: set[Any] = self.scheduler.running - self.closed
        return remainder

    def look_again(self) -> None:
        """Find out which workers are behind fences."""
        for worker in self.scheduler.workers.values():
            self._look_at(worker)

    def _look_at(self, worker: Any) -> None:
        """Enclose a worker, or open it, by what it declares."""
        declares = any(worker.resources.get(name) for name in self.names)
        if declares:
            self.closed.add(worker)
            self.scheduler.idle_task_count.discard(worker)
        elif worker in self.closed:
            self.closed.discard(worker)
            open_to_all(self.scheduler, worker)

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
        if not self.stop(task):
            return False
        # What nobody could take anyhow is not our affair.
        could = self._rules.could_take(task)
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


def raise_fence(client: Client, name: str) -> None:
    """Keep tasks that do not ask for the resource `name` away from workers that declare it.

    Tasks that such workers were given before end there. Raising a fence that is there does
    nothing.

    Raises
    ------
    PoolError
        If the scheduler lacks this package, or what this needs of Dask.
    """
    on_scheduler(client, _raise, name=name)


def lower_fence(client: Client, name: str) -> None:
    """Let all tasks in again; those that wait are sent at once. Nothing is left behind."""
    on_scheduler(client, _lower, name=name)


async def _raise(name: str, dask_scheduler: Any = None) -> None:
    enclose(dask_scheduler, name)


async def _lower(name: str, dask_scheduler: Any = None) -> None:
    lower(dask_scheduler, name)
