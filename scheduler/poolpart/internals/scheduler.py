"""Functions for the scheduler's event loop that use private API, mostly to place and move tasks."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from typing import Any, NamedTuple

from dask.utils import key_split
from distributed import Status
from distributed.protocol.pickle import dumps
from tornado import web

Resources = dict[str, float]

SUBMITTER = "poolpart-submitter"  # annotation of nested tasks, a `SubmittingTask`


class SubmittingTask(NamedTuple):
    """Task of a partition that has submitted another task. It is stored in an annotation."""

    key: Any
    worker: str  # address of the worker on which it ran when it submitted the other task


# -- placement of tasks ------------------------------------------------------------------


def set_visible_resources(scheduler: Any, worker: Any, resources: Resources) -> None:
    """Set the resources that the scheduler considers when it places tasks on a worker."""
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
    """Recount a worker's resources in use, which Dask miscounts in two cases.

    Dask resets them when a busy worker declares resources, and attributes a task that was moved by
    work stealing to the original worker.
    """
    # The default is required for undeclared resources, because a stolen task may still arrive.
    worker.used_resources = defaultdict(float, dict.fromkeys(worker.resources, 0))
    for task in worker.processing:
        for name, quantity in (task.resource_restrictions or {}).items():
            worker.used_resources[name] += quantity


def used_slots(worker: Any, name: str) -> float:
    """Return the slots that a worker's tasks in a partition request, even before they start."""
    return float(worker.used_resources.get(name, 0.0))


def send_waiting_tasks(scheduler: Any, worker: Any) -> None:
    """Send tasks to a worker that have been waiting for its resources.

    Dask only does this when a worker joins. If a running worker gets a resource, the tasks would
    wait forever.
    """
    if worker in scheduler.running:
        stimulus = f"poolpart-{worker.address}-{time.time()}"
        scheduler.transitions(
            scheduler.bulk_schedule_unrunnable_after_adding_worker(worker), stimulus
        )


def admit_other_tasks(scheduler: Any, worker: Any) -> None:
    """Send waiting tasks to a worker that is no longer within a fence."""
    scheduler.check_idle_saturated(worker)
    if worker.status is Status.running:
        send_waiting_tasks(scheduler, worker)
        scheduler.stimulus_queue_slots_maybe_opened(stimulus_id=f"poolpart-opened-{time.time()}")


def actor_of_method(scheduler: Any, name: Any) -> Any:
    """Return the state of the actor that has submitted tasks in a method, or None.

    Dask's name for the submitting method consists of the prefix of the actor's key and the name of
    the method. The result is None if the name has another form, or if actors with this prefix
    request different resources, so that the actor is ambiguous.
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
    """Return whether a task occupies a slot in one of the named partitions."""
    return not (task.resource_restrictions or {}).keys().isdisjoint(names)


def lift_restrictions(scheduler: Any, names: Collection[str]) -> None:
    """Let any worker recompute results of dissolved partitions that are still needed.

    Otherwise, lost results would wait forever, because no worker declares their resource anymore.
    """
    for task in scheduler.tasks.values():
        if requires_any(task, names):
            restrictions = task.resource_restrictions.items()
            remaining = {name: slots for name, slots in restrictions if name not in names}
            task.resource_restrictions = remaining or None


# -- running tasks -------------------------------------------------------------------------


def reported_tasks(worker: Any) -> set[Any]:
    """Return the tasks that a worker runs according to its last heartbeat, or that have seceded."""
    return (worker.executing.keys() & worker.processing) | worker.long_running


def in_running_order(worker: Any) -> list[Any]:
    """Return a worker's tasks in the order in which it is assumed to run them."""
    return sorted(worker.processing, key=lambda t: (t not in worker.executing, t.priority))


def running_candidates(worker: Any) -> set[Any]:
    """Return the tasks that a worker runs, or may run, as far as the scheduler knows.

    These are the tasks in the last heartbeat of the worker, tasks that have seceded, and in the
    remaining slots the tasks with the highest priority. A task that has seceded may have lent its
    slots.
    """
    running = reported_tasks(worker)
    free = dict(worker.resources)
    threads = worker.nthreads
    for task in running - worker.long_running:
        threads -= 1
        for name, slots in (task.resource_restrictions or {}).items():
            free[name] = free.get(name, 0) - slots
    for task in sorted(worker.processing - running, key=lambda task: task.priority):
        slots = task.resource_restrictions or {}
        if any(free.get(name, 0) < number for name, number in slots.items()):
            continue
        if slots or threads > 0:
            running.add(task)
            threads -= 1
            free.update({name: free[name] - number for name, number in slots.items()})
    return running


def acquit_tasks(tasks: Iterable[Any]) -> None:
    """Compensate the next death that Dask counts against each of these tasks."""
    for task in tasks:
        task.suspicious -= 1
        task.prefix.suspicious -= 1


# -- moving waiting tasks with the work stealing protocol -----------------------------------
#
# On request, a worker gives up a task that it has not started, and another worker receives it.


def keys_held_by(scheduler: Any, worker: Any, names: Collection[str]) -> list[str]:
    """Return the keys of a worker's tasks in the named partitions, including tasks in transfer."""
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
    """Move tasks that have not started to other members of their partition.

    A task that no other worker can run stays on this worker.

    Parameters
    ----------
    scheduler, worker
        Their states.
    names
        Names of the partitions that the worker leaves.
    requested
        States of the tasks that the worker was already asked to give up. This set is updated.
    """
    stealing = scheduler.extensions.get("stealing")
    if stealing is None:
        return
    # {worker: number of tasks that are being moved to it}. The scheduler only counts a task for its
    # new worker when the old worker has given it up.
    moving = Counter[Any]()
    for task in list(worker.processing - worker.long_running):
        if task in requested or task.actor or not requires_any(task, names):
            continue
        requested.add(task)
        if candidates := (scheduler.valid_workers(task) or set()) - {worker}:
            thief = min(candidates, key=lambda w: (len(w.processing) + moving[w]) / w.nthreads)
            moving[thief] += 1
            stealing.move_task_request(task, worker, thief)


def accepts_moves(scheduler: Any, task: Any) -> bool:
    """Return whether a task can be moved, and is not being moved already."""
    can_move = scheduler.extensions.get("stealing") is not None
    return can_move and not task.actor and not is_moving(scheduler, task)


def is_moving(scheduler: Any, task: Any) -> bool:
    """Return whether a worker was asked to give up a task and has not replied."""
    return task in scheduler.extensions["stealing"].in_flight


def move_task(scheduler: Any, task: Any, target: Any) -> None:
    """Ask the worker of a task to give it up to another worker, unless it has started the task."""
    scheduler.extensions["stealing"].move_task_request(task, task.processing_on, target)


# -- closing idle workers -----------------------------------------------------------------
#
# Tasks must not be assigned to a worker after it was found idle. `stop_assigning` takes effect in
# the same step of the event loop, unlike `retire_workers`, which first waits for a lock.


def is_idle(scheduler: Any, worker: Any) -> bool:
    """Return whether a worker is running and has neither tasks nor the only copy of a result."""
    return worker.status is Status.running and holds_nothing(scheduler, worker)


def holds_nothing(scheduler: Any, worker: Any) -> bool:
    """Return whether a worker has neither tasks nor the only copy of a result.

    It may still be running tasks that the scheduler has forgotten.
    """
    if worker.processing or worker.actors:
        return False
    stealing = scheduler.extensions.get("stealing")
    moves = stealing.in_flight.values() if stealing else ()
    if any(move["thief"] is worker for move in moves):  # a task is being moved to the worker
        return False
    return not only_copies(worker)


def only_copies(worker: Any) -> list[Any]:
    """Return the tasks whose results only this worker holds."""
    return [task for task in worker.has_what if len(task.who_has) == 1]


async def copy_results(scheduler: Any, workers: Collection[Any], name: str) -> None:
    """Copy results of which workers have the only copy to another worker of a partition.

    The other worker is the one with the fewest bytes of results. If a result cannot be copied, Dask
    logs a warning.
    """
    members = (worker for worker in scheduler.running if worker.resources.get(name))
    others = [worker for worker in members if worker not in workers]
    holders = {task.key: [worker.address] for worker in workers for task in only_copies(worker)}
    if others and holders:
        target = min(others, key=lambda worker: worker.nbytes)
        await scheduler.gather_on_worker(target.address, holders)


def accepts_tasks(worker: Any) -> bool:
    """Return whether a worker accepts tasks, either now or once it has joined."""
    return worker.status in (Status.running, Status.init)


def stop_assigning(scheduler: Any, worker: Any) -> None:
    """Stop assigning tasks to a worker."""
    stimulus = f"poolpart-shut-{time.time()}"
    scheduler.handle_worker_status_change(Status.closing_gracefully, worker, stimulus)


def resume_assigning(scheduler: Any, worker: Any) -> None:
    """Assign tasks to a worker again, after `stop_assigning` or a failed retirement."""
    if scheduler.workers.get(worker.address) is worker:
        stimulus = f"poolpart-reopened-{time.time()}"
        message = {"op": "worker-status-change", "status": "running", "stimulus_id": stimulus}
        scheduler.stream_comms[worker.address].send(message)
        scheduler.handle_worker_status_change(Status.running, worker, stimulus)


async def retire_workers(scheduler: Any, workers: Collection[Any]) -> bool:
    """Retire workers, and return whether all of them were closed.

    A worker is not closed if no other worker can store its results.
    """
    addresses = [worker.address for worker in workers]
    retired = await scheduler.retire_workers(workers=addresses, close_workers=True, remove=True)
    return len(retired) == len(addresses)


def reject_worker(scheduler: Any, worker: Any) -> None:
    """Close a joining worker before it receives any tasks of a partition."""
    stop_assigning(scheduler, worker)
    # The worker reports that it is running before it reads the request to close.
    set_visible_resources(scheduler, worker, {})
    scheduler.close_worker(worker.address)


def count_transitions(scheduler: Any) -> int:
    """Return the number of task transitions so far, which only changes if something happens."""
    return int(scheduler.transition_counter)


def cancel_keys(scheduler: Any, keys: Collection[Any], client: str) -> None:
    """Cancel tasks on behalf of a client like `Client.cancel`, but ignore unknown tasks."""
    scheduler.stimulus_cancel(
        list(keys), client=client, force=False, reason="unknown", msg="by Partition.cancel"
    )


async def restart_worker(scheduler: Any, worker: Any, seconds: float) -> bool:
    """Restart a worker through its nanny, and return whether it has rejoined in time."""
    try:
        await scheduler.restart_workers(
            [worker.address], timeout=seconds, stimulus_id=f"poolpart-restart-{time.time()}"
        )
    except TimeoutError:
        return False
    return True


def fail_task(scheduler: Any, task: Any, worker: str, error: Exception) -> None:
    """Fail a task that waits for inputs on a worker, or retry it if it has retries left."""
    from distributed.core import error_message

    stimulus = f"poolpart-failed-{time.time()}"
    message = {name: part for name, part in error_message(error).items() if name != "status"}
    scheduler.handle_task_erred(
        key=task.key, stimulus_id=stimulus, worker=worker, run_id=task.run_id, **message
    )
    if task.state == "erred":  # otherwise, the worker would keep the task and wait for its inputs
        free = {"op": "free-keys", "keys": [task.key], "stimulus_id": stimulus}
        scheduler.stream_comms[worker].send(free)


def reschedule_tasks(scheduler: Any, tasks: Collection[Any]) -> None:
    """Take tasks away from their workers, and place them again."""
    stimulus = f"poolpart-again-{time.time()}"
    scheduler.transitions({task.key: "waiting" for task in tasks}, stimulus)


def is_bound(task: Any) -> bool:
    """Return whether a task may only run on certain workers or hosts."""
    return bool(task.worker_restrictions or task.host_restrictions) and not task.loose_restrictions


def unrunnable_tasks(scheduler: Any) -> Collection[Any]:
    """Return tasks that are ready to run, but for which there is no worker."""
    tasks: Collection[Any] = scheduler.unrunnable
    return tasks


async def run_on_cluster_scheduler(
    cluster: Any, function: Callable[..., Any], **arguments: Any
) -> Any:
    """Call `function(**arguments, dask_scheduler=…)` on a cluster's scheduler without a client."""
    from distributed.core import clean_exception

    packed = {"function": dumps(function), "args": dumps(()), "kwargs": dumps(arguments)}
    answer = await cluster.scheduler_comm.run_function(**packed, wait=True)
    if answer["status"] != "OK":
        raise clean_exception(**answer)[1]
    return _unpacked(answer["result"])


async def call_worker(
    scheduler: Any, address: str, function: Callable[..., Any], **arguments: Any
) -> Any:
    """Call `function(**arguments, dask_worker=…)` in the event loop of a worker.

    Raises
    ------
    OSError
        If the worker does not respond, or if the function raises an exception.
    """
    answer = await scheduler.rpc(address).run(function=dumps(function), kwargs=dumps(arguments))
    if answer["status"] != "OK":
        raise OSError(answer["exception_text"])
    return _unpacked(answer["result"])


def _unpacked(result: Any) -> Any:
    """Unpack a reply, whose object is either serialized or, within a process, only wrapped."""
    from distributed.protocol.serialize import Serialize, Serialized, deserialize

    if isinstance(result, Serialized):
        return deserialize(result.header, result.frames)
    return result.data if isinstance(result, Serialize) else result


def set_worker_plugin(scheduler: Any, name: str, plugin: bytes | None) -> list[asyncio.Future[Any]]:
    """Add a plugin to all current and future workers, or remove it if `plugin` is None.

    The result contains the requests in flight, one per worker. Workers that do not respond, for
    example because the cluster is closing, are ignored.
    """

    # The function is nested so that it is pickled by value. A closing worker removes its plugins
    # itself, and Dask would log a traceback if a plugin had already been removed.
    def remove(dask_worker: Any = None) -> None:
        closing = dask_worker.status.name in ("closing", "closed")
        if not closing and (removed := dask_worker.plugins.pop(name, None)):
            removed.teardown(dask_worker)

    async def update_worker(address: str) -> None:
        with suppress(OSError, RuntimeError):  # `Scheduler.broadcast` would print these errors
            if plugin is None:
                await call_worker(scheduler, address, remove)
            else:
                await getattr(scheduler.rpc(address), "plugin-add")(name=name, plugin=plugin)

    if plugin is None:
        scheduler.worker_plugins.pop(name, None)
    else:
        scheduler.worker_plugins[name] = plugin
    # The requests are independent, so that a stopped worker does not delay the others.
    return [asyncio.ensure_future(update_worker(address)) for address in scheduler.workers]


# -- handlers for the requests of pipes ---------------------------------------------------
#
# A handler takes half the time of `run_on_scheduler`, which pickles its function for each request.


def handlers_of(scheduler: Any) -> dict[str, Any]:
    """Return a scheduler's request handlers by name. They receive and return plain data."""
    handlers: dict[str, Any] = scheduler.handlers
    return handlers


# -- the scheduler's HTTP server ---------------------------------------------------------


def add_pages(scheduler: Any, application: web.Application) -> None:
    """Add pages to the scheduler's HTTP server."""
    scheduler.http_application.add_application(application)


def remove_pages(scheduler: Any, application: web.Application) -> None:
    """Remove pages from the scheduler's HTTP server."""
    scheduler.http_application.applications.remove(application)
