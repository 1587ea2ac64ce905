"""Taking tasks back that a worker has not started; this runs on the scheduler.

Work stealing has a protocol for that: the worker is asked, and gives a task up unless it runs.
The thief in whose name this asks is one that has left, so that the scheduler does not send the
task there, but decides anew where it goes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

from distributed.core import Status
from distributed.scheduler import WorkerState

_NAME = "poolpart-nobody"


def ask_back(scheduler: Any, worker: Any, tasks: Iterable[Any]) -> list[Any]:
    """Ask a worker for tasks; returns those that it was asked for.

    It is not asked for actors and for what runs for long, nor for what somebody is stealing
    from it already.
    """
    stealing = scheduler.extensions.get("stealing")
    if stealing is None:
        return []
    asked = [
        task
        for task in tasks
        if not (task.actor or task in worker.long_running or task in stealing.in_flight)
    ]
    for task in asked:
        stealing.move_task_request(task, worker, _nobody(scheduler))
    return asked


def requests_under_way(
    scheduler: Any, workers: Collection[Any], concerns: Callable[[Any], bool]
) -> bool:
    """Whether workers have yet to answer to `ask_back`.

    Or to whoever steals tasks from these workers, or for them, of those that it `concerns`.
    """
    stealing = scheduler.extensions.get("stealing")
    moves = stealing.in_flight.items() if stealing else ()
    return any(
        move["thief"].server_id == _NAME
        or (concerns(task) and not {move["thief"], move["victim"]}.isdisjoint(workers))
        for task, move in moves
    )


def forget_requests(scheduler: Any) -> None:
    """Leave nothing of them with work stealing."""
    if stealing := scheduler.extensions.get("stealing"):
        stealing.in_flight_tasks.pop(_nobody(scheduler), None)


def _nobody(scheduler: Any) -> Any:
    return WorkerState(
        address="tcp://0.0.0.0:0",
        status=Status.closed,
        pid=0,
        name=_NAME,
        nthreads=1,
        memory_limit=0,
        local_directory="",
        nanny=None,
        server_id=_NAME,
        scheduler=scheduler,
    )
