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
        self.held: dict[tuple[str, str], set[str]] = {}  # {(client, resource): keys to come}

    def promised(self, scheduler: Any, client: str, resource: str) -> int:
        """Slots of a resource that are promised to other clients, for tasks not there yet."""
        for keys in self.held.values():
            keys.difference_update([key for key in keys if key in scheduler.tasks])
        return sum(len(k) for (c, r), k in self.held.items() if r == resource and c != client)

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Forget what a client was promised that has left."""
        for held in [held for held in self.held if held[0] == client]:
            del self.held[held]
        if not self.held:
            scheduler.remove_plugin(NAME)


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
        Keys of the tasks.
    """
    answer = on_scheduler(client, _claim, owner=client.id, resource=resource, keys=list(keys))
    return Claim(*answer)


def drop_claim(client: Client, resource: str) -> None:
    """Give back what a client was granted and has not used; no error if that is nothing."""
    on_scheduler(client, _drop, owner=client.id, resource=resource)


def _claim(
    owner: str, resource: str, keys: list[str], dask_scheduler: Any = None
) -> tuple[bool, dict[str, int], int]:
    free = free_slots(dask_scheduler, resource)
    slots = sum(int(ws.resources[resource]) for ws in usable_members(dask_scheduler, resource))
    claims = dask_scheduler.plugins.get(NAME)
    others = claims.promised(dask_scheduler, owner, resource) if claims else 0
    granted = sum(max(0, count) for count in free.values()) - others >= len(keys)
    if granted:
        if claims is None:
            claims = Claims()
            dask_scheduler.add_plugin(claims, name=NAME)
        claims.held[owner, resource] = set(keys)
    return granted, free, slots


def _drop(owner: str, resource: str, dask_scheduler: Any = None) -> None:
    claims = dask_scheduler.plugins.get(NAME)
    if claims is not None:
        claims.held.pop((owner, resource), None)
        if not claims.held:
            dask_scheduler.remove_plugin(NAME)
