"""Register clients, and reject tasks that could never run.

A client registers with the scheduler before its first task for a partition (`register`). From then
on, features such as inheritance are enabled in the partition (see `features.py`), and a rule checks
each graph of the client when it arrives. Tasks fail with a `PoolError` if their partition was
dissolved, if they request more slots or memory than any worker of the partition has, or if they
name a worker outside the partition. Without this check, they would wait forever. Tasks of clients
that are not registered are not checked.

The check runs on the scheduler because only the scheduler knows the current members. A client would
have to wait for the response of a busy scheduler, and the response could be outdated when it
arrives.

The registration ends with the connection of the client, or when the partition is dissolved. The
registrations of clients in tasks end when no client outside of tasks uses the partition anymore. In
this case, the workers are notified that their clients have to register again.

Tasks are counted (see `stats.py`) from the first registration on. Unless somebody has requested the
counts, they are deleted with the last registration.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dask.utils import format_bytes
from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .adapting import adaptive_names, expects_workers, max_running_tasks, slots_of_new_worker
from .errors import PoolError
from .features import disable_features, enable_features, names_with_features, wait_for_features
from .internals.method_rules import MethodRules, add_arrival_rule
from .internals.names import REFUSING, require_feature
from .internals.partition_client import CLIENT_OF
from .internals.placing import has_worker_for, memory_limit, workers_declaring
from .internals.worker import current_task
from .limits import MEMORY
from .registration import is_registered, record_registration
from .rules import check_name
from .shares import slot_use
from .stats import NAME as STATISTICS
from .stats import forget_statistics, statistics_of
from .steward import NAME as STEWARD
from .steward import Steward, names_with_rule
from .workers import run_on_scheduler

logger = logging.getLogger(__name__)

NAME = "poolpart-registrations"


class MemberName(str):
    """Name or address of a member, which the scheduler translates to an address."""

    __slots__ = ()


def register(client: Client, name: str, slots: int, by_rule: str) -> str:
    """Register a client for a partition, unless it is already registered.

    Parameters
    ----------
    client, name
        Client and name of the partition.
    slots
        Number of slots that the first task requests.
    by_rule
        ID of the scheduler on which, as far as the caller knows, a division of the pool has created
        the partition, or "".

    Returns
    -------
    str
        The same ID, or the ID of this scheduler if the partition was created there.

    Raises
    ------
    PoolError
        If the name is invalid, if the first task could never run, if poolpart is not installed in
        the scheduler's environment, or if the client is closed or asynchronous.
    """
    if is_registered(client, name):
        return by_rule
    check_name(name)
    connection = client.scheduler_comm
    divided_on, objection, others = run_on_scheduler(
        client,
        _register,
        name=name,
        slots=slots,
        by_rule=by_rule,
        client_id=client.id,
        in_task=current_task() is not None,
    )
    if objection:
        raise PoolError(objection)
    if others is not None:
        existing = ", ".join(map(repr, others)) or "none"
        logger.warning(
            "Partition %r has no workers. Its tasks wait until a worker with the resource %r joins "
            "the cluster. Existing partitions: %s.",
            name,
            name,
            existing,
        )
    record_registration(client, name, connection)
    return str(divided_on)


@dataclass(frozen=True)
class PartitionCapacity:
    """How many tasks of a given size a client can run in a partition."""

    # Number of tasks that the client can run at a time, once all adaptive jobs have started. If
    # other clients use the partition, this is its share of the slots, plus slots that nobody uses.
    max_running: int
    slots: int  # number of slots of all workers
    free: float  # number of slots without a task
    idle_s: float  # total time for which slots had no task, times the number of these slots
    has_workers: bool  # whether a worker exists, is queued or starting, or can be started
    rejection: str  # reason why the tasks could never run, or ""


def request_capacity(client: Client, name: str, slots: int, by_rule: str) -> PartitionCapacity:
    """Ask the scheduler how many tasks with `slots` slots a partition can run, if any.

    The arguments are the same as in `register`.
    """
    running = current_task()
    answer: PartitionCapacity = run_on_scheduler(
        client,
        _capacity,
        name=name,
        slots=slots,
        by_rule=by_rule,
        client_id=client.id,
        task_key=None if running is None else running[1].key,
    )
    return answer


# -- on the scheduler --------------------------------------------------------------------


class Registrations(SchedulerPlugin):
    """Scheduler plugin that stores registered clients and rejects their impossible tasks."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        # {partition: {client ID: whether this client keeps the registrations of all clients}}
        self.clients: dict[str, dict[str, bool]] = {}
        self.with_rule: set[str] = set()  # partitions that have or had a rule
        self._rules = MethodRules()
        try:
            require_feature(REFUSING)
            add_arrival_rule(self._rules, scheduler, self._check)
        except PoolError as error:  # partitions are useful without this check
            logger.warning(
                "Partitions: Tasks that can never run wait instead of failing. %s", error
            )
        scheduler.add_plugin(self)

    # -- clients -----------------------------------------------------------------------

    def register(self, name: str, client: str, keeps: bool, has_or_had_rule: bool) -> None:
        """Register a client for a partition."""
        self.clients.setdefault(name, {})[client] = keeps
        if has_or_had_rule:
            self.with_rule.add(name)

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Remove all registrations of a client that has left."""
        for name in [name for name, clients in self.clients.items() if client in clients]:
            self.unregister(name, client)

    def unregister(self, name: str, client: str) -> None:
        """Remove a client's registration for a partition.

        If no other client keeps the registrations of a partition without a rule, all of them are
        removed.
        """
        clients = self.clients[name]
        clients.pop(client, None)
        if not has_rule(self.scheduler, name) and not any(clients.values()):
            clients.clear()
            disable_features(self.scheduler, name)
        if not clients:
            del self.clients[name]
            self.with_rule.discard(name)
        if not self.clients:
            self._rules.remove_all()
            self.scheduler.remove_plugin(NAME)
            statistics = self.scheduler.plugins.get(STATISTICS)
            if statistics is not None and not statistics.is_kept:
                forget_statistics(self.scheduler)

    # -- tasks -------------------------------------------------------------------------

    def _check(self, graph: dict[str, Any]) -> dict[str, Any]:
        """Check an arriving graph, and replace the names of members by addresses.

        Raises
        ------
        PoolError
            If the graph contains a task that could never run.
        """
        annotations = graph["global_annotations"] or {}
        client = graph["client"]
        memory = annotations.get(MEMORY, 0)
        for resources in graph["annotations_by_type"].get("resources", {}).values():
            self._refuse(client, resources, memory)
        resources = annotations.get("resources")
        if not isinstance(resources, dict):  # None or a callable
            return graph
        self._refuse(client, resources, memory)
        if not annotations.get("workers"):
            return graph
        return {**graph, "global_annotations": self._with_members(annotations)}

    def _with_members(self, annotations: Mapping[str, Any]) -> Mapping[str, Any]:
        """Replace the selected workers in the annotations of a graph by addresses of members.

        Raises
        ------
        PoolError
            If a worker does not belong to the partition.
        """
        workers = annotations["workers"]
        name = annotations.get(CLIENT_OF)  # of a `PartitionClient`
        if name is None and all(isinstance(worker, MemberName) for worker in workers):
            [name] = annotations["resources"]
        elif name is None:
            return annotations
        elif annotations.get("allow_other_workers"):
            # If none of the workers is a member, Dask would ignore the resource as well.
            members = workers_declaring(self.scheduler, name)
            names = {alias for m in members for alias in (m.address, str(m.name), m.host)}
            workers = [worker for worker in workers if str(worker) in names]
            if not workers:
                placing = ("workers", "allow_other_workers")
                return {key: value for key, value in annotations.items() if key not in placing}
        hosts = [host for host in workers if host in self.scheduler.host_info]
        names_of_workers = [worker for worker in workers if worker not in hosts]
        addresses = addresses_of_members(self.scheduler, name, names_of_workers)
        return {**annotations, "workers": addresses + hosts}

    def _refuse(self, client: str, resources: Mapping[str, Any], memory: int) -> None:
        """Raise PoolError if a client's tasks that request this could never run."""
        partitions = [name for name in resources if client in self.clients.get(name, ())]
        if partitions and len(resources) > 1:
            self._refuse_two_partitions(resources)
        for name in partitions:
            slots = resources[name]
            if not isinstance(slots, int | float) or not slots >= 0:
                raise PoolError(
                    f"Invalid value {slots!r} for the slots of a task in partition {name!r}. "
                    "Expected a number of at least 0."
                )
            divided_on = str(self.scheduler.id) if name in self.with_rule else ""
            objection = rejection_reason(self.scheduler, name, slots, divided_on)
            if not objection and memory:
                objection = memory_rejection_reason(self.scheduler, name, slots, memory)
            if objection:
                raise PoolError(objection)

    def _refuse_two_partitions(self, resources: Mapping[str, Any]) -> None:
        """Raise PoolError if a task requests slots in partitions that share no worker."""
        known = {*self.clients, *names_with_rule(self.scheduler), *adaptive_names(self.scheduler)}
        names = sorted(name for name in resources if name in known)
        workers = self.scheduler.workers.values()
        if len(names) > 1 and not any(w.resources.keys() >= {*names} for w in workers):
            raise PoolError(
                f"A task requests slots in the partitions {' and '.join(map(repr, names))}, but a "
                "worker belongs to at most one partition. Submit the task to one of them, outside "
                "of `with` blocks of the others."
            )


async def _register(
    name: str,
    slots: int,
    by_rule: str,
    client_id: str,
    in_task: bool,
    dask_scheduler: Any = None,
) -> tuple[str, str, list[str] | None]:
    """Register a client, unless its task could never run.

    Returns
    -------
    divided_on
        ID of the scheduler on which a division of the pool has created the partition, or "".
    rejection
        Reason why the task could never run, or "".
    others
        Names of all partitions if this partition has no workers and expects none, otherwise None.
    """
    registrations: Registrations | None = dask_scheduler.plugins.get(NAME)
    ruled = has_rule(dask_scheduler, name)
    was_ruled = registrations is not None and name in registrations.with_rule
    divided_on = str(dask_scheduler.id) if ruled or was_ruled else by_rule
    objection = rejection_reason(dask_scheduler, name, slots, divided_on)
    # The last request of a client that was killed may arrive after the client was removed.
    if not objection and client_id in dask_scheduler.clients:
        # The client of a worker stays connected as long as the worker. Therefore, it must not keep
        # the features enabled that other clients have enabled.
        keeps = not (in_task and (ruled or name in names_with_features(dask_scheduler)))
        registrations = registrations or Registrations(dask_scheduler)
        registrations.register(name, client_id, keeps, bool(divided_on))
        statistics_of(dask_scheduler, keep=False)
        if not ruled:  # otherwise, the division of the pool has enabled them
            enable_features(dask_scheduler, [name])
        await wait_for_features()
    others = None
    if not expects_any_worker(dask_scheduler, name, slots):
        others = partition_names(dask_scheduler)
    return divided_on, objection, others


def partition_names(dask_scheduler: Any = None) -> list[str]:
    """Return the names of all partitions, including those without workers.

    Runs on the scheduler.
    """
    declared = {
        name
        for worker in dask_scheduler.workers.values()
        for name, slots in worker.resources.items()
        if slots
    }
    return sorted(declared | adaptive_names(dask_scheduler) | names_with_rule(dask_scheduler))


def expects_any_worker(scheduler: Any, name: str, slots: float) -> bool:
    """Return whether a partition has a worker, or can expect one."""
    steward: Steward | None = scheduler.plugins.get(STEWARD)
    return bool(
        has_worker_for(scheduler, name, slots)
        or (steward is not None and steward.members(name))
        or expects_workers(scheduler, name)
    )


def _capacity(
    name: str,
    slots: int,
    by_rule: str,
    client_id: str,
    task_key: Any,
    dask_scheduler: Any = None,
) -> PartitionCapacity:
    total = int(sum(dask_scheduler.resources.get(name, {}).values()))
    use = slot_use(dask_scheduler, name, total, client_id, task_key)
    max_running = max_running_tasks(dask_scheduler, name, slots)
    if total:
        max_running = min(max_running, math.ceil(max_running * use.usable / total))
    return PartitionCapacity(
        max_running,
        total,
        use.free,
        use.idle_s,
        expects_any_worker(dask_scheduler, name, slots),
        rejection_reason(dask_scheduler, name, slots, by_rule),
    )


def release_partitions(
    scheduler: Any, names: Iterable[str], client: str = "", had_rule: bool = False
) -> None:
    """Disable features in partitions without a rule, unless other clients are registered.

    Parameters
    ----------
    scheduler, names
        Scheduler, and names of the partitions.
    client
        ID of a client whose registration is removed.
    had_rule
        Whether these partitions had a rule until now.
    """
    for name in names:
        registrations: Registrations | None = scheduler.plugins.get(NAME)
        if registrations is None or name not in registrations.clients:
            disable_features(scheduler, name)
            continue
        if had_rule:
            registrations.with_rule.add(name)
        registrations.unregister(name, client)


def release_statistics(scheduler: Any) -> None:
    """Delete the statistics, either now or when the last registered client leaves."""
    if NAME in scheduler.plugins:
        statistics_of(scheduler).is_kept = False
    else:
        forget_statistics(scheduler)


def has_rule(scheduler: Any, name: str) -> bool:
    """Return whether a partition was created by dividing the pool and still exists."""
    steward: Steward | None = scheduler.plugins.get(STEWARD)
    return steward is not None and name in steward.rules


def rejection_reason(scheduler: Any, name: str, slots: float, divided_on: str) -> str:
    """Return why a task could never run in a partition, or "" if it can.

    `divided_on` is the ID of the scheduler on which a division has created the partition, or "". If
    the partition has no members, the task waits, because the only member may be restarting.
    """
    if has_worker_for(scheduler, name, slots):
        return ""
    members = [worker for worker in workers_declaring(scheduler, name) if worker.resources[name]]
    if divided_on and not members and not has_rule(scheduler, name):
        if divided_on != scheduler.id:
            return (
                f"Partition {name!r} was lost when the scheduler was restarted. "
                "Divide the pool again."
            )
        return f"Partition {name!r} was dissolved. Divide the pool again, or use another partition."
    steward: Steward | None = scheduler.plugins.get(STEWARD)
    records = steward.members(name) if steward is not None else []
    max_slots = max(
        slots_of_new_worker(scheduler, name),
        *(worker.resources[name] for worker in members),
        *(record.slots for record in records),  # includes members that are restarting
        0,
    )
    if not max_slots or slots <= max_slots:
        return ""
    return (
        f"A task requests {slots:g} slots on one worker, but workers of partition {name!r} have "
        f"at most {max_slots:g}. Request fewer slots, or increase the slots per worker with "
        f'`slots={slots:g}` in the rule or with `--resources "{name}={slots:g}"`.'
    )


def memory_rejection_reason(scheduler: Any, name: str, slots: float, memory: int) -> str:
    """Return why no worker of a partition could run a task with so much memory, or "".

    Members that are restarting count. If there are no members with enough slots, the task waits.
    """
    limits = [
        memory_limit(worker)
        for worker in workers_declaring(scheduler, name)
        if worker.resources[name] >= slots
    ]
    steward: Steward | None = scheduler.plugins.get(STEWARD)
    if steward is not None:
        limits += [r.info.memory for r in steward.members(name) if r.slots >= slots]
    if not limits or memory <= max(limits):
        return ""
    workers = f"the workers of partition {name!r}"
    if slots > 1:
        workers = f"those workers of partition {name!r} that have {slots:g} slots"
    if not any(limits):
        return (
            f"A task requests {format_bytes(memory)} of memory, but {workers} have no memory "
            "limit. Start them with one, for example with `--memory-limit`, or remove `memory`."
        )
    return (
        f"A task requests {format_bytes(memory)} of memory on one worker, but {workers} have at "
        f"most {format_bytes(max(limits))}. Request less, or increase the memory limit of the "
        "workers."
    )


def addresses_of_members(scheduler: Any, name: str, workers: Sequence[str]) -> list[str]:
    """Return the current address of each member, given its name or address.

    An address without a worker is returned unchanged, because the worker may have just left.

    Raises
    ------
    PoolError
        If a worker does not belong to the partition.
    """
    members = {
        worker.address: str(worker.name)
        for worker in workers_declaring(scheduler, name)
        if worker.resources[name]
    }
    addresses: list[str] = []
    for worker in map(str, workers):
        matches = [address for address, member in members.items() if worker in (address, member)]
        if not matches and ("://" not in worker or worker in scheduler.workers):
            present = ", ".join(sorted(members.values())[:9]) or "none"
            raise PoolError(
                f"Worker {worker!r} does not belong to partition {name!r}. Pass names or "
                f"addresses of its current members: {present}."
            )
        addresses += matches or [worker]
    return addresses
