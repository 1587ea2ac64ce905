"""Make nested tasks run in the partition of the task that submits them.

In plain Dask, resources are not inherited, so the tasks that a GPU task submits run on any worker.
With this feature, the scheduler assigns such tasks, at any depth, to the partition of the
submitting task, unless they specify resources, another partition, or workers outside the partition.
``dask.annotate(resources={})`` excludes them from all partitions.

Each of these tasks takes a slot, like a task of `Partition.submit`. The submitting task lends its
own slot while it waits for them (see `lending.py`).

The submitting task is identified by its thread, or in a coroutine by the context of the thread that
has started the coroutine with `Client.sync`. Tasks that a method of an actor submits belong to the
partition of the actor, unless actors with the same key prefix belong to different partitions. Tasks
that are submitted by coroutine functions, or by threads that a task has started, do not inherit a
partition.

The graph of a computation may contain tasks that already exist, because another computation needs
them or needed them before. Dask does not apply the annotations of the graph to them. With this
feature, tasks that have not started run in the partition of the latest computation.

Running each function under ``dask.annotate`` instead was rejected. The annotation is a context
variable and reaches `submit`, `map` and collections, but not the next level of nested tasks. In
addition, every task would be pickled with a wrapper.
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
from ..internals.method_rules import (
    MethodRules,
    add_existing_task_rule,
    add_graph_rule,
    add_shuffle_rule,
)
from ..internals.names import (
    BLAMING,
    CHOOSING,
    EXISTING,
    NESTED,
    READING,
    SHUFFLES,
    WATCHING,
    require_feature,
)
from ..internals.scheduler import Resources, set_worker_plugin
from .blaming import DeathBlame
from .lending import lending_plugin
from .unreadable import UnreadableInputs
from .watching import TaskWatch

logger = logging.getLogger(__name__)

NAME = "poolpart-inherit"
ANSWER_S = 5.0  # time for workers to start or stop lending, which stopped workers do later


class Inheritance(SchedulerPlugin):
    """Scheduler plugin that keeps nested tasks and shuffles in their partition."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self.note = ""  # note for users about parts that this version of Dask does not support
        self._rules = MethodRules()
        self._choice: WorkerChooser | None = None
        self._unreadable: UnreadableInputs | None = None
        self._blame: DeathBlame | None = None
        self._task_watch: TaskWatch | None = None
        self.lends = self._enable_part(
            NESTED, "Tasks that other tasks submit may run on any worker.", self._nest
        )
        self._enable_part(
            EXISTING, "Tasks that computations share may run on any worker.", self._move_existing
        )
        self._enable_part(
            SHUFFLES, "Shuffles may use workers outside their partition.", self._shuffle
        )
        self._enable_part(CHOOSING, "Task placement takes longer in larger clusters.", self._choose)
        self._enable_part(
            READING, "Tasks whose inputs cannot be unpickled wait forever.", self._read
        )
        self._enable_part(
            BLAMING, "The death of a worker counts against all of its tasks.", self._acquit
        )
        self._enable_part(
            WATCHING, "Tasks may wait on a worker while others have free slots.", self._watch
        )
        scheduler.add_plugin(self)

    def _enable_part(self, feature: str, without: str, begin: Callable[[], None]) -> bool:
        """Enable one part of the feature, and return whether this version of Dask supports it.

        If it does not, a note for users begins with `without` and names the missing private API.
        """
        try:
            require_feature(feature)
            begin()
        except PoolError as error:  # partitions are useful without this part
            self.note = " ".join(filter(None, (self.note, f"{without} {error}")))
            logger.warning("Partitions: %s %s", without, error)
            return False
        return True

    def _nest(self) -> None:
        add_graph_rule(self._rules, self.scheduler, self._inherited_resources)

    def _move_existing(self) -> None:
        add_existing_task_rule(self._rules, self.scheduler, self.names)

    def _shuffle(self) -> None:
        add_shuffle_rule(self._rules, self.scheduler)

    def _choose(self) -> None:
        self._choice = WorkerChooser(self.scheduler)

    def _read(self) -> None:
        self._unreadable = UnreadableInputs(self.scheduler, self.names)

    def _acquit(self) -> None:
        self._blame = DeathBlame(self.scheduler, self.names)

    def _watch(self) -> None:
        self._task_watch = TaskWatch(self.scheduler, self.names)

    async def close(self) -> None:
        """Stop the periodic checks when the scheduler closes."""
        if self._task_watch is not None:
            self._task_watch.close()

    def _inherited_resources(self, task: Any) -> Resources:
        """Return the resources that nested tasks inherit from a task, empty outside partitions."""
        resources = task.resource_restrictions
        return dict.fromkeys(self.names & resources.keys(), 1) if resources else {}

    def uninstall(self) -> None:
        """Remove all rules and the plugin from the scheduler."""
        self._rules.remove_all()
        if self._choice is not None:
            self._choice.uninstall()
        if self._unreadable is not None:
            self._unreadable.uninstall()
        if self._blame is not None:
            self._blame.uninstall()
        if self._task_watch is not None:
            self._task_watch.uninstall()
        self.scheduler.remove_plugin(NAME)


class _Inheriting(Feature):
    """Feature that makes nested tasks inherit the partition."""

    def enable(self, scheduler: Any, names: Iterable[str]) -> str:
        """Keep nested tasks and shuffles within the given partitions from now on."""
        rule: Inheritance = scheduler.plugins.get(NAME) or Inheritance(scheduler)
        for name in names:
            if name not in rule.names:
                rule.names.add(name)
                if rule.lends:
                    _inform_workers(scheduler, name, lending_plugin(name))
        return rule.note

    def disable(self, scheduler: Any, name: str) -> None:
        """Disable inheritance in the given partition."""
        rule: Inheritance | None = scheduler.plugins.get(NAME)
        if rule is None or name not in rule.names:
            return
        rule.names.discard(name)
        _inform_workers(scheduler, name, None)
        if not rule.names:
            rule.uninstall()

    def names(self, scheduler: Any) -> Set[str]:
        """Return the names of the partitions with inheritance."""
        rule: Inheritance | None = scheduler.plugins.get(NAME)
        return frozenset() if rule is None else rule.names

    async def wait_for_workers(self) -> None:
        """Wait at most `ANSWER_S` seconds until all workers have started or stopped lending."""
        loop = asyncio.get_running_loop()
        requests = {request for request in _requests if request.get_loop() is loop}
        if requests:
            await asyncio.wait(requests, timeout=ANSWER_S)


FEATURES.append(_Inheriting())


# -- requests to workers, which lend slots -------------------------------------------------

_requests: set[asyncio.Future[Any]] = set()  # requests in flight of all schedulers in this process


def _inform_workers(scheduler: Any, name: str, plugin: bytes | None) -> None:
    """Install a partition's lending plugin on all workers, or remove it if `plugin` is None."""
    for request in set_worker_plugin(scheduler, f"poolpart-lending-{name}", plugin):
        _requests.add(request)
        request.add_done_callback(_requests.discard)
