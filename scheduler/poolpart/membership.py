"""Members of a partition as a client knows them, so that no task waits in vain."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from distributed import Client

from .adapting import slots_of_new_worker
from .errors import PoolError
from .inherit import begin_inheritance, is_inherited, workers_informed
from .internals.worker import task_of_thread
from .steward import NAME as STEWARD
from .steward import Steward
from .workers import on_scheduler

KEEP_S = 1.0  # for which an answer is kept: a request for each task would take a millisecond


@dataclass(frozen=True)
class Membership:
    """Members of a partition when the scheduler was asked."""

    names: Mapping[str, str]  # {address of a present member: its name}
    max_slots: float  # of one member, including members that are starting or may be started
    has_rule: bool  # the scheduler has a rule for the partition
    nonmembers: frozenset[str]  # addresses of all other workers


# {client: {partition: (time.monotonic() of the request, its answer)}}
_answers: WeakKeyDictionary[Client, dict[str, tuple[float, Membership]]] = WeakKeyDictionary()


def membership(client: Client, name: str, fresh: bool = False) -> Membership:
    """Ask for the members of a partition, at most once a second unless `fresh`.

    From then on, tasks from inside tasks of the partition belong to it, if they did not yet, until
    the client closes.

    Raises
    ------
    PoolError
        If the scheduler lacks this package, or the client is closed or asynchronous.
    """
    answers = _answers.setdefault(client, {})
    requested_at, answer = answers.get(name, (0.0, None))
    if answer is None or fresh or time.monotonic() - requested_at > KEEP_S:
        requested_at = time.monotonic()
        in_task = task_of_thread() is not None
        answer = on_scheduler(client, _look, name=name, client_id=client.id, in_task=in_task)
        answers[name] = requested_at, answer
    return answer


def forget_memberships() -> None:
    """Forget all answers, because a partition has changed."""
    _answers.clear()


def check_slots(client: Client, name: str, slots: int, made_by_rule: bool) -> bool:
    """Check that a partition may run a task; return whether the partition has, or had, a rule.

    Raises
    ------
    PoolError
        If the partition was dissolved, or no member has so many slots. Without any members the task
        waits: the only member may be starting again.
    """
    objection = ""
    for fresh in (False, True):
        members = membership(client, name, fresh)
        objection = _objection(members, name, slots, made_by_rule)
        if not objection:
            return members.has_rule or made_by_rule
    raise PoolError(objection)


def _objection(members: Membership, name: str, slots: int, made_by_rule: bool) -> str:
    """Return why a partition cannot run a task, or an empty string."""
    if made_by_rule and not members.has_rule and not members.names:
        return f"Partition {name!r} was dissolved: divide the pool again, or use another partition."
    if members.max_slots and slots > members.max_slots:
        return (
            f"A task asks for {slots} slots of one worker, and workers of partition {name!r} have "
            f"{members.max_slots:g} at most: ask for fewer, or give them more, by slots={slots} in "
            f'its rule or by --resources "{name}={slots}".'
        )
    return ""


def addresses_of(client: Client, name: str, workers: Sequence[str]) -> list[str]:
    """Return the present addresses of members, given by names or addresses.

    An address without any worker is returned as given.

    Raises
    ------
    PoolError
        If a worker does not belong to the partition.
    """
    members = membership(client, name)
    if set(workers) - members.names.keys():  # a member may have another address than before
        members = membership(client, name, fresh=True)
    addresses: list[str] = []
    for worker in workers:
        matches = [
            address
            for address, member_name in members.names.items()
            if worker in (address, member_name)
        ]
        if not matches and ("://" not in worker or worker in members.nonmembers):
            present = ", ".join(sorted(members.names.values())[:9]) or "none at the moment"
            raise PoolError(
                f"Worker {worker!r} does not belong to partition {name!r}: give names or "
                f"addresses of its members ({present})."
            )
        addresses += matches or [worker]
    return addresses


async def _look(name: str, client_id: str, in_task: bool, dask_scheduler: Any = None) -> Membership:
    """Return the members of a partition, and begin inheritance for a client; on the scheduler."""
    steward: Steward | None = dask_scheduler.plugins.get(STEWARD)
    has_rule = steward is not None and name in steward.rules
    workers = dask_scheduler.workers
    members = {
        address: str(worker.name)
        for address, worker in workers.items()
        if worker.resources.get(name)
    }
    slots = [workers[address].resources[name] for address in members]
    slots.append(slots_of_new_worker(dask_scheduler, name))
    if steward is not None:
        slots += [seat.slots for seat in steward.members(name)]
    # The last request of a client that was killed may come after it has left.
    if not has_rule and client_id in dask_scheduler.clients:
        # A worker's client closes only with the worker, so that it must not prolong an inheritance
        # that other clients have begun.
        if not (in_task and is_inherited(dask_scheduler, name)):
            begin_inheritance([name], dask_scheduler, client_id)
        await workers_informed()
    nonmembers = frozenset(workers.keys() - members.keys())
    return Membership(members, max(slots, default=0), has_rule, nonmembers)
