"""Hold tasks back on the scheduler, and assign them to workers later, through private API."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from .method_rules import MethodRules

LOANS = "poolpart-loans"  # topic of events about tasks that lend their slots
_LETTERS = 3  # number of elements of Dask's priorities


def add_holding_rules(
    rules: MethodRules,
    scheduler: Any,
    *,
    choose: Callable[[Any], Any],
    is_held: Callable[[Any], bool],
    admit: Callable[[Any], None],
    restrict: Callable[[Any, Any], Any],
    record_move: Callable[[Any, Any, Any, Any], Any],
) -> None:
    """Let poolpart decide when tasks are assigned to workers.

    Parameters
    ----------
    rules, scheduler
        Rules to which these are added, and the scheduler.
    choose
        Function that returns the worker for a task that is ready to run, None to hold the task in
        the state "no-worker", or NotImplemented.
    is_held
        Function that returns whether a task in this state is held.
    admit
        Function that is called with a worker that has joined, resumed, or received resources.
    restrict
        Function that returns the valid workers of a task, given those according to Dask.
    record_move
        Function that is called with the result and the arguments of `move_task_request`, which asks
        a worker to give up a task, and that returns the result.

    Raises
    ------
    PoolError
        If this version of Dask lacks the required private API.
    """

    def schedule_other_tasks(worker: Any) -> dict[Any, str]:
        """Recommend the tasks that wait for a worker like this one, except for held tasks."""
        admit(worker)
        waiting = [task for task in scheduler.unrunnable if not is_held(task)]
        waiting = [task for task in waiting if _may_run(scheduler, task, worker)]
        # Dask follows the last recommendation first.
        waiting.sort(key=lambda task: task.priority, reverse=True)
        return {task.key: "processing" for task in waiting}

    rules.call_instead(scheduler, "decide_worker_non_rootish", choose, "ts")
    rules.call_instead(
        scheduler, "bulk_schedule_unrunnable_after_adding_worker", schedule_other_tasks, "ws"
    )
    rules.call_after(scheduler, "valid_workers", restrict, "ts")
    if (stealing := scheduler.extensions.get("stealing")) is not None:
        rules.call_after(stealing, "move_task_request", record_move, "thief")


def _may_run(scheduler: Any, task: Any, worker: Any) -> bool:
    valid = scheduler.valid_workers(task)
    return valid is None or worker in valid


def hold_task(scheduler: Any, task: Any, now: float) -> None:
    """Change the state of a task to "no-worker" while Dask chooses its worker.

    Dask would make this change in a further transition, which costs several microseconds per task.
    The transition that chooses the worker reports the new state instead. `now` is the result of
    `time.monotonic`.
    """
    task.state = "no-worker"
    scheduler.unrunnable[task] = now


def assign_held_tasks(scheduler: Any, tasks: Iterable[Any]) -> None:
    """Assign tasks in the state "no-worker" to workers, in the given order."""
    # Dask follows the last recommendation first.
    keys = [task.key for task in tasks if task.state == "no-worker"]
    scheduler.transitions(dict.fromkeys(reversed(keys), "processing"), f"poolpart-{time.time()}")


def priority_of_assigned(scheduler: Any, task: Any, number: int) -> tuple[float, ...]:
    """Return the priority with which a worker runs assigned tasks in the order of their numbers.

    Among the other tasks on the worker, it is the default priority of a task submitted now.
    """
    return (0, scheduler.generation, number, *task.priority)


def priority_of_waiting(task: Any) -> tuple[float, ...]:
    """Return the priority that Dask gave to a task."""
    priority: tuple[float, ...] = task.priority
    return priority[_LETTERS:] or priority


def refresh_waiting_times(scheduler: Any, tasks: Iterable[Any]) -> None:
    """Keep held tasks from failing because of ``distributed.scheduler.no-workers-timeout``."""
    if scheduler.no_workers_timeout:
        now = time.monotonic()
        for task in tasks:
            del scheduler.unrunnable[task]
            scheduler.unrunnable[task] = now
