"""Task and worker states on which the scheduler bases the placement of tasks."""

from __future__ import annotations

from functools import partial
from typing import Any


def only_resource_of(task: Any) -> tuple[str, float] | None:
    """Return the name and amount of a task's only resource, or ("", 1) if it requests none.

    The result is None if the task is bound to workers or hosts, requests several resources, or is
    an actor.
    """
    resources = task.resource_restrictions or {}
    if task.worker_restrictions or task.host_restrictions or task.actor or len(resources) > 1:
        return None
    return next(iter(resources.items()), ("", 1))


def workers_declaring(scheduler: Any, name: str) -> list[Any]:
    """Return the states of all workers that declare a resource."""
    return [scheduler.workers[address] for address in scheduler.resources.get(name, ())]


def has_worker_for(scheduler: Any, name: str, slots: float) -> bool:
    """Return whether any worker declares at least `slots` of a resource."""
    return any(declared >= slots for declared in scheduler.resources.get(name, {}).values())


def memory_limit(worker: Any) -> int:
    """Return the memory limit of a worker in bytes, or 0 if it has none."""
    return int(worker.memory_limit or 0)


def free_threads_of(worker: Any) -> int:
    """Return the number of a worker's threads without a task."""
    return int(worker.nthreads - len(worker.processing) + len(worker.long_running))


def can_run(scheduler: Any, worker: Any, name: str, slots: float) -> bool:
    """Return whether a worker is running and, if a resource is named, declares enough slots."""
    enough = not name or worker.resources.get(name, 0) >= slots
    return bool(enough and worker in scheduler.running)


def holders_of_inputs(task: Any) -> list[Any]:
    """Return the workers that hold a task's inputs, with one entry per copy of an input."""
    return [worker for task_input in task.dependencies for worker in task_input.who_has or ()]


def earliest_worker(scheduler: Any, task: Any, workers: list[Any]) -> Any:
    """Return the worker on which a task is expected to start first, according to Dask."""
    return min(workers, key=partial(scheduler.worker_objective, task))
