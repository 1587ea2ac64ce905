"""State of the scheduler, to check what a run leaves behind."""

from __future__ import annotations

import time
from typing import Any

from distributed import Client

from poolpart.pipe_states import pipes_of

SETTLE_S = 300.0  # for what was closed to be gone: connections end a moment later


def scheduler_state(client: Client) -> dict[str, Any]:
    """Return the state of the scheduler as sets and counts that can be compared."""
    state: dict[str, Any] = client.run_on_scheduler(_look)
    return state


def _look(dask_scheduler: Any) -> dict[str, Any]:
    extensions = dask_scheduler.extensions
    queues = extensions["queues"]
    variables = extensions["variables"]
    events = extensions.get("events")
    locks = extensions.get("semaphores")
    return {
        "tasks": sorted(map(str, dask_scheduler.tasks)),
        "unrunnable": sorted(str(task.key) for task in dask_scheduler.unrunnable),
        "queued": len(dask_scheduler.queued),
        "clients": len(dask_scheduler.clients) - _clients_of_workers(dask_scheduler),
        "pipes": sorted(pipes_of(dask_scheduler)),
        "queues": sorted(queues.queues),
        "queue references": sorted(map(str, queues.client_refcount)),
        "queued futures": sorted(map(str, queues.future_refcount)),
        "variables": sorted(variables.variables),
        "variables waited for": sorted(map(str, variables.waiting)),
        "variable conditions": sorted(map(str, getattr(variables, "waiting_conditions", ()))),
        "events": sorted(map(str, getattr(events, "_events", ()))),
        "semaphores": sorted(map(str, getattr(locks, "leases", ()))),
        "plugins": sorted(dask_scheduler.plugins),
        "worker plugins": sorted(dask_scheduler.worker_plugins),
        "nanny plugins": sorted(dask_scheduler.nanny_plugins),
        "extensions": sorted(extensions),
        "handlers": sorted(dask_scheduler.handlers),
        "stream handlers": sorted(dask_scheduler.stream_handlers),
        "workers": sorted(str(worker.name) for worker in dask_scheduler.workers.values()),
        "resources": {
            str(worker.name): dict(worker.resources) for worker in dask_scheduler.workers.values()
        },
        # Not what Dask counts: a stolen task stays with the worker that it was taken from.
        "resources used": {
            str(worker.name): [task.resource_restrictions for task in worker.processing]
            for worker in dask_scheduler.workers.values()
        },
        "host restrictions": sorted(map(str, getattr(dask_scheduler, "host_restrictions", ()))),
    }


def _clients_of_workers(dask_scheduler: Any) -> int:
    """Count the clients of workers.

    A worker whose tasks have used a client keeps it until the worker leaves.
    """
    return sum(str(name).startswith("Client-worker") for name in dask_scheduler.clients)


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Describe all differences between two states."""
    return [
        f"{name}: {before.get(name)} before, {after.get(name)} after"
        for name in sorted(before.keys() | after.keys())
        if before.get(name) != after.get(name)
    ]


def settled_differences(client: Client, before: dict[str, Any]) -> list[str]:
    """Describe how the scheduler's state differs from `before`.

    Wait until connections that were closed are gone.
    """
    deadline = time.monotonic() + SETTLE_S
    while (left := differences(before, scheduler_state(client))) and time.monotonic() < deadline:
        time.sleep(0.2)
    return left
