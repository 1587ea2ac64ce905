"""What a client knows of a partition when it submits to it, so that nothing waits in vain."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from distributed import Client

from .adapting import slots_of_new_worker
from .errors import PoolError
from .inherit import begin_inheritance, is_inherited, workers_told
from .internals.worker import task_of_thread
from .steward import NAME as STEWARD
from .steward import Steward
from .workers import on_scheduler

KEEP_S = 1.0  # a request for each task would take a millisecond


@dataclass(frozen=True)
class Membership:
    """Members of a partition at one moment."""

    names: Mapping[str, str]  # of the present members, by address
    most: float  # slots of one member at most, also of one that is starting, or may be started
    has_rule: bool  # the scheduler has a rule for the partition
    strangers: frozenset[str]  # addresses of all other workers


_known: WeakKeyDictionary[Client, dict[str, tuple[float, Membership]]] = WeakKeyDictionary()


def membership(client: Client, name: str, fresh: bool = False) -> Membership:
    """Ask for the members of a partition, at most once a second unless `fresh`.

    From then on, tasks from inside tasks of the partition belong to it, if they did not yet, until
    the client closes.

    Raises
    ------
    PoolError
        If the scheduler lacks this package, or the client is closed or asynchronous.
    """
    known = _known.setdefault(client, {})
    when, found = known.get(name, (0.0, None))
    if found is None or fresh or time.monotonic() - when > KEEP_S:
        asked = time.monotonic()
        options = {"asking": client.id, "in_task": task_of_thread() is not None}
        found = on_scheduler(client, _look, name=name, **options)
        known[name] = asked, found
    return found


def forget_memberships() -> None:
    """Ask again before the next task, because a partition has changed."""
    _known.clear()


def check_slots(client: Client, name: str, slots: int, made_by_rule: bool) -> bool:
    """Check that a partition may run such a task; returns whether it has a rule, or had.

    Raises
    ------
    PoolError
        If it was dissolved, or no member has so many slots. Without any members the task waits:
        the only one may be starting again.
    """
    for fresh in (False, True):
        found = membership(client, name, fresh)
        if not (doubt := _doubt(found, name, slots, made_by_rule)):
            return found.has_rule or made_by_rule
    raise PoolError(doubt)


def _doubt(found: Membership, name: str, slots: int, made_by_rule: bool) -> str:
    if made_by_rule and not found.has_rule and not found.names:
        return f"Partition {name!r} was dissolved: divide the pool again, or use another partition."
    if found.most and slots > found.most:
        return (
            f"A task asks for {slots} slots of one worker, and workers of partition {name!r} have "
            f"{found.most:g} at most: ask for fewer, or give them more, by slots={slots} in its "
            f'rule or by --resources "{name}={slots}".'
        )
    return ""


def addresses_of(client: Client, name: str, workers: Sequence[str]) -> list[str]:
    """Present addresses of members, from names or addresses.

    Raises
    ------
    PoolError
        If there is no such member. An address at which there is no worker at all is left as it is.
    """
    found = membership(client, name)
    if set(workers) - found.names.keys():  # a name that was known may have another address now
        found = membership(client, name, fresh=True)
    addresses = []
    for worker in workers:
        here = [a for a, its_name in found.names.items() if worker in (a, its_name)]
        if not here and ("://" not in worker or worker in found.strangers):
            members = ", ".join(sorted(found.names.values())[:9]) or "none at the moment"
            raise PoolError(
                f"Worker {worker!r} does not belong to partition {name!r}: give names or "
                f"addresses of its members ({members})."
            )
        addresses += here or [worker]
    return addresses


async def _look(name: str, asking: str, in_task: bool, dask_scheduler: Any = None) -> Membership:
    steward: Steward | None = dask_scheduler.plugins.get(STEWARD)
    has_rule = steward is not None and name in steward.rules
    here = dask_scheduler.workers
    members = {a: str(w.name) for a, w in here.items() if w.resources.get(name)}
    slots = [here[address].resources[name] for address in members]
    slots.append(slots_of_new_worker(dask_scheduler, name))
    if steward is not None:
        slots += [seat.slots for seat in steward.members(name)]
    # The last request of a client that was killed may come after it has left.
    if not has_rule and asking in dask_scheduler.clients:
        # A worker's client closes only with the worker: it is no reason to keep what others began.
        if not (in_task and is_inherited(dask_scheduler, name)):
            begin_inheritance([name], dask_scheduler, asking)
        await workers_told()
    strangers = frozenset(here.keys() - members.keys())
    return Membership(members, max(slots, default=0), has_rule, strangers)
