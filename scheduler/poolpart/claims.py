"""Slots for several tasks that need each other, or none: a scheduler's plugin.

Two users that each start four such tasks on four slots at the same moment may get two of them
running each, and both wait for the other for ever. Hence one asks before, and the scheduler,
which does one thing at a time, says yes to one of them.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .remote import on_scheduler
from .slots import free_slots, usable_members

NAME = "poolpart-claims"


@dataclass(frozen=True)
class Claim:
    """What came of a claim.

    Parameters
    ----------
    granted
        Whether the tasks may be submitted now.
    free
        Slots that no task holds or waits for, by address of the worker, as in `Slots`.
    slots
        Slots of all workers that take tasks at the moment, free or not.
    """

    granted: bool
    free: dict[str, int]
    slots: int


class Claims(SchedulerPlugin):
    """Knows for which tasks slots are promised; there as long as there are promises."""

    def __init__(self) -> None:
        self.held: dict[str, tuple[str, str]] = {}  # {key of a task to come: (client, resource)}

    def promised(self, scheduler: Any, resource: str, besides: Collection[str]) -> int:
        """Slots of a resource that are promised for tasks not there yet, but for these keys."""
        for key in [key for key in self.held if key in scheduler.tasks]:
            del self.held[key]
        return sum(r == resource for key, (_, r) in self.held.items() if key not in besides)

    def drop(self, scheduler: Any, keys: Collection[str]) -> None:
        """Forget promises; the last one takes the plugin with it."""
        for key in keys:
            self.held.pop(key, None)
        if not self.held:
            scheduler.remove_plugin(NAME)

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Forget what a client was promised that has left."""
        self.drop(scheduler, [key for key, (owner, _) in self.held.items() if owner == client])


def claim_slots(client: Client, resource: str, keys: Collection[str]) -> Claim:
    """Ask for a slot for each of some tasks that are about to be submitted, all or none.

    Once granted, nobody else is granted these slots until the tasks are there, or the claim is
    dropped, or the client has left. It binds those who ask; others' tasks take slots as ever.

    Parameters
    ----------
    client
        Client of the cluster.
    resource
        Name of the partition.
    keys
        Keys of the tasks, which nobody else uses. Who asks for them again is not in their own way.
    """
    answer = on_scheduler(client, _claim, owner=client.id, resource=resource, keys=list(keys))
    return Claim(*answer)


def drop_claim(client: Client, keys: Collection[str]) -> None:
    """Give back what was granted for these keys and has not been used; no error if nothing was."""
    on_scheduler(client, _drop, keys=list(keys))


def _claim(
    owner: str, resource: str, keys: list[str], dask_scheduler: Any = None
) -> tuple[bool, dict[str, int], int]:
    free = free_slots(dask_scheduler, resource)
    slots = sum(int(ws.resources[resource]) for ws in usable_members(dask_scheduler, resource))
    claims = dask_scheduler.plugins.get(NAME)
    others = claims.promised(dask_scheduler, resource, set(keys)) if claims else 0
    granted = sum(max(0, count) for count in free.values()) - others >= len(keys)
    # A client that was killed may be known to have left before its last question is read, and
    # nobody would take back what it is promised then.
    granted = granted and owner in dask_scheduler.clients
    if granted:
        if claims is None:
            claims = Claims()
            dask_scheduler.add_plugin(claims, name=NAME)
        claims.held.update(dict.fromkeys(keys, (owner, resource)))
    return granted, free, slots


def _drop(keys: list[str], dask_scheduler: Any = None) -> None:
    claims = dask_scheduler.plugins.get(NAME)
    if claims is not None:
        claims.drop(dask_scheduler, keys)
