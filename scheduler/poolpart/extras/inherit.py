"""Tasks that are submitted from inside a task of a partition belong to that partition.

Dask's resources are not inherited: what a GPU task submits runs anywhere. Here the scheduler gives
such tasks the partition of the task that submits them, at any depth, unless they say otherwise: by
resources, by workers, by another partition, or with ``dask.annotate(resources={})`` for none.

Each takes a slot, as a task that `Partition.submit` submits. The task that submits them lends its
own while it waits for them (`lending.py`).

Who submits is known by its thread. What a method of an actor submits belongs to the partition that
the actor was submitted to, unless actors of the same key prefix are in different partitions. What a
coroutine, or a thread that a task started itself, submits is not inherited.

Tried and left: running each function under ``dask.annotate`` (the annotation is a context variable
and does reach `submit`, `map` and collections, but not the tasks that *those* submit, and every
task is pickled with a wrapper around it).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Set
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from ..choosing import WorkerChooser
from ..errors import PoolError
from ..features import FEATURES, Feature
from ..internals.method_rules import MethodRules, add_graph_rule, add_shuffle_rule
from ..internals.names import CHOOSING, NESTED, READING, SHUFFLES, require
from ..internals.scheduler import Resources, set_worker_plugin
from .lending import lending_plugin
from .unreadable import UnreadableInputs

logger = logging.getLogger(__name__)

NAME = "poolpart-inherit"
ANSWER_S = 5.0  # workers have to begin or end lending; a worker that is stopped does so later


class Inheritance(SchedulerPlugin):
    """The scheduler's side: looks at each graph before its tasks are made, and at shuffles."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self.note = ""  # remark for users: what does not work with this version of Dask
        self._rules = MethodRules()
        self._choice: WorkerChooser | None = None
        self._unreadable: UnreadableInputs | None = None
        self.lends = self._begin(
            NESTED, "Tasks that other tasks submit may run on any worker.", self._nest
        )
        self._begin(SHUFFLES, "Shuffles may use workers outside their partition.", self._shuffle)
        self._begin(CHOOSING, "Task placement takes longer in larger clusters.", self._choose)
        self._begin(READING, "Tasks whose inputs cannot be unpickled wait forever.", self._read)
        scheduler.add_plugin(self)

    def _begin(self, feature: str, without: str, begin: Callable[[], None]) -> bool:
        """Begin a feature.

        Returns False, and notes the missing names, if Dask lacks them.
        """
        try:
            require(feature)
            begin()
        except PoolError as error:  # partitions are of use without
            self.note = " ".join(filter(None, (self.note, f"{without} {error}")))
            logger.warning("Partitions: %s %s", without, error)
            return False
        return True

    def _nest(self) -> None:
        add_graph_rule(self._rules, self.scheduler, self._bequeath)

    def _shuffle(self) -> None:
        add_shuffle_rule(self._rules, self.scheduler)

    def _choose(self) -> None:
        self._choice = WorkerChooser(self.scheduler, self.names)

    def _read(self) -> None:
        self._unreadable = UnreadableInputs(self.scheduler, self.names)

    def _bequeath(self, task: Any) -> Resources:
        """Return the resources of tasks that a task submits, empty outside partitions."""
        resources = task.resource_restrictions
        return dict.fromkeys(self.names & resources.keys(), 1) if resources else {}

    def uninstall(self) -> None:
        """Take the rules back."""
        self._rules.remove_all()
        if self._choice is not None:
            self._choice.uninstall()
        if self._unreadable is not None:
            self._unreadable.uninstall()
        self.scheduler.remove_plugin(NAME)


class _Inheriting(Feature):
    """Begins and ends inheritance with partitions."""

    def begin(self, scheduler: Any, names: Iterable[str]) -> str:
        """Have nested tasks and shuffles of partitions stay in their partition."""
        rule: Inheritance = scheduler.plugins.get(NAME) or Inheritance(scheduler)
        for name in names:
            if name not in rule.names:
                rule.names.add(name)
                if rule.lends:
                    _inform_workers(scheduler, name, lending_plugin(name))
        return rule.note

    def end(self, scheduler: Any, name: str) -> None:
        """End inheritance in a partition."""
        rule: Inheritance | None = scheduler.plugins.get(NAME)
        if rule is None or name not in rule.names:
            return
        rule.names.discard(name)
        _inform_workers(scheduler, name, None)
        if not rule.names:
            rule.uninstall()

    def names(self, scheduler: Any) -> Set[str]:
        """Return the partitions whose nested tasks belong to them."""
        rule: Inheritance | None = scheduler.plugins.get(NAME)
        return frozenset() if rule is None else rule.names

    async def wait_for_workers(self) -> None:
        """Wait until the workers have started or stopped lending, at most `ANSWER_S` seconds."""
        loop = asyncio.get_running_loop()
        requests = {request for request in _requests if request.get_loop() is loop}
        if requests:
            await asyncio.wait(requests, timeout=ANSWER_S)


FEATURES.append(_Inheriting())


# -- workers, which lend -------------------------------------------------------------------

_requests: set[asyncio.Future[Any]] = set()  # sent to workers and under way, of all schedulers here


def _inform_workers(scheduler: Any, name: str, plugin: bytes | None) -> None:
    """Add the plugin of a partition to all workers, or remove the plugin with None."""
    for request in set_worker_plugin(scheduler, f"poolpart-lending-{name}", plugin):
        _requests.add(request)
        request.add_done_callback(_requests.discard)
