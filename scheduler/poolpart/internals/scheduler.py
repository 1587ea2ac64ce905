"""What runs in the event loop of a scheduler: placing, moving and retiring, requests, pages."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any, NamedTuple

from dask.utils import key_split
from distributed import Status
from distributed.protocol.pickle import dumps
from tornado import web

Resources = dict[str, float]

SUBMITTER = "poolpart-submitter"  # annotation of tasks that a task of a partition submits


class SubmittingTask(NamedTuple):
    """A task of a partition that has submitted another: value of the annotation."""

    key: Any
    worker: str  # address of the worker that it ran on


# -- where the scheduler places tasks ----------------------------------------------------


def set_visible_resources(scheduler: Any, worker: Any, resources: Resources) -> None:
    """Make the scheduler use only the given resources when it places tasks on a worker."""
    for name in worker.resources.keys() | resources.keys():
        declaring = scheduler.resources.setdefault(name, {})
        declaring.pop(worker.address, None)
        if name in resources:
            declaring[worker.address] = resources[name]
        elif not declaring:
            del scheduler.resources[name]
    worker.resources = dict(resources)
    recount_used_resources(worker)


def recount_used_resources(worker: Any) -> None:
    """Recount the resources in use.

    Dask forgets them when a worker declares something while it is busy, and counts a task
    that was moved by work stealing against the worker that it was moved from.
    """
    # Also resources that it no longer declares: a stolen task may still come.
    worker.used_resources = defaultdict(float, dict.fromkeys(worker.resources, 0))
    for task in worker.processing:
        for name, quantity in (task.resource_restrictions or {}).items():
            worker.used_resources[name] += quantity


def send_waiting_tasks(scheduler: Any, worker: Any) -> None:
    """Send a worker the tasks that wait for its resources, as when a worker joins.

    The scheduler does not when a running worker gets a resource: the tasks would wait for ever.
    """
    if worker in scheduler.running:
        stimulus = f"poolpart-{worker.address}-{time.time()}"
        scheduler.transitions(
            scheduler.bulk_schedule_unrunnable_after_adding_worker(worker), stimulus
        )


def admit_other_tasks(scheduler: Any, worker: Any) -> None:
    """Send tasks to a worker that has been behind a fence."""
    scheduler.check_idle_saturated(worker)
    if worker.status is Status.running:
        send_waiting_tasks(scheduler, worker)
        scheduler.stimulus_queue_slots_maybe_opened(stimulus_id=f"poolpart-opened-{time.time()}")


def actor_of_method(scheduler: Any, name: Any) -> Any:
    """Return the state of an actor by Dask's name for a method that submits tasks, or None.

    The name consists of the prefix of the actor's key and the method. None if the name has another
    form, or if actors with the same prefix ask for different resources, so that the actor is not
    certain.
    """
    prefix, dot, _ = name.rpartition(".") if isinstance(name, str) else ("", "", "")
    if not dot:
        return None
    actors = [
        task
        for worker in scheduler.workers.values()
        for task in worker.actors
        if key_split(task.key) == prefix
    ]
    resources = [actor.resource_restrictions for actor in actors]
    return (
        actors[0]
        if actors and all(restrictions == resources[0] for restrictions in resources)
        else None
    )


def requires_any(task: Any, names: Collection[str]) -> bool:
    """Return whether a task takes a slot of any of the named partitions."""
    return not (task.resource_restrictions or {}).keys().isdisjoint(names)


def lift_restrictions(scheduler: Any, names: Collection[str]) -> None:
    """Let any worker recompute results that are still held, if they are lost.

    No worker has the task's resource any more: the task would wait for ever.
    """
    for task in scheduler.tasks.values():
        if requires_any(task, names):
            restrictions = task.resource_restrictions.items()
            remaining = {name: slots for name, slots in restrictions if name not in names}
            task.resource_restrictions = remaining or None


# -- moving waiting tasks, by the protocol of work stealing --------------------------------
#
# A worker gives up a task on request unless the task runs; then another worker gets it.


def keys_held_by(scheduler: Any, worker: Any, names: Collection[str]) -> list[str]:
    """Return the keys of tasks with these resources that a worker has or is about to get."""
    tasks = {task for task in worker.processing if requires_any(task, names)}
    if stealing := scheduler.extensions.get("stealing"):
        moves = stealing.in_flight.items()
        tasks |= {
            task for task, move in moves if move["thief"] is worker and requires_any(task, names)
        }
    return [task.key for task in tasks]


def hand_off_tasks(
    scheduler: Any, worker: Any, names: Collection[str], requested: set[Any]
) -> None:
    """Move the tasks of a worker that have not started to further members of their partition.

    A task that no other worker may take stays, and ends on this worker.

    Parameters
    ----------
    scheduler, worker
        Their states.
    names
        Partitions that the worker leaves.
    requested
        States of the tasks that the worker was asked to give up; extended.
    """
    stealing = scheduler.extensions.get("stealing")
    if stealing is None:
        return
    # {worker: tasks on their way to it}. The scheduler counts a task when the old worker agrees.
    moving = Counter[Any]()
    for task in list(worker.processing - worker.long_running):
        if task in requested or task.actor or not requires_any(task, names):
            continue
        requested.add(task)
        if candidates := (scheduler.valid_workers(task) or set()) - {worker}:
            thief = min(candidates, key=lambda w: (len(w.processing) + moving[w]) / w.nthreads)
            moving[thief] += 1
            stealing.move_task_request(task, worker, thief)


# -- workers that a cluster gives back ----------------------------------------------------
#
# Once a worker is found idle, it gets no tasks from this step of the event loop on. What
# `retire_workers` does comes later: it waits for a lock, and for its turn.


def is_idle(scheduler: Any, worker: Any) -> bool:
    """Return whether a running worker has no task, and no result that no further worker has."""
    return worker.status is Status.running and holds_nothing(scheduler, worker)


def holds_nothing(scheduler: Any, worker: Any) -> bool:
    """Return whether a worker has no task, and no result that no further worker has.

    It may still run tasks that the scheduler has forgotten.
    """
    if worker.processing or worker.actors:
        return False
    stealing = scheduler.extensions.get("stealing")
    moves = stealing.in_flight.values() if stealing else ()
    if any(move["thief"] is worker for move in moves):  # a task is on its way
        return False
    return all(len(task.who_has) > 1 for task in worker.has_what)


def accepts_tasks(worker: Any) -> bool:
    """Return whether a worker gets tasks now, or after joining."""
    return worker.status in (Status.running, Status.init)


def stop_assigning(scheduler: Any, worker: Any) -> None:
    """Let a worker get no further tasks."""
    stimulus = f"poolpart-shut-{time.time()}"
    scheduler.handle_worker_status_change(Status.closing_gracefully, worker, stimulus)


def resume_assigning(scheduler: Any, worker: Any) -> None:
    """Let a worker get tasks again after `stop_assigning`, or after a retirement that failed."""
    if scheduler.workers.get(worker.address) is worker:
        stimulus = f"poolpart-reopened-{time.time()}"
        message = {"op": "worker-status-change", "status": "running", "stimulus_id": stimulus}
        scheduler.stream_comms[worker.address].send(message)
        scheduler.handle_worker_status_change(Status.running, worker, stimulus)


async def retire_workers(scheduler: Any, workers: Collection[Any]) -> bool:
    """Close workers. Return False if one stays because no other worker can take its results."""
    addresses = [worker.address for worker in workers]
    retired = await scheduler.retire_workers(workers=addresses, close_workers=True, remove=True)
    return len(retired) == len(addresses)


def reject_worker(scheduler: Any, worker: Any) -> None:
    """Close a joining worker before the worker gets tasks of a partition."""
    stop_assigning(scheduler, worker)
    # A worker that joins says that it is running before it reads that it has to close.
    set_visible_resources(scheduler, worker, {})
    scheduler.close_worker(worker.address)


def count_transitions(scheduler: Any) -> int:
    """Return how often tasks have changed their state: equal numbers mean that nothing happened."""
    return int(scheduler.transition_counter)


def cancel_keys(scheduler: Any, keys: Collection[Any], client: str) -> None:
    """Cancel tasks for a client, by its id, as `Client.cancel` does, and skip unknown tasks."""
    scheduler.stimulus_cancel(
        list(keys), client=client, force=False, reason="unknown", msg="by Partition.cancel"
    )


async def restart_worker(scheduler: Any, worker: Any, seconds: float) -> bool:
    """Restart a worker through its nanny, or return False if it does not rejoin in time."""
    try:
        await scheduler.restart_workers(
            [worker.address], timeout=seconds, stimulus_id=f"poolpart-restart-{time.time()}"
        )
    except TimeoutError:
        return False
    return True


def fail_task(scheduler: Any, task: Any, worker: str, error: Exception) -> None:
    """Let a task fail that waits for its inputs on a worker, or run again if it has retries."""
    from distributed.core import error_message

    stimulus = f"poolpart-failed-{time.time()}"
    message = {name: part for name, part in error_message(error).items() if name != "status"}
    scheduler.handle_task_erred(
        key=task.key, stimulus_id=stimulus, worker=worker, run_id=task.run_id, **message
    )
    if task.state == "erred":  # the worker still waits for the inputs, and would keep the task
        free = {"op": "free-keys", "keys": [task.key], "stimulus_id": stimulus}
        scheduler.stream_comms[worker].send(free)


def reschedule_tasks(scheduler: Any, tasks: Collection[Any]) -> None:
    """Take tasks from their workers, and place them anew."""
    stimulus = f"poolpart-again-{time.time()}"
    scheduler.transitions({task.key: "waiting" for task in tasks}, stimulus)


def is_bound(task: Any) -> bool:
    """Return whether a task may run on certain workers only."""
    return bool(task.worker_restrictions or task.host_restrictions) and not task.loose_restrictions


def unrunnable_tasks(scheduler: Any) -> Collection[Any]:
    """Return the tasks that could run but have no worker."""
    tasks: Collection[Any] = scheduler.unrunnable
    return tasks


async def run_on_cluster_scheduler(
    cluster: Any, function: Callable[..., Any], **arguments: Any
) -> Any:
    """Call `function(**arguments, dask_scheduler=…)` on a cluster's scheduler, without a client."""
    from distributed.core import clean_exception

    packed = {"function": dumps(function), "args": dumps(()), "kwargs": dumps(arguments)}
    answer = await cluster.scheduler_comm.run_function(**packed, wait=True)
    if answer["status"] != "OK":
        raise clean_exception(**answer)[1]
    return _unpacked(answer["result"])


async def call_worker(
    scheduler: Any, address: str, function: Callable[..., Any], **arguments: Any
) -> Any:
    """Call a function in the event loop of a worker, passed as `dask_worker`.

    Raises OSError if the worker does not respond or the function raises an exception.
    """
    answer = await scheduler.rpc(address).run(function=dumps(function), kwargs=dumps(arguments))
    if answer["status"] != "OK":
        raise OSError(answer["exception_text"])
    return _unpacked(answer["result"])


def _unpacked(result: Any) -> Any:
    """Return the object of a reply: serialized, or wrapped by a server of this process."""
    from distributed.protocol.serialize import Serialize, Serialized, deserialize

    if isinstance(result, Serialized):
        return deserialize(result.header, result.frames)
    return result.data if isinstance(result, Serialize) else result


def set_worker_plugin(scheduler: Any, name: str, plugin: bytes | None) -> list[asyncio.Future[Any]]:
    """Add a plugin to all workers, present and future, or remove the plugin if None.

    Returns the requests under way. A worker that does not answer, at the end of a cluster, is left.
    """

    # Nested, so that it is sent by value. A worker that is closing removes its plugins itself;
    # Dask logs a traceback if a plugin was removed before.
    def remove(dask_worker: Any = None) -> None:
        closing = dask_worker.status.name in ("closing", "closed")
        if not closing and (removed := dask_worker.plugins.pop(name, None)):
            removed.teardown(dask_worker)

    async def tell(address: str) -> None:
        with suppress(OSError, RuntimeError):  # `Scheduler.broadcast` would print it
            if plugin is None:
                await call_worker(scheduler, address, remove)
            else:
                await getattr(scheduler.rpc(address), "plugin-add")(name=name, plugin=plugin)

    if plugin is None:
        scheduler.worker_plugins.pop(name, None)
    else:
        scheduler.worker_plugins[name] = plugin
    # Each by itself: one that is stopped keeps none of the others.
    return [asyncio.ensure_future(tell(address)) for address in scheduler.workers]


# -- requests to a scheduler, which pipes are made of -------------------------------------
#
# `run_on_scheduler` pickles its function for each request, which takes twice the time of a handler.


def handlers_of(scheduler: Any) -> dict[str, Any]:
    """Handlers of a scheduler, by request, which exchange plain data with their callers."""
    handlers: dict[str, Any] = scheduler.handlers
    return handlers


# -- the scheduler's HTTP server ---------------------------------------------------------


def add_pages(scheduler: Any, application: web.Application) -> None:
    """Add pages to the scheduler's HTTP server."""
    scheduler.http_application.add_application(application)


def remove_pages(scheduler: Any, application: web.Application) -> None:
    """Remove pages from the scheduler's HTTP server."""
    scheduler.http_application.applications.remove(application)
