"""Undoing partitions: the cluster is as it was found."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection
from typing import Any

from distributed import Client

from .book import names_of
from .declare import ask
from .errors import PoolError
from .fence_plugin import fences_of, lower
from .inherit import end_inheritance
from .page_server import close_page
from .placing import asks_for
from .settling import LOOK_EVERY_S
from .stats import forget_statistics
from .steward import Steward
from .wording import counted

_PATIENCE_S = 10.0  # for workers to declare what they did before, at least
_LOOK_SHARE = 20  # the scheduler does other things for so many times as long as it looks
_UNFINISHED = ("waiting", "queued", "no-worker", "processing")


def dissolve(client: Client, names: Collection[str] | None, timeout_s: float) -> list[str]:
    """Undo partitions that were made while the cluster ran, all of them if None.

    Parameters
    ----------
    client
        Client of the cluster.
    names
        The partitions.
    timeout_s
        How long to wait for their tasks to end.

    Returns
    -------
    list of str
        Names of the partitions that there were.

    Raises
    ------
    PoolError
        If tasks of theirs have not ended; then they stay.
    """
    asked = None if names is None else list(names)
    done: list[str] = ask(client, _dissolve, names=asked, timeout_s=timeout_s)
    return done


async def _dissolve(steward: Steward, names: list[str] | None, timeout_s: float) -> list[str]:
    book, scheduler = steward.book, steward.scheduler

    def those() -> list[str]:
        return [name for name in book.rules if names is None or name in names]

    deadline = time.monotonic() + timeout_s
    # What the client submitted just before comes by another connection, after some milliseconds.
    await asyncio.sleep(2 * LOOK_EVERY_S)
    began = time.monotonic()
    while tasks := _unfinished(scheduler, those()):
        now = time.monotonic()
        if now >= deadline:
            raise PoolError(
                f"After {timeout_s:g} s {counted(len(tasks), 'task')} of {' and '.join(those())} "
                f"had not ended, such as {tasks[0].key}: wait or cancel, then dissolve."
            )
        # To look at a hundred thousand tasks takes long; they are to end meanwhile.
        pause = max(LOOK_EVERY_S, _LOOK_SHARE * (now - began))
        await asyncio.sleep(min(pause, deadline - now))
        began = time.monotonic()
    # From here to the next await nothing else happens on the scheduler; up to here somebody else
    # may have dissolved the same partitions, or made some.
    gone = those()
    for name in gone:  # whoever was lent is a member of its own partition again
        steward.rebalancing.drop_all(name)
    seats = [seat for seat in book.seats.values() if seat.partition in gone]
    for name in gone:
        del book.rules[name]
        # Here and now, whatever becomes of the client and of workers that do not answer. A
        # fence may be there also if the rule does not say so: somebody has raised it.
        lower(scheduler, name)
        end_inheritance(scheduler, name)
    if names is None:
        for fence in fences_of(scheduler):  # raised by hand, of workers that were started so
            lower(scheduler, fence)
        close_page(scheduler)
        forget_statistics(scheduler)
    for seat in seats:
        book.put(seat, None)
    _lift_restrictions(scheduler, gone)
    late = await steward.settling.arrive(seats, max(timeout_s, _PATIENCE_S))
    for seat in seats:
        if not seat.holds:
            await steward.nannies.restore(seat)
    if late:
        raise PoolError(
            f"{names_of(late)} did not answer while {' and '.join(gone)} were dissolved; they "
            "become what they were when they do."
        )
    return gone


def _unfinished(scheduler: Any, names: Collection[str]) -> list[Any]:
    return [
        task
        for task in scheduler.tasks.values()
        if task.state in _UNFINISHED and asks_for(task, names)
    ]


def _lift_restrictions(scheduler: Any, names: Collection[str]) -> None:
    """Let results that are still held be computed again, if they are lost, on any worker.

    There is none any more that could take such a task: it would wait for ever.
    """
    for task in scheduler.tasks.values():
        if asks_for(task, names):
            kept = {n: q for n, q in task.resource_restrictions.items() if n not in names}
            task.resource_restrictions = kept or None
