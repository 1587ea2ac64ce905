"""Requests of clients to the steward: make partitions, move workers, dissolve partitions.

Each is one request to the scheduler, which completes it or refuses it, also if the client dies
meanwhile; simultaneous requests run one after the other.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from distributed import Client

from .dashboard_page import close_page
from .errors import PoolError
from .fence import enclose, lower
from .inherit import begin_inheritance, end_inheritance, workers_told
from .internals.scheduler import asks_for, lift_restrictions
from .rules import Rule, check_count, divide
from .stats import forget_statistics, statistics_of
from .steward import Seat, Steward, names_of, steward_of
from .workers import WorkerInfo, on_scheduler

PATIENCE_S = 60.0  # for a worker to answer
_RETURN_S = 10.0  # for workers to declare their former resources, at least
_STAY_S = 1.0  # for workers that could not be moved to be members again
_LOOK_EVERY_S = 0.05  # between looks for tasks that have not ended
_MOVES = "The number of workers to move"
_UNFINISHED = ("waiting", "queued", "no-worker", "processing")


def ask(client: Client, question: Callable[..., Any], **arguments: Any) -> Any:
    """Call `question(steward, **arguments)` on the scheduler; a PoolError of it is raised here."""
    result, complaint = on_scheduler(client, _answer, question=question, arguments=arguments)
    if complaint:
        raise PoolError(complaint)
    return result


async def _answer(
    question: Callable[..., Any], arguments: Mapping[str, Any], dask_scheduler: Any = None
) -> tuple[Any, str]:
    # Raised here, the error would be in the scheduler's log with a traceback.
    with steward_of(dask_scheduler) as steward:
        try:
            return await question(steward, **arguments), ""
        except PoolError as error:
            return None, str(error)


# -- making partitions -----------------------------------------------------------------


async def declare(
    steward: Steward,
    rules: Mapping[str, Rule],
    now: Mapping[str, Rule],
    pool: Mapping[str, tuple[str, ...]],
    seen: Collection[str],
) -> tuple[dict[str, str], list[WorkerInfo]]:
    """Make partitions, and follow their rules from now on; all or none.

    `now` are the rules by which workers are chosen at first, `pool` the devices of the workers to
    choose from, by name, and `seen` the partitions that the client knew of. Returns notes by
    partition, and the workers that are left. PoolError if there are too few workers, if others have
    a partition of this name, or if a worker leaves meanwhile.
    """
    # Up to the first await nothing else happens on the scheduler.
    seats = {s.info.address: s for s in steward.seats.values() if not s.away}
    there = [replace(seat.info, resources=steward.wanted(seat)) for seat in seats.values()]
    # By name: a restarted worker has another address.
    mine = [worker.with_gpus(pool[worker.name]) for worker in there if worker.name in pool]
    chosen, notes = divide(now, mine)
    for name in rules:
        members = {worker.address for worker in there if name in worker.partitions}
        # One that the client knew of can be made again, of all of it.
        if others := members - ({w.address for w in chosen[name]} if name in seen else set()):
            raise PoolError(
                f"Partition {name!r} exists already, with {names_of(seats[a] for a in others)}, "
                "which this call did not see, or does not choose: use "
                f"Pool.partitions()[{name!r}] of a new pool, or give another name."
            )
    common = _begin(steward, rules)
    for worker in mine:
        if worker.gpus:
            seats[worker.address].info = seats[worker.address].info.with_gpus(worker.gpus)
    for name, rule in rules.items():
        steward.enter(name, rule)
        for worker in chosen[name]:
            steward.put(seats[worker.address], name, rule.slots_of(worker))
    await workers_told()  # before they get tasks
    taken = [seats[worker.address] for group in chosen.values() for worker in group]
    late = await steward.arrive(taken, PATIENCE_S)
    if away := [seat for seat in taken if seat in late or seat.gone]:
        raise PoolError(
            f"{names_of(away)} left, or did not answer, when assigned to partition "
            f"{' and '.join(sorted({str(seat.partition) for seat in away}))}; the other workers "
            "were assigned. Make a new pool to divide it again."
        )
    told = {name: "; ".join(filter(None, (notes.get(name), common))) for name in rules}
    return told, [worker for worker in mine if seats[worker.address] not in taken]


def _begin(steward: Steward, rules: Mapping[str, Rule]) -> str:
    """Let tasks inherit the partitions, raise or lower fences, and count tasks."""
    scheduler = steward.scheduler
    try:
        note = begin_inheritance(rules, scheduler)
        for name, rule in rules.items():
            if rule.exclusive:
                enclose(scheduler, name)
            elif name in steward.rules and steward.rules[name].exclusive:
                lower(scheduler, name)
    except PoolError:  # this version of Dask lacks what fences need
        for name in rules.keys() - steward.rules.keys():
            lower(scheduler, name)
            end_inheritance(scheduler, name)
        raise
    statistics_of(scheduler)
    return note


# -- moving workers --------------------------------------------------------------------
#
# A worker that leaves gets no new tasks of its partition; waiting tasks go to other members,
# running tasks end there; then it declares its new resources.


async def grow(
    steward: Steward, name: str, count: int, source: str | None, timeout_s: float
) -> list[str]:
    """Move workers into a partition; see `Partition.grow`. Returns their names."""
    check_count(_MOVES, count)
    steward.adopt(name)
    if source == name:
        raise PoolError(f"Partition {name!r} cannot take workers from itself.")
    if source is not None:
        steward.adopt(source)
    lender = source or steward.remainder()
    there = [] if source else [seat for seat in steward.free() if steward.settled(seat)]
    if lender is not None and lender != name:
        members = _arrived(steward, lender)
        there += members[: max(0, len(members) - steward.rules[lender].minimum)]
    if len(there) < count:
        place = f"partition {lender!r}, beyond its minimum," if source else "the remainder"
        raise PoolError(
            f"Partition {name!r} cannot grow by {count}: {place} has "
            f"{len(there)} spare workers. Start more, or shrink another partition first."
        )
    return await _move(steward, _by_load(steward, there)[:count], name, timeout_s)


async def shrink(steward: Steward, name: str, count: int, timeout_s: float) -> list[str]:
    """Move workers out of a partition; see `Partition.shrink`. Returns their names."""
    check_count(_MOVES, count)
    steward.adopt(name)
    members, least = _arrived(steward, name), steward.rules[name].minimum
    if len(members) - count < least:
        raise PoolError(
            f"Partition {name!r} cannot shrink by {count}: it has {len(members)} workers and "
            f"needs at least {least}."
        )
    target = steward.remainder()
    return await _move(steward, members[:count], None if target == name else target, timeout_s)


async def _move(
    steward: Steward, seats: Sequence[Seat], target: str | None, timeout_s: float
) -> list[str]:
    """Move workers; PoolError if some are not free in time, and those stay."""
    before = {seat: (seat.partition, seat.slots) for seat in seats}
    for seat in seats:
        steward.resize(seat.partition, -1)
        steward.resize(target, 1)
        steward.put(seat, target)
    late = await steward.arrive(seats, timeout_s)
    for seat in late:
        origin, slots = before[seat]
        if seat.partition != target or (origin and origin not in steward.rules):
            continue  # another client has moved it, or dissolved its partition
        steward.resize(target, -1)
        steward.resize(origin, 1)
        steward.put(seat, origin, slots)
    if late:
        await steward.arrive(late, _STAY_S)  # so that they can be moved again at once
        raise PoolError(
            f"{len(late)} of {len(seats)} workers could not be moved within "
            f"{timeout_s:g} s, because their tasks have not ended, or they do not answer: "
            f"{names_of(late)} stay."
        )
    return [seat.info.name for seat in seats if not seat.gone]


def _arrived(steward: Steward, name: str) -> list[Seat]:
    """Members that may be moved, by load; not those on their way, which may return."""
    return _by_load(steward, [s for s in steward.members(name) if steward.settled(s)])


def _by_load(steward: Steward, seats: Sequence[Seat]) -> list[Seat]:
    """Sort by load, workers with long-running tasks last."""

    def load(seat: Seat) -> tuple[int, int]:
        worker = steward.scheduler.workers[seat.info.address]
        return len(worker.long_running), len(worker.processing)

    return sorted(seats, key=load)


# -- undoing it ------------------------------------------------------------------------


async def dissolve(steward: Steward, names: Collection[str] | None, timeout_s: float) -> list[str]:
    """Undo partitions, all of them if None; see `Pool.dissolve`. Returns their names."""
    scheduler = steward.scheduler

    def those() -> list[str]:
        return [name for name in steward.rules if names is None or name in names]

    deadline = time.monotonic() + timeout_s
    # Tasks that the client just submitted arrive by another connection, milliseconds later.
    await asyncio.sleep(_LOOK_EVERY_S)
    while tasks := _unfinished(scheduler, those()):
        if time.monotonic() >= deadline:
            raise PoolError(
                f"After {timeout_s:g} s {len(tasks)} tasks of {' and '.join(those())} "
                f"had not ended, such as {tasks[0].key}: wait or cancel, then dissolve."
            )
        await asyncio.sleep(_LOOK_EVERY_S)
    # Until the next await nothing else happens on the scheduler; before, another client may have
    # dissolved the same partitions, or made some.
    gone = those()
    seats = [
        seat
        for seat in steward.seats.values()
        # Or it was started with one, and has left it.
        if seat.partition in gone
        or (seat.partition is None and not seat.found.keys().isdisjoint(gone))
    ]
    for name in gone:
        del steward.rules[name]
        # At once, even if the client dies or workers do not answer.
        lower(scheduler, name)
        end_inheritance(scheduler, name)
    if names is None:
        end_inheritance(scheduler, None)
    if not steward.rules:
        close_page(scheduler)
        forget_statistics(scheduler)
    for seat in seats:
        steward.put(seat, None)
    lift_restrictions(scheduler, gone)
    await workers_told()
    # An absent worker comes back as it was started.
    here = [seat for seat in seats if not seat.away]
    if late := await steward.arrive(here, max(timeout_s, _RETURN_S)):
        raise PoolError(
            f"{names_of(late)} did not answer while {' and '.join(gone)} were dissolved; they "
            "are restored when they answer."
        )
    return gone


def _unfinished(scheduler: Any, names: Collection[str]) -> list[Any]:
    tasks = scheduler.tasks.values()
    return [task for task in tasks if task.state in _UNFINISHED and asks_for(task, names)]
