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

from collections.abc import Callable
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .override import Overrides
from .remote import on_scheduler

NAME = "poolpart-inherit"


def inherit(client: Client, name: str) -> None:
    """Have tasks that tasks of the partition submit belong to it, from now on.

    Raises
    ------
    PoolError
        If the scheduler lacks this package, or what this needs of Dask.
    """
    on_scheduler(client, _inherit, name=name)


def disinherit(client: Client, name: str) -> None:
    """Leave it to Dask again where such tasks go; nothing is left behind."""
    on_scheduler(client, _disinherit, name=name)


async def _inherit(name: str, dask_scheduler: Any = None) -> None:
    begin_inheritance(dask_scheduler, name)


async def _disinherit(name: str, dask_scheduler: Any = None) -> None:
    end_inheritance(dask_scheduler, name)


def begin_inheritance(scheduler: Any, name: str) -> None:
    """Do what `inherit` does, on the scheduler."""
    rule: Inheritance | None = scheduler.plugins.get(NAME)
    if rule is None:
        rule = Inheritance(scheduler)
        rule.install()
    rule.names.add(name)


def end_inheritance(scheduler: Any, name: str) -> None:
    """Do what `disinherit` does, on the scheduler."""
    rule: Inheritance | None = scheduler.plugins.get(NAME)
    if rule is not None:
        rule.names.discard(name)
        if not rule.names:
            rule.uninstall()


class Inheritance(SchedulerPlugin):
    """The scheduler's side: looks at each graph before its tasks are made."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.names: set[str] = set()
        self._overrides = Overrides()

    def install(self) -> None:
        """See all graphs from now on."""
        self._overrides.put(
            self.scheduler,
            {
                "_create_taskstate_from_graph": self._create,
                "valid_workers": self._valid_workers,
            },
        )
        self.scheduler.add_plugin(self)

    def uninstall(self) -> None:
        """Take that back."""
        self._overrides.take_back()
        self.scheduler.remove_plugin(NAME)

    def _create(
        self,
        original: Callable[..., Any],
        *,
        submitting_task: Any,
        annotations_by_type: dict[str, dict[Any, Any]],
        global_annotations: dict[str, Any] | None,
        **graph: Any,
    ) -> Any:
        legacy = self._legacy(submitting_task)
        given = global_annotations or {}
        if legacy and "resources" not in given and "workers" not in given:
            # Those of its tasks that say themselves where to run: {key: workers or resources}
            otherwise = {
                **annotations_by_type.get("workers", {}),
                **annotations_by_type.get("resources", {}),
            }
            heirs = {key: legacy for key in graph["dsk"] if key not in otherwise}
            annotations_by_type = {
                **annotations_by_type,
                "resources": {**annotations_by_type.get("resources", {}), **heirs},
            }
        return original(
            submitting_task=submitting_task,
            annotations_by_type=annotations_by_type,
            global_annotations=global_annotations,
            **graph,
        )

    def _legacy(self, submitting_task: Any) -> dict[str, int]:
        """Resources for what a task submits; none if it belongs to no partition."""
        task = self.scheduler.tasks.get(submitting_task)
        asked = task.resource_restrictions if task is not None else None
        return dict.fromkeys(self.names & asked.keys(), 0) if asked else {}

    def _valid_workers(self, original: Callable[..., Any], task: Any) -> Any:
        """Workers that have none of a resource any more would do for a task that needs 0."""
        valid, asked = original(task), task.resource_restrictions
        if not asked or 0 not in asked.values():
            return valid
        return {worker for worker in valid if all(worker.resources.get(name) for name in asked)}
