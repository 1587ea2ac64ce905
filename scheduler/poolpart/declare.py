"""Making partitions of the workers of a running cluster, and undoing them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from distributed import Client

from .book import Seat, names_of
from .errors import PoolError
from .fence import enclose, fences_of, lower
from .inherit import begin_inheritance, end_inheritance
from .internals import asks_for, lift_restrictions
from .page import close_page
from .reconciler import LOOK_EVERY_S
from .remote import on_scheduler
from .rules import Rule
from .stats import forget_statistics, statistics_of
from .steward import Steward, steward_of
from .wording import counted
from .worker_info import WorkerInfo

PATIENCE_S = 60.0  # for a worker to answer


def ask(client: Client, function: Callable[..., Any], **arguments: Any) -> Any:
    """Call `function(steward, **arguments)` on the scheduler.

    Raises
    ------
    PoolError
        If it raises one there.
    """
    result, complaint = on_scheduler(client, _answer, question=function, arguments=arguments)
    if complaint:
        raise PoolError(complaint)
    return result


async def _answer(
    question: Callable[..., Any], arguments: Mapping[str, Any], dask_scheduler: Any = None
) -> tuple[Any, str]:
    # An error that is raised here would be in the scheduler's log with a traceback.
    with steward_of(dask_scheduler) as steward:
        try:
            return await question(steward, **arguments), ""
        except PoolError as error:
            return None, str(error)


def declare(
    client: Client,
    rules: Mapping[str, Rule],
    chosen: Mapping[str, Sequence[WorkerInfo]],
    pool: Sequence[WorkerInfo],
) -> str:
    """Make partitions, and have the scheduler follow their rules from now on; all or none.

    It is one question to the scheduler: a client that dies leaves the whole answer behind, or
    nothing, and of two that ask at the same moment one is first.

    Parameters
    ----------
    client
        Client of their cluster.
    rules
        Rules by partition.
    chosen
        Workers to begin with, by partition.
    pool
        All workers, as the client saw them when it chose.

    Returns
    -------
    note
        What a user should know of all of them; empty for nothing.

    Raises
    ------
    PoolError
        If one of them left meanwhile, somebody else has put it into a partition or made a
        partition of such a name, or other workers have it.
    """
    note: str = ask(
        client,
        _declare,
        rules=dict(rules),
        chosen={name: [worker.address for worker in chosen[name]] for name in rules},
        seen=sorted({name for worker in pool for name in worker.partitions}),
        gpus={worker.address: worker.gpus for worker in pool},
    )
    return note


async def _declare(
    steward: Steward,
    rules: Mapping[str, Rule],
    chosen: Mapping[str, Sequence[str]],
    seen: Collection[str],
    gpus: Mapping[str, Sequence[str]],
) -> str:
    # Up to the first await nothing else happens on the scheduler.
    seats = {name: [_seat(steward, name, a) for a in chosen[name]] for name in rules}
    for name in rules:
        _check_sole(steward, name, seats[name], seen)
    note = _begin(steward, rules)
    for address, devices in gpus.items():
        if devices and (seat := steward.reconciler.seat_at(address)):
            seat.info = seat.info.with_gpus(devices)
    for name, rule in rules.items():
        steward.book.enter(name, rule)
        for seat in seats[name]:
            steward.book.put(seat, name, rule.slots_of(seat.info))
    everyone = [seat for group in seats.values() for seat in group]
    late = await steward.reconciler.arrive(everyone, PATIENCE_S)
    if late or not all(seat.holds for seat in everyone):
        away = [seat for seat in everyone if seat in late or not seat.holds]
        raise PoolError(
            f"{names_of(away)} left, or did not answer, while being put into partition "
            f"{' and '.join(sorted({str(seat.partition) for seat in away}))}; the other workers "
            "are in theirs. Make the pool anew to divide it again."
        )
    return note


def _begin(steward: Steward, rules: Mapping[str, Rule]) -> str:
    """Have tasks inherit the partitions, raise or lower their fences, and count their tasks."""
    scheduler, book, note = steward.scheduler, steward.book, ""
    try:
        for name, rule in rules.items():
            note = begin_inheritance(scheduler, name)
            if rule.exclusive:
                enclose(scheduler, name)
            elif name in book.rules and book.rules[name].exclusive:
                lower(scheduler, name)
    except PoolError:  # this version of Dask lacks what fences build on
        for name in rules.keys() - book.rules.keys():
            lower(scheduler, name)
            end_inheritance(scheduler, name)
        raise
    statistics_of(scheduler)
    return note


def _seat(steward: Steward, name: str, address: str) -> Seat:
    seat = steward.reconciler.seat_at(address)
    if seat is None:
        raise PoolError(
            f"The worker at {address} could not be put into partition {name!r}: it has left. "
            "Make the pool anew and divide that."
        )
    if others := sorted(_declared_by(steward, seat) - {name}):
        raise PoolError(
            f"Worker {seat.info.name} already declares {', '.join(others)}; a worker belongs to "
            f"one partition. If somebody has put it there meanwhile, make the pool anew "
            "(Pool.from_client) and divide what is left."
        )
    return seat


def _check_sole(steward: Steward, name: str, chosen: Sequence[Seat], seen: Collection[str]) -> None:
    """Refuse a partition that others have; one that was seen can be made again."""
    seats = steward.book.seats.values()
    members = [s for s in seats if s.absent_since is None and name in _declared_by(steward, s)]
    if members and name not in seen:
        raise PoolError(
            f"Somebody else has made a partition {name!r} meanwhile, with {names_of(members)}: "
            f"use Pool.partitions()[{name!r}] of a new pool, or give another name."
        )
    if others := [seat for seat in members if seat not in chosen]:
        raise PoolError(
            f"There is a partition {name!r} already, with {names_of(others)}, which this "
            f"call does not choose: give another name, or use Pool.partitions()[{name!r}]."
        )


def _declared_by(steward: Steward, seat: Seat) -> set[str]:
    """Partitions that a worker belongs to, or soon will."""
    return {name for name, slots in steward.book.wanted(seat).items() if slots}


_RETURN_S = 10.0  # for workers to declare what they did before, at least
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
        end_inheritance(scheduler, None)
        close_page(scheduler)
        forget_statistics(scheduler)
    for seat in seats:
        book.put(seat, None)
    lift_restrictions(scheduler, gone)
    late = await steward.reconciler.arrive(seats, max(timeout_s, _RETURN_S))
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
