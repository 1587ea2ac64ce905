"""The two parts of a pipe on the scheduler: a Queue of items and a Variable with its state.

Changes of the state run on the scheduler, in its event loop, one at a time. If each side
read the Variable, changed it and wrote it back, a `close` could undo a `fail` of the same
moment; and a write after the pipe was deleted would bring half of it back.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from distributed import Client, Queue

from .pipe_owners import drop_owners, note_owner
from .remote import on_scheduler

_LATE_WORD_S = 2.0  # clients send such words every few milliseconds


@dataclass(frozen=True)
class PipeState:
    """What a pipe's Variable holds."""

    closed: bool = False
    failure: str = ""  # the reason, empty while there is none
    advice: int = 1


class AttachedQueue(Queue):
    """A Queue that exists already.

    Constructing a `Queue` creates it where it does not exist and counts as a reference, which
    a killed worker never gives back: a consumer that starts late would revive the queue of
    a pipe that was deleted. This one does neither.
    """

    def _maybe_start(self) -> None:
        """Do not create the queue."""


def open_pipe(client: Client, name: str) -> bool:
    """Make both parts; False if there is a pipe of that name."""
    state = asdict(PipeState())
    return bool(on_scheduler(client, _open, name=name, owner=client.id, state=state))


def change_pipe(client: Client, name: str, **changes: Any) -> PipeState | None:
    """Change fields of the state; returns what it is now, or None if there is no such pipe."""
    state = on_scheduler(client, _change, name=name, changes=changes)
    return None if state is None else PipeState(**state)


def forget_pipes(client: Client, names: Sequence[str]) -> None:
    """Remove these pipes from the scheduler, with what is in them; those unknown are skipped."""
    on_scheduler(client, _forget, names=list(names))


async def _open(name: str, owner: str, state: dict[str, Any], dask_scheduler: Any = None) -> bool:
    queues = dask_scheduler.extensions["queues"]
    variables = dask_scheduler.extensions["variables"]
    if name in queues.queues or name in variables.variables:
        return False
    if owner not in dask_scheduler.clients:
        # It was killed, and its last question is read after that was seen: nobody would take
        # the pipe away, nor hear the answer.
        return False
    # Without `maxsize`: see `Pipe.put`.
    queues.create(name=name)
    note_owner(dask_scheduler, name, owner, _forget)
    await variables.set(name=name, data=state)
    return True


async def _change(
    name: str, changes: dict[str, Any], dask_scheduler: Any = None
) -> dict[str, Any] | None:
    variables = dask_scheduler.extensions["variables"]
    if name not in variables.variables:
        return None
    state: dict[str, Any] = {**variables.variables[name]["value"]}
    if state["failure"]:  # the first reason is the cause, later ones are its consequences
        changes = {key: value for key, value in changes.items() if key != "failure"}
    state |= changes
    await variables.set(name=name, data=state)
    return state


async def _forget(names: list[str], dask_scheduler: Any = None) -> None:
    queues = dask_scheduler.extensions["queues"]
    variables = dask_scheduler.extensions["variables"]
    drop_owners(dask_scheduler, names)
    for name in names:
        while name in queues.queues:
            queues.release(name=name, client="poolpart")
        _forget_counts(queues, name)
        # A consumer's word that it has a future may still be under way, and would be counted.
        asyncio.get_running_loop().call_later(_LATE_WORD_S, _forget_counts, queues, name)
        # Futures that were taken by a consumer which died before it could say so.
        if f"queue-{name}" in dask_scheduler.clients:
            dask_scheduler.remove_client(f"queue-{name}")
        if name in variables.variables:
            await variables.delete(name=name, client="poolpart")


def _forget_counts(queues: Any, name: str) -> None:
    if name not in queues.queues:
        for counted in [counted for counted in queues.future_refcount if counted[0] == name]:
            del queues.future_refcount[counted]
