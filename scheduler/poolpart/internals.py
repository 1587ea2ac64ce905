"""All that poolpart relies on in Dask beyond its documented interfaces; a leaf module.

docs/pool-partitions.md has the list: what is used, why, the versions it was seen to hold with, and
the test that says so when it does not. No other module of poolpart reaches into Dask, which a test
checks. Everything here but `local_cluster`'s cluster and what clients ask runs in the event loop
of a scheduler, worker or nanny.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from typing import Any

import distributed
from distributed import Client, Future, Queue, SpecCluster, Status
from distributed.protocol import to_serialize
from distributed.protocol.pickle import dumps
from distributed.protocol.serialize import Serialize, Serialized, deserialize
from tornado import web

from .errors import PoolError

logger = logging.getLogger(__name__)

Resources = dict[str, float]

# -- a say in what the scheduler decides -------------------------------------------------
#
# Plugins of the scheduler hear of what happens; they have no say in it. An attribute of the
# instance hides the class's method until it is deleted.

After = Callable[..., Any]  # gets the method's result and its arguments; returns the result
Before = Callable[[dict[str, Any]], dict[str, Any]]  # gets the keyword arguments; returns them


class _Method:
    """What stands in for a method: the method itself, with rules before and after it.

    A rule that raises steps aside, and the log says so once: whoever shares the cluster gets what
    Dask does without it. An error of the method itself goes to its caller untouched.
    """

    def __init__(self, original: Callable[..., Any]) -> None:
        self.original = original
        self.__name__ = original.__name__  # the server tells its log which handler it calls
        self.before: list[Before] = []
        self.after: list[After] = []
        self._said: set[Any] = set()  # rules whose failure is in the log

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
                "A rule of poolpart for %s failed with distributed %s, and Dask decides without "
                "it: tasks may run outside their partition, or others in it.",
                self.__name__,
                distributed.__version__,
            )


class Rules:
    """Rules for methods of a running scheduler; others may have rules for the same ones."""

    def __init__(self) -> None:
        self._places: list[tuple[Any, str, Any]] = []

    def after(self, owner: Any, name: str, rule: After, *parameters: str) -> None:
        """Have `rule(result, …)` called with a method's result and arguments; it returns a result.

        Parameters
        ----------
        owner, name
            The method's instance, and its name.
        rule
            The rule.
        parameters
            What the first parameters of the method are called.

        Raises
        ------
        PoolError
            If there is no such method in this version of Dask; then all rules are taken back.
        """
        self._check(owner, name, parameters, in_order=True)
        self._stand_in(owner, name).after.append(rule)
        self._places.append((owner, name, rule))

    def before(self, owner: Any, name: str, rule: Before, *parameters: str) -> None:
        """Have `rule(keywords)` called before a method; it returns those to call it with."""
        self._check(owner, name, parameters, in_order=False)
        self._stand_in(owner, name).before.append(rule)
        self._places.append((owner, name, rule))

    def _check(self, owner: Any, name: str, parameters: tuple[str, ...], in_order: bool) -> None:
        if method := getattr(type(owner), name, None):
            has = list(inspect.signature(method).parameters)[1:]
            if has[: len(parameters)] == [*parameters] if in_order else {*parameters} <= {*has}:
                return
        self.take_back()
        raise PoolError(
            f"{type(owner).__name__} of distributed {distributed.__version__} has no "
            f"{name}({', '.join(parameters)}), which poolpart builds on: use a version that it "
            "asks for."
        )

    def _stand_in(self, owner: Any, name: str) -> _Method:
        method = vars(owner).get(name)
        if not isinstance(method, _Method):
            method = _Method(getattr(owner, name))
            setattr(owner, name, method)
        return method

    def take_back(self) -> None:
        """Have the methods without these rules."""
        while self._places:
            owner, name, rule = self._places.pop()
            method = vars(owner)[name]
            for rules in (method.before, method.after):
                rules[:] = [other for other in rules if other != rule]
            if not method.before and not method.after:
                delattr(owner, name)


def rule_for_graphs(rules: Rules, scheduler: Any, bequeath: Callable[[Any], Resources]) -> None:
    """Give tasks resources that their graph leaves open, by the task that submits the graph.

    Parameters
    ----------
    rules, scheduler
        Where the rule goes.
    bequeath
        From the state of the submitting task to the resources.
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
    """Have shuffles and rechunks choose workers for their output that may take it.

    Dask pins each output to any worker of the cluster, also where the tasks ask for a resource
    that the worker lacks; they would wait for ever.
    """
    if not (shuffle := scheduler.extensions.get("shuffle")):
        return

    def after(chosen: dict[Any, str], spec: Any) -> dict[Any, str]:
        from distributed.shuffle._core import barrier_key  # not where poolpart is imported

        valid = scheduler.valid_workers(scheduler.tasks[barrier_key(spec.id)])
        if not valid:  # any worker, or none
            return chosen
        allowed = sorted(worker.address for worker in valid)
        start = hash(spec.id)  # of many small shuffles not all go to the first
        return {
            output: worker if worker in allowed else allowed[(start + number) % len(allowed)]
            for number, (output, worker) in enumerate(chosen.items())
        }

    rules.after(shuffle, "_calculate_worker_for", after, "spec")


class FenceRules:
    """Rules that keep tasks away from workers behind a fence.

    Parameters
    ----------
    scheduler
        The scheduler.
    closed
        States of the workers behind fences; read each time.
    stop
        Whether a task is to stay out.
    on_change
        Called with the state of a worker whose resources have changed.
    """

    def __init__(
        self,
        scheduler: Any,
        closed: set[Any],
        stop: Callable[[Any], bool],
        on_change: Callable[[Any], None],
    ) -> None:
        self.scheduler, self.closed, self.stop = scheduler, closed, stop
        self._on_change = on_change
        self._rules = Rules()

    def install(self) -> None:
        """Have them asked from now on.

        Raises
        ------
        PoolError
            If this version of Dask decides by other means.
        """
        scheduler, after = self.scheduler, self._rules.after
        if not isinstance(getattr(scheduler, "idle_task_count", None), set):
            raise PoolError(
                f"The scheduler of distributed {distributed.__version__} keeps no set of idle "
                "workers, which fences build on: use a version that poolpart asks for."
            )
        after(scheduler, "valid_workers", self._valid_workers, "ts")
        after(scheduler, "decide_worker_non_rootish", self._elsewhere, "ts")
        after(scheduler, "decide_worker_rootish_queuing_disabled", self._rootish, "ts")
        after(scheduler, "add_resources", self._changed, "worker", "resources")
        if stealing := scheduler.extensions.get("stealing"):
            after(stealing, "_get_thief", self._thief, "scheduler", "ts")
        rule_for_shuffles(self._rules, scheduler)
        scheduler.handlers["set_resources"] = scheduler.add_resources
        scheduler.idle_task_count = _OpenWorkers(self.closed, scheduler.idle_task_count)

    def uninstall(self) -> None:
        """Take everything back."""
        self._rules.take_back()
        self.scheduler.handlers["set_resources"] = self.scheduler.add_resources
        self.scheduler.idle_task_count = set(self.scheduler.idle_task_count)

    def could_take(self, task: Any) -> Any:
        """Workers that Dask itself would let take a task."""
        valid = type(self.scheduler).valid_workers(self.scheduler, task)
        return self.scheduler.running if valid is None else valid

    def _valid_workers(self, valid: Any, task: Any) -> Any:
        if not self.stop(task):
            return valid
        remainder = self.scheduler.running - self.closed
        if valid is None:
            return remainder
        allowed = valid - self.closed
        # Restrictions that are mere wishes; without this Dask would then take any worker.
        return allowed or (remainder if task.loose_restrictions else allowed)

    def _elsewhere(self, worker: Any, task: Any) -> Any:
        return None if worker in self.closed and self.stop(task) else worker

    def _rootish(self, worker: Any, task: Any) -> Any:
        if self._elsewhere(worker, task) is worker:
            return worker
        return self.scheduler.decide_worker_non_rootish(task)

    def _thief(self, thief: Any, scheduler: Any, task: Any, *args: Any, **kwargs: Any) -> Any:
        return self._elsewhere(thief, task)

    def _changed(self, answer: Any, worker: str, resources: Any = None) -> Any:
        self._on_change(self.scheduler.workers[worker])
        return answer


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
    """Have tasks placed by these resources of a worker from now on, and wake those that waited.

    Parameters
    ----------
    scheduler
        The scheduler.
    worker
        Its state of the worker.
    resources
        All that the worker is to count as declaring.
    """
    for name in worker.resources.keys() - resources.keys():
        del worker.resources[name]
        scheduler.resources[name].pop(worker.address, None)
    # The scheduler's own method, since fences listen to it.
    scheduler.add_resources(worker.address, resources)
    recount(worker)
    wake(scheduler, worker)


def recount(worker: Any) -> None:
    """Count the resources in use anew.

    Dask forgets them when a worker declares something while it is busy, and counts a task
    that was moved by work stealing against the worker that it was moved from.
    """
    worker.used_resources = dict.fromkeys(worker.resources, 0)
    for task in worker.processing:
        for name, quantity in (task.resource_restrictions or {}).items():
            worker.used_resources[name] = worker.used_resources.get(name, 0) + quantity


def wake(scheduler: Any, worker: Any) -> None:
    """Send tasks that wait for such a worker to it, as the scheduler does when one joins.

    It does not when a running worker gets a resource: those tasks would wait for ever.
    """
    if worker in scheduler.running:
        stimulus = f"poolpart-{worker.address}-{time.time()}"
        scheduler.transitions(
            scheduler.bulk_schedule_unrunnable_after_adding_worker(worker), stimulus
        )


def open_to_all(scheduler: Any, worker: Any) -> None:
    """Send tasks to a worker that no fence keeps them from any more."""
    scheduler.check_idle_saturated(worker)
    if worker.status is Status.running:
        wake(scheduler, worker)
        scheduler.stimulus_queue_slots_maybe_opened(stimulus_id=f"poolpart-opened-{time.time()}")


def forget_resources(scheduler: Any, names: Iterable[str]) -> None:
    """Forget names of resources that no worker declares."""
    for name in names:
        if not scheduler.resources.get(name, True):
            del scheduler.resources[name]


def asks_for(task: Any, names: Collection[str]) -> bool:
    """Whether a task takes a slot of one of these partitions."""
    return not (task.resource_restrictions or {}).keys().isdisjoint(names)


def lift_restrictions(scheduler: Any, names: Collection[str]) -> None:
    """Let results that are still held be computed again, if they are lost, on any worker.

    There is none any more that could take such a task: it would wait for ever.
    """
    for task in scheduler.tasks.values():
        if asks_for(task, names):
            kept = {n: q for n, q in task.resource_restrictions.items() if n not in names}
            task.resource_restrictions = kept or None


# -- moving tasks that have not started, by the protocol of work stealing ----------------
#
# The worker is asked, and gives a task up unless the task runs; then another worker gets it.


def held_by(scheduler: Any, worker: Any, names: Collection[str]) -> list[str]:
    """Keys of a worker's tasks that need these resources of it, with those on their way there."""
    tasks = {task for task in worker.processing if asks_for(task, names)}
    if stealing := scheduler.extensions.get("stealing"):
        moves = stealing.in_flight.items()
        tasks |= {t for t, m in moves if m["thief"] is worker and asks_for(t, names)}
    return [task.key for task in tasks]


def hand_off(scheduler: Any, worker: Any, names: Collection[str], asked: set[Any]) -> None:
    """Move a worker's tasks that have not started to other members of their partition.

    A task that no other worker may take stays, and ends here.

    Parameters
    ----------
    scheduler, worker
        The scheduler, and its state of the worker.
    names
        The partitions that the worker leaves.
    asked
        Tasks that it was asked for already; added to.
    """
    stealing = scheduler.extensions.get("stealing")
    if stealing is None:
        return
    given: Counter[Any] = Counter()  # to whom; the scheduler counts a task when the worker agrees
    for task in list(worker.processing - worker.long_running):
        if task in asked or task.actor or not asks_for(task, names):
            continue
        asked.add(task)
        if others := (scheduler.valid_workers(task) or set()) - {worker}:
            thief = min(others, key=lambda o: (len(o.processing) + given[o]) / o.nthreads)
            given[thief] += 1
            stealing.move_task_request(task, worker, thief)


# -- what a worker declares, and what its nanny starts it with ---------------------------
#
# The scheduler's request to declare other resources goes by another connection than the tasks
# that it sends, and may arrive first. A task that was sent and cancelled at once is forgotten by
# the scheduler while it is on its way; a worker that gets a task for a resource which it does not
# declare breaks down. So a barrier is sent behind the tasks, and the worker waits for it.

_HELD_S = 1.0  # how long a worker waits for tasks to give a resource back
_BARRIER = "poolpart-barrier"


async def call(scheduler: Any, address: str, function: Callable[..., Any], **arguments: Any) -> Any:
    """Call a function in the event loop of a worker or nanny, which it gets as `dask_worker`.

    Raises
    ------
    OSError
        If nobody answers there, or the function raises something.
    """
    answer = await scheduler.rpc(address).run(function=dumps(function), kwargs=dumps(arguments))
    if answer["status"] != "OK":
        raise OSError(answer["exception_text"])
    result = answer["result"]
    # The scheduler leaves what passes through it as it came: as bytes, or not yet packed where
    # the worker is in the same process.
    if isinstance(result, Serialized):
        return deserialize(result.header, result.frames)
    return result.data if isinstance(result, Serialize) else result


async def send_barrier(scheduler: Any, address: str) -> None:
    """Send a barrier behind all messages to a worker; OSError if the worker does not answer."""
    number = uuid.uuid4().hex
    await call(scheduler, address, _await_barrier, number=number)
    if address in scheduler.stream_comms:
        scheduler.worker_send(address, {"op": _BARRIER, "number": number})


def _is_awaited(worker: Any) -> bool:
    """Whether a barrier is still on its way; runs on the worker."""
    return _BARRIER in worker.stream_handlers


def _await_barrier(number: str, dask_worker: Any = None) -> None:
    awaited = number

    def arrive(number: str) -> None:
        # Barriers arrive in the order in which they were sent: behind this one there is none.
        if number == awaited:
            del dask_worker.stream_handlers[_BARRIER]

    dask_worker.stream_handlers[_BARRIER] = arrive


async def declare_on_worker(
    resources: Resources, after_barrier: bool = False, dask_worker: Any = None
) -> bool:
    """Declare these resources and no others; runs on a worker.

    Parameters
    ----------
    resources
        What to declare.
    after_barrier
        Whether to wait for what the scheduler has sent before.

    Returns
    -------
    done
        False if tasks still hold a resource that is to go: they give it back when they end,
        and must find it then. Such a task may be one that was cancelled, of which the
        scheduler knows nothing any more; it may even be on its way.
    """
    state = dask_worker.state
    total, available = state.total_resources, state.available_resources
    leaving = total.keys() - resources.keys()
    for _ in range(int(_HELD_S / 0.01)):
        held = any(available[name] < total[name] for name in leaving)
        if not held and not (after_barrier and _is_awaited(dask_worker)):
            break
        await asyncio.sleep(0.01)
    else:
        return False
    for name in leaving:
        del total[name], available[name]
    for name, quantity in resources.items():
        available[name] = available.get(name, 0) + quantity - total.get(name, 0)
        total[name] = quantity
    return True


def resources_here(worker: Any) -> tuple[str, ...]:
    """Names of the resources that a worker declares; runs on the worker."""
    return tuple(sorted(worker.state.total_resources))


_FOUND = "poolpart_found"  # on a nanny: what it started its worker with before


def keep_on_nanny(resources: Resources, dask_worker: Any = None) -> None:
    """Start the worker with these resources from now on; runs on a nanny.

    Resources set on a running worker are lost when its nanny restarts it. Setting them once
    more from inside the new worker comes too late for tasks that found no worker meanwhile:
    nothing wakes those. A resource in what the nanny starts the worker with is there when the
    worker registers, and that does wake them.

    The nanny itself keeps what it had before: the answer to this may be lost, when its worker
    dies at the same moment, and then nobody else would know.
    """
    nanny = dask_worker  # the server that this runs on
    if not hasattr(nanny, _FOUND):
        started = nanny.process.worker_kwargs["resources"] if nanny.process else nanny.resources
        setattr(nanny, _FOUND, (nanny.resources, started))
    _start_with(nanny, dict(resources), dict(resources))


def restore_on_nanny(dask_worker: Any = None) -> None:
    """Have the nanny as `keep_on_nanny` found it; runs on a nanny, any number of times."""
    nanny = dask_worker
    if hasattr(nanny, _FOUND):
        _start_with(nanny, *getattr(nanny, _FOUND))
        delattr(nanny, _FOUND)


def _start_with(nanny: Any, resources: Resources | None, again: Resources | None) -> None:
    nanny.resources = resources
    if nanny.process is not None:
        nanny.process.worker_kwargs["resources"] = again


# -- queues and variables, which a pipe is made of ---------------------------------------


class AttachedQueue(Queue):
    """A Queue that exists already.

    Constructing a `Queue` creates it where it does not exist and counts as a reference, which
    a killed worker never gives back: a consumer that starts late would revive the queue of
    a pipe that was deleted. This one does neither.
    """

    def _maybe_start(self) -> None:
        """Do not create the queue."""


_LATE_WORD_S = 2.0  # clients send word of futures that they have every few milliseconds


def depth_of(scheduler: Any, name: str) -> int | None:
    """Items in a queue; None if there is no such queue."""
    queue = scheduler.extensions["queues"].queues.get(name)
    return None if queue is None else int(queue.qsize())


def queues_of(scheduler: Any) -> list[str]:
    """Names of all queues."""
    return list(scheduler.extensions["queues"].queues)


def state_of(scheduler: Any, name: str) -> Any:
    """Value of a variable; None if there is no such variable."""
    return scheduler.extensions["variables"].variables.get(name, {}).get("value")


async def set_state(scheduler: Any, name: str, value: Any) -> None:
    """Make a variable, or change its value."""
    await scheduler.extensions["variables"].set(name=name, data=value)


def make_queue(scheduler: Any, name: str) -> None:
    """Make a queue without a limit."""
    scheduler.extensions["queues"].create(name=name)


async def take_all(scheduler: Any, name: str) -> list[Any]:
    """Take all items of a queue, which are plain data, or none if there is no such queue."""
    if not depth_of(scheduler, name):
        return []
    records = await scheduler.extensions["queues"].get(name=name, client=None, batch=True)
    return [record["value"] for record in records]


async def forget_queue(scheduler: Any, name: str) -> None:
    """Forget a queue and the variable of the same name, whoever refers to them."""
    queues, variables = scheduler.extensions["queues"], scheduler.extensions["variables"]
    while name in queues.queues:
        queues.release(name=name, client="poolpart")
    _forget_counts(queues, name)
    # A consumer's word that it has a future may still be under way, and would be counted.
    asyncio.get_running_loop().call_later(_LATE_WORD_S, _forget_counts, queues, name)
    # Futures that were taken by a consumer which died before it could say so.
    if f"queue-{name}" in scheduler.clients:
        scheduler.remove_client(f"queue-{name}")
    if name in variables.variables:
        await variables.delete(name=name, client="poolpart")


def _forget_counts(queues: Any, name: str) -> None:
    if name not in queues.queues:
        for counted in [counted for counted in queues.future_refcount if counted[0] == name]:
            del queues.future_refcount[counted]


# -- the scheduler's HTTP server ---------------------------------------------------------


def serve(scheduler: Any, application: web.Application) -> None:
    """Add pages to the scheduler's HTTP server."""
    scheduler.http_application.add_application(application)


def serves(scheduler: Any, kind: type[web.Application]) -> bool:
    """Whether pages of a kind are there."""
    return any(isinstance(other, kind) for other in scheduler.http_application.applications)


def serve_no_longer(scheduler: Any, kind: type[web.Application]) -> None:
    """Take pages of a kind away."""
    pages = scheduler.http_application.applications
    pages[:] = [page for page in pages if not isinstance(page, kind)]


# -- clients -----------------------------------------------------------------------------


def when_done(future: Future, function: Callable[[Future], Any]) -> None:
    """Call `function(future)` once the task has succeeded, failed or been cancelled.

    It is called in the client's event loop and must not block. `Future.add_done_callback`
    calls in a thread that all callbacks of the process share: a user's callback that waits
    there for this one would wait for ever. It also takes a task for done whose result was lost
    with its worker, while that is computed again.
    """

    async def wait() -> None:
        while future.status in ("pending", "lost"):
            await future._state.wait()
        function(future)

    future.client.loop.add_callback(wait)


async def identities(client: Client) -> dict[str, dict[str, Any]]:
    """Ask the scheduler for all its workers, by address.

    `Client.scheduler_info(n_workers=-1)` asks too, but returns what is in an attribute by then.
    Every two seconds the client itself puts an answer there that has no workers, so that on a
    busy machine a cluster of hundreds looks empty now and then.
    """
    identity: dict[str, Any] = await client.scheduler.identity(n_workers=-1)
    workers: dict[str, dict[str, Any]] = identity["workers"]
    return workers


async def who_has(client: Client, keys: Collection[str]) -> dict[str, Collection[str]]:
    """Ask the scheduler which workers have results: {key: addresses}."""
    found: dict[str, Collection[str]] = await client.scheduler.who_has(keys=list(keys))
    return found


async def take_from_worker(client: Client, address: str, keys: Collection[str]) -> dict[str, Any]:
    """Fetch results straight from a worker; those that it has."""
    from distributed.utils_comm import gather_from_workers

    data, *_ = await gather_from_workers({key: [address] for key in keys}, rpc=client.rpc)
    return dict(data)


async def ping(client: Client, address: str) -> None:
    """Ask a worker for a sign of life."""
    await client.rpc(address).ping()


def answer_to(worker: Any, question: str, answer: Callable[..., Any]) -> None:
    """Have a worker answer a question of its own, unless it does."""
    worker.handlers.setdefault(question, answer)


async def ask(client: Client, address: str, question: str, **arguments: Any) -> Any:
    """Ask a worker such a question."""
    return await getattr(client.rpc(address), question)(**arguments)


def as_bytes(data: Any) -> Any:
    """Have bytes sent as they are, without copying."""
    return to_serialize(memoryview(data))


# -- a cluster on this machine -----------------------------------------------------------


class FixedCluster(SpecCluster):
    """A cluster that leaves dead workers to their nannies, and keeps the workers it has.

    A SpecCluster looks 15 seconds after a worker was lost whether one of its name is there,
    and if not closes the nanny for good. A worker that dies twice within that time may be
    starting just then, and would never come back.
    """

    def _update_worker_status(self, op: str, msg: Any) -> None:
        super(SpecCluster, self)._update_worker_status(op, msg)

    def scale(self, n: int = 0, **options: Any) -> None:
        """Refuse: SpecCluster would drop the workers described last, whatever their kind."""
        if self.status == Status.closing:  # it stops its workers by this
            super().scale(n, **options)
            return
        raise PoolError(
            "A cluster of local_cluster has a fixed number of workers: give it when you start "
            "one, or move workers with Partition.grow and Partition.shrink."
        )
