"""Tasks that are submitted from inside a task of a partition belong to that partition.

Dask's resources are not inherited: what a GPU task submits runs anywhere. Here the scheduler
gives such tasks the partition of the task that submits them, at any depth, unless they say
otherwise: by resources, workers or a partition of their own, or with
``dask.annotate(resources={})`` for none.

They take no slot. The task that submits them holds one until it ends, also while it waits for
them and also when it has seceded; if each needed another, a partition whose slots are all
held by such tasks would wait for ever. A thread they do need, so a task that waits for what
it has submitted must secede, as always with Dask; `worker_client` does it.

Who submits is known by its thread: what a coroutine, or a thread that the task started itself,
submits is not inherited. Tried and left: running each function under ``dask.annotate`` (the
annotation is a context variable and does reach `submit`, `map` and collections, but not the
tasks that *those* submit, and every task is pickled with a wrapper around it).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .errors import PoolError
from .internals import Resources, Rules, rule_for_graphs, rule_for_shuffles
from .workers import on_scheduler

logger = logging.getLogger(__name__)

NAME = "poolpart-inherit"


class Inheritance(SchedulerPlugin):
    """The scheduler's side: looks at each graph before its tasks are made, and at shuffles."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self.note = ""  # what a user should know where this version of Dask has no room for it
        self._rules = Rules()
        try:
            rule_for_graphs(self._rules, scheduler, self._bequeath)
            rule_for_shuffles(self._rules, scheduler)
        except PoolError as error:  # partitions are of use without
            self.note = f"tasks from inside tasks may run anywhere: {error}"
            logger.warning("Partitions: %s", self.note)
        scheduler.add_plugin(self)

    def _bequeath(self, task: Any) -> Resources:
        """Resources for what a task submits; none if it belongs to no partition."""
        asked = task.resource_restrictions
        return dict.fromkeys(self.names & asked.keys(), 0) if asked else {}

    def uninstall(self) -> None:
        """Take the rules back."""
        self._rules.take_back()
        self.scheduler.remove_plugin(NAME)


def begin_inheritance(names: Iterable[str] = (), dask_scheduler: Any = None) -> str:
    """Have tasks that tasks of these partitions submit belong to them, and shuffles stay there.

    Returns what a user should know, where there is anything.
    """
    rule: Inheritance = dask_scheduler.plugins.get(NAME) or Inheritance(dask_scheduler)
    rule.names.update(names)
    return rule.note


def end_inheritance(scheduler: Any, name: str | None) -> None:
    """Leave it to Dask again where such tasks go, or all of them; nothing is left behind."""
    rule: Inheritance | None = scheduler.plugins.get(NAME)
    if rule is not None:
        rule.names -= rule.names if name is None else {name}
        if not rule.names:
            rule.uninstall()


def keep_shuffles_in(client: Client) -> None:
    """Have shuffles and rechunks of tasks that ask for a partition stay in it, from now on."""
    on_scheduler(client, begin_inheritance)
