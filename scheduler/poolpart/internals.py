"""All that poolpart relies on in Dask beyond its documented interfaces; a leaf module.

docs/pool-partitions.md has the list: what is used, why, the versions tried, and the test that fails
when it changes. No other module of poolpart reaches into Dask, which a test checks. Everything here
except `local_cluster`'s cluster and the requests of clients runs in the event loop of a scheduler,
worker or nanny.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, wraps
from multiprocessing import spawn
from typing import Any

import dask
import distributed
from distributed import Client, Future, Nanny, SpecCluster, Status, as_completed, futures_of
from distributed.core import clean_exception
from distributed.protocol import to_serialize
from distributed.protocol.pickle import dumps
from distributed.protocol.serialize import Serialize, Serialized, deserialize
from distributed.worker import thread_state
from distributed.worker_state_machine import UnpauseEvent
from tornado import web

from .errors import PoolError

logger = logging.getLogger(__name__)

Resources = dict[str, float]

# -- rules for decisions of the scheduler ------------------------------------------------
#
# Plugins of the scheduler only observe. An attribute of the instance hides the class's method
# until it is deleted.

After = Callable[..., Any]  # gets the method's result and its arguments; returns the result
Before = Callable[[dict[str, Any]], dict[str, Any]]  # gets the keyword arguments; returns them


class _Method:
    """Replacement of a method: the method itself, with rules before and after it.

    A rule that raises is skipped, and the log says so once: other users of the cluster get what
    Dask does without it. An error of the method itself reaches its caller unchanged.
    """

    def __init__(self, original: Callable[..., Any]) -> None:
        self.original = original
        self.__name__ = original.__name__  # the server logs the name of the handler
        self.before: list[Before] = []
        self.after: list[After] = []
        self._said: set[Any] = set()  # rules whose failure has been logged

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        for before in self.before:
            try:
                kwargs = before(kwargs)
            except Exception:
                self._step_aside(before)
        result = self.original(*args, **kwargs)
        for after in self.after:
            try:
                result = after(result, *args, **kwargs)
            except Exception:
                self._step_aside(after)
        return result

    def _step_aside(self, rule: Any) -> None:
        if rule not in self._said:
            self._said.add(rule)
            logger.exception(
                "A rule of poolpart for %s failed with distributed %s, so Dask decides without "
                "it: tasks may run outside their partition, or others in it.",
                self.__name__,
                distributed.__version__,
            )


class Rules:
    """Rules for methods of a running scheduler; several may have rules for one method."""

    def __init__(self) -> None:
        self._places: list[tuple[Any, str, Any]] = []

    def after(self, owner: Any, name: str, rule: After, parameter: str) -> None:
        """Call `rule(result, …)` with a method's result and arguments; it returns a result.

        `parameter` is the name of the method's only parameter. PoolError if this version of Dask
        has no such method; then all rules are removed.
        """
        self._stand_in(owner, name, {parameter}).after.append(rule)
        self._places.append((owner, name, rule))

    def before(self, owner: Any, name: str, rule: Before, *parameters: str) -> None:
        """Call `rule(keywords)` before a method; it returns the keywords to use."""
        self._stand_in(owner, name, {*parameters}).before.append(rule)
        self._places.append((owner, name, rule))

    def _stand_in(self, owner: Any, name: str, parameters: set[str]) -> _Method:
        method = getattr(type(owner), name, None)
        if method is None or not parameters <= inspect.signature(method).parameters.keys():
            self.take_back()
            raise PoolError(
                f"{type(owner).__name__} of distributed {distributed.__version__} has no "
                f"{name}({', '.join(sorted(parameters))}), which poolpart needs: use a version "
                "that it asks for."
            )
        stand_in = vars(owner).get(name)
        if not isinstance(stand_in, _Method):
            stand_in = _Method(getattr(owner, name))
            setattr(owner, name, stand_in)
        return stand_in

    def take_back(self) -> None:
        """Remove these rules."""
        while self._places:
            owner, name, rule = self._places.pop()
            method = vars(owner)[name]
            for rules in (method.before, method.after):
                rules[:] = [other for other in rules if other != rule]
            if not method.before and not method.after:
                delattr(owner, name)


def rule_for_graphs(rules: Rules, scheduler: Any, bequeath: Callable[[Any], Resources]) -> None:
    """Give tasks resources that their graph leaves open, by the task that submits the graph.

    `bequeath` returns them, from the state of the submitting task.
    """

    def before(graph: dict[str, Any]) -> dict[str, Any]:
        task = scheduler.tasks.get(graph["submitting_task"])
        given = graph["global_annotations"] or {}
        legacy = bequeath(task) if task is not None else {}
        if not legacy or "resources" in given or "workers" in given:
            return graph
        by_type = graph["annotations_by_type"]  # {"workers": {key: …}, "resources": …}
        asked = by_type.get("resources", {})
        otherwise = asked.keys() | by_type.get("workers", {}).keys()
        heirs = {key: legacy for key in graph["dsk"] if key not in otherwise}
        return {**graph, "annotations_by_type": {**by_type, "resources": {**asked, **heirs}}}

    rules.before(
        scheduler,
        "_create_taskstate_from_graph",
        before,
        *("submitting_task", "annotations_by_type", "global_annotations", "dsk"),
    )


def rule_for_shuffles(rules: Rules, scheduler: Any) -> None:
    """Let shuffles and rechunks choose permitted workers for their output.

    Dask pins each output to any worker of the cluster, even if the tasks ask for a resource that
    the worker lacks; they would wait for ever.
    """
    if not (shuffle := scheduler.extensions.get("shuffle")):
        return

    def after(chosen: dict[Any, str], spec: Any) -> dict[Any, str]:
        from distributed.shuffle._core import barrier_key  # not where poolpart is imported

        valid = scheduler.valid_workers(scheduler.tasks[barrier_key(spec.id)])
        if not valid:  # any worker, or none
            return chosen
        allowed = sorted(worker.address for worker in valid)
        start = hash(spec.id)  # so that many small shuffles do not all use the first worker
        return {
            output: worker if worker in allowed else allowed[(start + number) % len(allowed)]
            for number, (output, worker) in enumerate(chosen.items())
        }

    rules.after(shuffle, "_calculate_worker_for", after, "spec")


def rule_for_fences(
    rules: Rules, scheduler: Any, closed: set[Any], stop: Callable[[Any], bool]
) -> None:
    """Keep tasks away from workers behind a fence.

    `closed` are the states of those workers, read each time; `stop` says whether a task has to stay
    out. PoolError if this version of Dask places tasks in another way.
    """
    if not isinstance(getattr(scheduler, "idle_task_count", None), set):
        raise PoolError(
            f"The scheduler of distributed {distributed.__version__} keeps no set of idle "
            "workers, which fences need: use a version that poolpart asks for."
        )

    def valid_workers(valid: Any, task: Any) -> Any:
        if not stop(task):
            return valid
        remainder = scheduler.running - closed
        if valid is None:
            return remainder
        allowed = valid - closed
        # Loose restrictions; without this Dask would then take any worker.
        return allowed or (remainder if task.loose_restrictions else allowed)

    def rootish(worker: Any, task: Any) -> Any:
        return (
            scheduler.decide_worker_non_rootish(task) if worker in closed and stop(task) else worker
        )

    rules.after(scheduler, "valid_workers", valid_workers, "ts")
    rules.after(scheduler, "decide_worker_rootish_queuing_disabled", rootish, "ts")
    scheduler.idle_task_count = _OpenWorkers(closed, scheduler.idle_task_count)


def take_back_fences(rules: Rules, scheduler: Any) -> None:
    """Remove that rule from the scheduler."""
    rules.take_back()
    scheduler.idle_task_count = set(scheduler.idle_task_count)


def could_take(scheduler: Any, task: Any) -> Any:
    """Workers that Dask itself would let take a task."""
    valid = type(scheduler).valid_workers(scheduler, task)
    return scheduler.running if valid is None else valid


class _OpenWorkers(set[Any]):
    """Workers with room for tasks from the queue, without those behind fences."""

    def __init__(self, closed: set[Any], workers: Iterable[Any]) -> None:
        super().__init__(workers)
        self.difference_update(closed)
        self._closed = closed

    def add(self, worker: Any) -> None:
        if worker not in self._closed:
            super().add(worker)


# -- where the scheduler places tasks ----------------------------------------------------


def show(scheduler: Any, worker: Any, resources: Resources) -> None:
    """Let the scheduler place tasks by these resources of a worker, and no others."""
    for name in worker.resources.keys() | resources.keys():
        declaring = scheduler.resources.setdefault(name, {})
        declaring.pop(worker.address, None)
        if name in resources:
            declaring[worker.address] = resources[name]
        elif not declaring:
            del scheduler.resources[name]
    worker.resources = dict(resources)
    recount(worker)


def recount(worker: Any) -> None:
    """Recount the resources in use.

    Dask forgets them when a worker declares something while it is busy, and counts a task
    that was moved by work stealing against the worker that it was moved from.
    """
    # Also resources that it no longer declares: a stolen task may still come.
    worker.used_resources = defaultdict(float, dict.fromkeys(worker.resources, 0))
    for task in worker.processing:
        for name, quantity in (task.resource_restrictions or {}).items():
            worker.used_resources[name] += quantity


def wake(scheduler: Any, worker: Any) -> None:
    """Send tasks that wait for such a worker to it, as the scheduler does when one joins.

    The scheduler does not when a running worker gets a resource: the tasks would wait for ever.
    """
    if worker in scheduler.running:
        stimulus = f"poolpart-{worker.address}-{time.time()}"
        scheduler.transitions(
            scheduler.bulk_schedule_unrunnable_after_adding_worker(worker), stimulus
        )


def open_to_all(scheduler: Any, worker: Any) -> None:
    """Send tasks to a worker that a fence no longer closes to them."""
    scheduler.check_idle_saturated(worker)
    if worker.status is Status.running:
        wake(scheduler, worker)
        scheduler.stimulus_queue_slots_maybe_opened(stimulus_id=f"poolpart-opened-{time.time()}")


def asks_for(task: Any, names: Collection[str]) -> bool:
    """Whether a task takes a slot of one of these partitions."""
    return not (task.resource_restrictions or {}).keys().isdisjoint(names)


def lift_restrictions(scheduler: Any, names: Collection[str]) -> None:
    """Let any worker recompute results that are still held, if they are lost.

    No worker has the task's resource any more: the task would wait for ever.
    """
    for task in scheduler.tasks.values():
        if asks_for(task, names):
            kept = {n: q for n, q in task.resource_restrictions.items() if n not in names}
            task.resource_restrictions = kept or None


# -- moving waiting tasks, by the protocol of work stealing --------------------------------
#
# A worker gives up a task on request unless the task runs; then another worker gets it.


def held_by(scheduler: Any, worker: Any, names: Collection[str]) -> list[str]:
    """Keys of a worker's tasks that need these resources, and of those on their way there."""
    tasks = {task for task in worker.processing if asks_for(task, names)}
    if stealing := scheduler.extensions.get("stealing"):
        moves = stealing.in_flight.items()
        tasks |= {t for t, m in moves if m["thief"] is worker and asks_for(t, names)}
    return [task.key for task in tasks]


def hand_off(scheduler: Any, worker: Any, names: Collection[str], asked: set[Any]) -> None:
    """Move a worker's tasks that have not started to other members of their partition.

    A task that no other worker may take stays, and ends here. `names` are the partitions that the
    worker leaves; `asked` are tasks that were requested already, and is extended.
    """
    stealing = scheduler.extensions.get("stealing")
    if stealing is None:
        return
    given = Counter[Any]()  # by new worker: the scheduler counts a task when the old one agrees
    for task in list(worker.processing - worker.long_running):
        if task in asked or task.actor or not asks_for(task, names):
            continue
        asked.add(task)
        if others := (scheduler.valid_workers(task) or set()) - {worker}:
            thief = min(others, key=lambda o: (len(o.processing) + given[o]) / o.nthreads)
            given[thief] += 1
            stealing.move_task_request(task, worker, thief)


# -- workers that a cluster gives back ----------------------------------------------------
#
# From the step of the event loop in which one is found idle, it gets no tasks. What
# `retire_workers` does comes later: it waits for a lock, and for its turn.


def is_idle(scheduler: Any, worker: Any) -> bool:
    """Whether nothing is lost with a worker: it has no task, and no result that is only there."""
    if worker.status is not Status.running or worker.processing or worker.actors:
        return False
    stealing = scheduler.extensions.get("stealing")
    moves = stealing.in_flight.values() if stealing else ()
    if any(move["thief"] is worker for move in moves):  # a task is on its way
        return False
    return all(len(task.who_has) > 1 for task in worker.has_what)


def takes_tasks(worker: Any) -> bool:
    """Whether a worker gets tasks, or will in a moment: one that joins is not ready at once."""
    return worker.status in (Status.running, Status.init)


def shut(scheduler: Any, worker: Any) -> None:
    """Let a worker get no more tasks."""
    stimulus = f"poolpart-shut-{time.time()}"
    scheduler.handle_worker_status_change(Status.closing_gracefully, worker, stimulus)


def reopen(scheduler: Any, worker: Any) -> None:
    """Let a worker get tasks again that `shut`, or a retirement in vain, has kept from it."""
    if scheduler.workers.get(worker.address) is worker:
        stimulus = f"poolpart-reopened-{time.time()}"
        message = {"op": "worker-status-change", "status": "running", "stimulus_id": stimulus}
        scheduler.stream_comms[worker.address].send(message)
        scheduler.handle_worker_status_change(Status.running, worker, stimulus)


def has_running_tasks(dask_worker: Any = None) -> bool:
    """Whether a worker runs anything, also cancelled tasks, which its scheduler has forgotten."""
    return bool(dask_worker.state.all_running_tasks)


async def retire(scheduler: Any, workers: Collection[Any]) -> bool:
    """Close workers; False if some stay, because they have results that nobody else can take."""
    addresses = [worker.address for worker in workers]
    done = await scheduler.retire_workers(workers=addresses, close_workers=True, remove=True)
    return len(done) == len(addresses)


def turn_away(scheduler: Any, worker: Any) -> None:
    """Close a worker that is just joining, before it gets tasks."""
    shut(scheduler, worker)
    scheduler.close_worker(worker.address)


def is_bound(task: Any) -> bool:
    """Whether a task may run on certain workers only."""
    return bool(task.worker_restrictions or task.host_restrictions) and not task.loose_restrictions


def waiting_for_workers(scheduler: Any) -> Collection[Any]:
    """Tasks that could run, and for which there is no worker."""
    tasks: Collection[Any] = scheduler.unrunnable
    return tasks


async def ask_of_cluster(cluster: Any, function: Callable[..., Any], **arguments: Any) -> Any:
    """Call `function(**arguments, dask_scheduler=…)` on a cluster's scheduler, without a client."""
    packed = {"function": dumps(function), "args": dumps(()), "kwargs": dumps(arguments)}
    answer = await cluster.scheduler_comm.run_function(**packed, wait=True)
    if answer["status"] != "OK":
        raise clean_exception(**answer)[1]
    return _unpacked(answer["result"])


# -- what a worker declares --------------------------------------------------------------


class _Available(dict[str, float]):
    """Slots that a worker has available: 0, rather than an error, of what it does not declare.

    The request to declare and tasks use different connections: a cancelled task may still be on
    its way, and a worker would break down if it got a task for an unknown resource.
    """

    def __missing__(self, name: str) -> float:
        return 0.0


async def call(scheduler: Any, address: str, function: Callable[..., Any], **arguments: Any) -> Any:
    """Call a function in the event loop of a worker, passed as `dask_worker`.

    OSError if nobody answers there, or the function raises something.
    """
    answer = await scheduler.rpc(address).run(function=dumps(function), kwargs=dumps(arguments))
    if answer["status"] != "OK":
        raise OSError(answer["exception_text"])
    return _unpacked(answer["result"])


def _unpacked(result: Any) -> Any:
    """Unpack a reply, which may come as it is: as bytes, or unpacked from the same process."""
    if isinstance(result, Serialized):
        return deserialize(result.header, result.frames)
    return result.data if isinstance(result, Serialize) else result


def declare_on_worker(resources: Resources, dask_worker: Any = None) -> bool:
    """Declare these resources, and none of any other; runs on a worker.

    Returns False if tasks still hold a resource that is removed. Such a task may be cancelled but
    still running, and unknown to the scheduler.
    """
    state = dask_worker.state
    total, available = state.total_resources, state.available_resources
    # Not what is available: a task may have lent its slots, and takes them back.
    held = {name for task in state.all_running_tasks for name in resources_of(task)}
    if held & (total.keys() - resources.keys()):
        return False
    left = {name: available.get(name, 0) - total.get(name, 0) for name in resources}
    state.available_resources = _Available({n: q + left[n] for n, q in resources.items()})
    state.total_resources = dict(resources)
    return True


def resources_of(task: Any) -> Resources:
    """Resources that a task of this worker takes while it runs."""
    return {name: slots for name, slots in (task.resource_restrictions or {}).items() if slots}


def resources_here(worker: Any) -> tuple[str, ...]:
    """Names of the resources that a worker has; runs on the worker."""
    return tuple(sorted(name for name, slots in worker.state.total_resources.items() if slots))


# -- slots that a task lends while it waits -------------------------------------------------
#
# What Dask does when a task secedes and rejoins, also several times: the worker counts it as
# long-running from the first time to its end, so that a task in its place may start but have to
# wait for a thread; its resources stay taken throughout.


def task_of_thread() -> tuple[Any, Any] | None:
    """Worker and state of the task that runs in this thread; None in any other thread."""
    if (key := getattr(thread_state, "key", None)) is None:
        return None
    worker = thread_state.execution_state["worker"]
    task = worker.state.tasks.get(key)  # an actor's method is no task
    return None if task is None else (worker, task)


def free_slots(worker: Any, slots: Resources) -> None:
    """Let waiting tasks of a worker have these slots; runs in its event loop."""
    for name, number in slots.items():
        worker.state.available_resources[name] += number
    if worker.state.running:  # or it is paused, and starts them when it goes on
        worker.handle_stimulus(UnpauseEvent(stimulus_id=f"poolpart-lent-{time.time()}"))


def take_slots(worker: Any, slots: Resources) -> None:
    """Keep these slots from waiting tasks, also if there are fewer now; runs in its event loop."""
    for name, number in slots.items():
        worker.state.available_resources[name] -= number


def slots_here(worker: Any, name: str) -> tuple[float, float]:
    """Slots of a worker that are available, below 0 if reserved, and all."""
    return worker.state.available_resources[name], worker.state.total_resources[name]


@cache  # once: another library may have wrapped the same since, and goes on calling this
def let_waits_lend(context: Callable[[], AbstractContextManager[None]]) -> None:
    """Have what waits for futures in tasks of this process do it within a context, from now on.

    That is `Future.result` and `exception`, `Client.gather`, `wait`, the computing of collections,
    and `as_completed`, where they are called in the thread of a task and have to wait. All but the
    last come down to `Client.sync`, which is called for much else.
    """
    of_future = (Future._result, Future._exception, Future._traceback)
    waits = {*of_future, Client._gather, distributed.client._wait}
    sync, following = Client.sync, as_completed.__next__

    def sync_within(client: Any, function: Any, *args: Any, **kwargs: Any) -> Any:
        if getattr(function, "__func__", function) in waits and task_of_thread():
            owner = getattr(function, "__self__", None)
            futures = futures_of(owner if isinstance(owner, Future) else [*args])
            if any(future.status in ("pending", "lost") for future in futures):
                with context():
                    return sync(client, function, *args, **kwargs)
        return sync(client, function, *args, **kwargs)

    def following_within(done: Any) -> Any:
        if task_of_thread() and not done.has_ready() and not done.is_empty():
            with context():
                return following(done)
        return following(done)

    Client.sync = sync_within
    as_completed.__next__ = as_completed.next = following_within


def tell_of_plugin(scheduler: Any, name: str, plugin: bytes | None) -> list[asyncio.Future[Any]]:
    """Give a plugin to all workers, also later ones before they get tasks, or take it from all.

    Returns the requests under way. A worker that does not answer, at the end of a cluster, is left.
    """

    # Nested, so that it is sent by value. A worker that is closing takes its plugins off itself;
    # of two that take one off, Dask's writes a traceback into the log.
    def remove(dask_worker: Any = None) -> None:
        closing = dask_worker.status.name in ("closing", "closed")
        if not closing and (found := dask_worker.plugins.pop(name, None)):
            found.teardown(dask_worker)

    async def tell(address: str) -> None:
        with suppress(OSError, RuntimeError):  # `Scheduler.broadcast` would print it
            if plugin is None:
                await call(scheduler, address, remove)
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
    """Handlers of a scheduler, by request; they and their callers exchange plain data."""
    handlers: dict[str, Any] = scheduler.handlers
    return handlers


class QueueAndVariable:
    """A `distributed.Queue` and a `distributed.Variable` of one name, used on their scheduler.

    The queue has no limit: what puts and takes here never waits.
    """

    def __init__(self, scheduler: Any, name: str) -> None:
        self._queues = scheduler.extensions["queues"]
        self._variables = scheduler.extensions["variables"]
        self.name = name
        self._queues.create(name=name)
        self._queue = self._queues.queues[name]

    @staticmethod
    def exists(scheduler: Any, name: str) -> bool:
        """Whether the cluster has a queue or a variable of a name."""
        extensions = scheduler.extensions
        return name in extensions["queues"].queues or name in extensions["variables"].variables

    def __len__(self) -> int:
        return int(self._queue.qsize())

    def put(self, items: Iterable[bytes]) -> None:
        """Put items into the queue."""
        for item in items:
            self._queue.put_nowait({"type": "msgpack", "value": item})

    def take(self) -> list[bytes]:
        """Take all items out of the queue."""
        return [self._queue.get_nowait()["value"] for _ in range(len(self))]

    def set(self, value: dict[str, Any]) -> None:
        """Set the variable to plain data."""
        self._variables.variables[self.name] = {"type": "msgpack", "value": value}

    def delete(self) -> None:
        """Delete both, whoever refers to them."""
        while self.name in self._queues.queues:
            self._queues.release(name=self.name, client="poolpart")
        self._variables.variables.pop(self.name, None)


# -- the scheduler's HTTP server ---------------------------------------------------------


def serve(scheduler: Any, application: web.Application) -> None:
    """Add pages to the scheduler's HTTP server."""
    scheduler.http_application.add_application(application)


def serve_no_longer(scheduler: Any, kind: type[web.Application]) -> None:
    """Remove pages of a kind."""
    pages = scheduler.http_application.applications
    pages[:] = [page for page in pages if not isinstance(page, kind)]


# -- clients -----------------------------------------------------------------------------


def when_done(future: Future, function: Callable[[Future], Any]) -> None:
    """Call `function(future)` once the task has succeeded, failed or been cancelled.

    It is called in the client's event loop and must not block. `Future.add_done_callback` uses a
    thread that all callbacks of the process share: a user's callback that waits there for this
    one would wait for ever. It also considers a task done whose lost result is being recomputed.
    """

    async def wait() -> None:
        while future.status in ("pending", "lost"):
            await future._state.wait()
        function(future)

    future.client.loop.add_callback(wait)


async def take_from_worker(client: Client, address: str, keys: Collection[str]) -> dict[str, Any]:
    """Fetch results straight from a worker, as far as it has them."""
    from distributed.utils_comm import gather_from_workers

    data, *_ = await gather_from_workers({key: [address] for key in keys}, rpc=client.rpc)
    return dict(data)


def answer_to(worker: Any, question: str, answer: Callable[..., Any]) -> None:
    """Add a handler to a worker, unless it has it."""
    worker.handlers.setdefault(question, answer)


async def ask(client: Client, address: str | None, question: str, **arguments: Any) -> Any:
    """Call such a handler of a worker, or of the scheduler if the address is None.

    None if the scheduler does not have it, which its log tells.
    """
    there = client.scheduler if address is None else client.rpc(address)
    return await getattr(there, question)(**arguments)


def as_bytes(data: Any) -> Any:
    """Wrap bytes so that they are sent without copying."""
    return to_serialize(memoryview(data))


# -- a cluster on this machine -----------------------------------------------------------


@contextmanager
def forked_workers() -> Iterator[None]:
    """Let nannies fork workers from the fork server, also for a restart.

    Dask would make it import pandas and more; it has already imported what is needed.
    """
    utils, before = distributed.utils, distributed.utils._forkserver_preload_set
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        utils._forkserver_preload_set = True
        try:
            yield
        finally:
            utils._forkserver_preload_set = before


_starting: set[Nanny] = set()  # those of `OwnNanny` that start a worker just now


@cache  # once, for the same reason
def _spare_workers_the_script() -> None:
    prepare = spawn.get_preparation_data

    @wraps(prepare)
    def without_script(name: str) -> dict[str, Any]:
        data = prepare(name)
        if _starting and name.startswith("Dask Worker process"):
            data = {key: data[key] for key in data if not key.startswith("init_main_from")}
        return data

    spawn.get_preparation_data = without_script


class OwnNanny(Nanny):
    """A nanny whose workers do not import the script that starts them.

    multiprocessing imports it to find functions by name, and a script without a main guard would
    start itself again in each worker. Dask sends what a script defines by value.
    """

    async def instantiate(self) -> Status:
        """Start a worker, or start it again."""
        _spare_workers_the_script()
        _starting.add(self)
        try:
            return await super().instantiate()
        finally:
            _starting.discard(self)


class FixedCluster(SpecCluster):
    """A cluster that leaves dead workers to their nannies, and cannot be scaled.

    15 seconds after a worker was lost, a SpecCluster closes its nanny unless a worker of its name
    is present. A worker that dies twice within that time may be starting just then, and would
    never come back.
    """

    def _update_worker_status(self, op: str, msg: Any) -> None:
        super(SpecCluster, self)._update_worker_status(op, msg)

    def scale(self, n: int = 0, **options: Any) -> None:
        """Refuse: SpecCluster would drop the workers specified last, whatever their kind."""
        if self.status == Status.closing:  # it stops its workers by this
            super().scale(n, **options)
            return
        raise PoolError(
            "A cluster of local_cluster has a fixed number of workers: give it when you start "
            "one, or move workers with Partition.grow and Partition.shrink."
        )
