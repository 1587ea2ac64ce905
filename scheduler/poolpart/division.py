"""Requests of clients to the steward: make partitions, move workers, dissolve partitions.

Each is one request to the scheduler. The scheduler completes or refuses the request, even if the
client dies meanwhile. Simultaneous requests run one after the other.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from distributed import Client

from .errors import PoolError
from .features import FEATURES, begin_features, features_settled, names_with_features
from .fence import enclose, lower
from .internals.client import ANSWER_S
from .internals.scheduler import asks_for, lift_restrictions
from .membership import release, release_statistics
from .registration import forget_registrations
from .rules import Rule, check_count, divide, n_workers, rest, shortfalls, workers_in_words
from .stats import statistics_of
from .steward import Seat, Steward, names_of, steward_of
from .workers import WorkerInfo, on_scheduler

PATIENCE_S = 60.0  # seconds that a worker has to answer
_RETURN_S = 10.0  # minimum time for workers to declare their former resources
_STAY_S = 1.0  # time until workers that could not be moved are members again
_LOOK_EVERY_S = 0.05  # between looks for tasks that have not ended
_MOVES = "the number of workers to move"
_UNFINISHED = ("waiting", "queued", "no-worker", "processing")


def ask(client: Client, question: Callable[..., Any], **arguments: Any) -> Any:
    """Call `question(steward, **arguments)` on the scheduler, and return its result.

    `question` is a coroutine function of this module, such as `grow`. If it raises a PoolError on
    the scheduler, a PoolError with the same message is raised here.
    """
    # The steward waits for tasks, and then for workers, for `timeout_s` each.
    answer_s = ANSWER_S + 2 * arguments.get("timeout_s", 0.0)
    result, complaint = on_scheduler(
        client, _answer, question=question, arguments=arguments, answer_s=answer_s
    )
    if complaint:
        raise PoolError(complaint)
    return result


async def _answer(
    question: Callable[..., Any], arguments: Mapping[str, Any], dask_scheduler: Any = None
) -> tuple[Any, str]:
    """Return a request's result and "", or None and the message of a PoolError."""
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
    pool: Mapping[str, WorkerInfo],
    known_partitions: Collection[str],
    own_partitions: Collection[str],
) -> tuple[dict[str, str], list[WorkerInfo]]:
    """Create all new partitions or none, and apply their rules to workers that join later.

    Parameters
    ----------
    steward
        The scheduler's steward.
    rules
        Rules by partition name.
    pool
        Workers to choose from by name, as the client saw them, including their GPUs.
    known_partitions
        Partitions that the client knew when it sent the request. It may create them again.
    own_partitions
        Partitions that were created from the same pool. Their workers are not reported as missing.

    Returns
    -------
    notes
        Notes for users by partition name, possibly empty, about the selected workers and about
        features that this version of Dask lacks.
    remainder
        Workers of the pool that no rule has selected.

    Raises
    ------
    PoolError
        If there are too few workers, another client has a partition of the same name, or a worker
        leaves meanwhile.
    """
    # Up to the first await nothing else happens on the scheduler.
    seats = {seat.info.address: seat for seat in steward.seats.values() if not seat.away}
    present = [
        replace(seat.info, resources=steward.target_resources(seat)) for seat in seats.values()
    ]
    # By name: a restarted worker has another address.
    candidates = [w.with_gpus(pool[w.name].gpus) for w in present if w.name in pool]
    chosen, notes = divide(rules, candidates)
    as_seen = [
        worker
        if worker.partitions & {*own_partitions}
        else replace(worker, resources=pool[worker.name].resources)
        for worker in candidates
    ]
    notes = {**shortfalls(rules, candidates, as_seen), **notes}
    other = steward.remainder()
    for name in rules:
        if isinstance(rules[name], rest) and other not in (None, *rules):
            note = (
                f"Workers that join later are assigned to partition {other!r}, which already has "
                "the rule `rest()`."
            )
            notes[name] = " ".join(filter(None, (notes.get(name), note)))
    for name in rules:
        # Workers that may be in the partition already: it is made again.
        permitted = {worker.address for worker in chosen[name]} if name in known_partitions else ()
        foreign = [
            worker.address
            for worker in present
            if name in worker.partitions and worker.address not in permitted
        ]
        if foreign:
            raise PoolError(_exists(steward, name, [seats[address] for address in foreign]))
    common_note = _begin(steward, rules)
    for worker in candidates:
        if worker.gpus:
            seats[worker.address].info = seats[worker.address].info.with_gpus(worker.gpus)
    for name, rule in rules.items():
        steward.enter(name, rule)
        for worker in chosen[name]:
            steward.assign(seats[worker.address], name, rule.slots_of(worker))
    await features_settled()  # before the members get tasks, which lend slots
    members = [seats[worker.address] for group in chosen.values() for worker in group]
    await _expect_arrival(steward, members)
    notes_of_all = {name: " ".join(filter(None, (notes.get(name), common_note))) for name in rules}
    return notes_of_all, [worker for worker in candidates if seats[worker.address] not in members]


def _exists(steward: Steward, name: str, members: Sequence[Seat]) -> str:
    """Return the message for workers that have a partition and are not chosen by its rule."""
    if name in steward.rules:
        return (
            f"Partition {name!r} already exists, and this call does not select all of its workers. "
            f"Its workers are {names_of(members)}. To use the existing partition, call "
            f"`Pool.from_client(client)[{name!r}]`. To create another partition, choose a "
            "different name."
        )
    use = f"Use the existing partition with `Pool.from_client(client)[{name!r}]`"
    for seat in members:
        names = [resource for resource, slots in seat.original.items() if slots]
        if len(names) > 1:
            return (
                f"Worker {seat.info.name} was started with the resources {', '.join(names)}, but "
                f"a worker can belong to only one partition. {use}, or start the worker with only "
                f'`--resources "{name}=1"`.'
            )
    return (
        f"The rule does not select all workers that were started with the resource {name!r}. "
        f"Workers that are not selected: {names_of(members)}. {use}, pass a rule that "
        "selects all of these workers, such as `rest()`, or choose another name. A partition with "
        f"another name and the rule `n_workers(1, minimum=0)` can take workers from {name!r} with "
        f"`partition.resize(1, source={name!r})`."
    )


async def _expect_arrival(steward: Steward, members: Sequence[Seat]) -> None:
    """Wait until new members of partitions declare their resources.

    Raises PoolError if a member does not.
    """
    late = await steward.arrive(members, PATIENCE_S)
    if absent := [seat for seat in members if seat in late or seat.removed]:
        raise PoolError(
            "Some workers left or did not respond while they were assigned to "
            f"{_in_words(sorted({str(seat.partition) for seat in absent}))}: {names_of(absent)}. "
            "The other workers were assigned. Create a new pool to divide it again."
        )


def _begin(steward: Steward, rules: Mapping[str, Rule]) -> str:
    """Prepare the scheduler for tasks of new partitions and return a remark for users, or "".

    From now on, features such as inheritance are on (`features.py`), fences keep other tasks off
    exclusive partitions (`fence.py`), and tasks are counted (`stats.py`). The remark names features
    that this version of Dask lacks. PoolError if it lacks fences, and a rule is exclusive.
    """
    scheduler = steward.scheduler
    try:
        note = begin_features(scheduler, rules)
        for name, rule in rules.items():
            if rule.exclusive:
                enclose(scheduler, name)
            elif name in steward.rules and steward.rules[name].exclusive:
                lower(scheduler, name)
    except PoolError:  # this version of Dask lacks what fences need
        added = rules.keys() - steward.rules.keys()
        for name in added:
            lower(scheduler, name)
        release(scheduler, added)
        raise
    statistics_of(scheduler)
    return note


# -- moving workers --------------------------------------------------------------------
#
# A worker that leaves gets no new tasks of its partition; waiting tasks go to other members,
# running tasks end there; then it declares its new resources. Borrowed workers, whose home is
# another partition, leave first.


async def grow(
    steward: Steward, name: str, count: int, source: str | None, timeout_s: float
) -> list[str]:
    """Move workers into a partition and return their names."""
    check_count(_MOVES, count)
    steward.adopt(name)
    joining = _joining(steward, name, count, source)
    return await _move(steward, dict.fromkeys(joining, name), timeout_s)


async def shrink(steward: Steward, name: str, count: int, timeout_s: float) -> list[str]:
    """Move workers out of a partition and return their names."""
    check_count(_MOVES, count)
    steward.adopt(name)
    return await _move(steward, _leaving(steward, name, count), timeout_s)


async def resize(
    steward: Steward, name: str, count: int, source: str | None, timeout_s: float
) -> list[str]:
    """Resize a partition to a number of workers, and return the names of the moved workers."""
    check_count(f"the number of workers of partition {name!r}", count, minimum=0)
    steward.adopt(name)
    rule = steward.rules[name]
    if count < rule.minimum:
        raise PoolError(
            f"Partition {name!r} cannot be resized to {workers_in_words(count)}, because its "
            f"minimum is {rule.minimum}."
        )
    size = len(steward.members(name))  # includes members that are starting again
    targets: dict[Seat, str | None] = {}
    if count > size:
        targets = dict.fromkeys(_joining(steward, name, count - size, source), name)
    elif count < size:
        targets = _leaving(steward, name, size - count)
    # After a loss, the rule may ask for more workers than there are. Moving adds the difference.
    steward.resize(name, size - _asked(rule, size))
    try:
        return await _move(steward, targets, timeout_s)
    finally:
        if name in steward.rules:
            minimum = min(rule.minimum, _asked(steward.rules[name], rule.minimum))
            steward.rules[name] = replace(steward.rules[name], minimum=minimum)


def _asked(rule: Rule, default: int) -> int:
    """Return the number of workers that a rule asks for, or a default if it has no such number."""
    return rule.workers if isinstance(rule, n_workers) else default


def _joining(steward: Steward, name: str, count: int, source: str | None) -> list[Seat]:
    """Return the seats of workers that can move into a partition.

    Raises PoolError if there are fewer than `count`.
    """
    if source == name:
        raise PoolError(
            f"Partition {name!r} cannot take workers from itself. Pass another partition as "
            "`source`."
        )
    if source is not None:
        steward.adopt(source)
    donor = source or steward.remainder()
    spare = [] if source else [seat for seat in steward.free() if steward.settled(seat)]
    if donor is not None and donor != name:
        members = _settled_members(steward, donor)
        spared = max(0, len(members) - steward.rules[donor].minimum)
        spare += _in_order(steward, members, name)[:spared]
    if len(spare) < count:
        available = f"only {workers_in_words(len(spare))}" if spare else "no workers"
        if source:
            reason = f"partition {source!r} has {available} to spare beyond its minimum"
            advice = "pass another partition as `source`"
        else:
            reason = f"the remainder of the pool has {available} to spare"
            advice = "pass the partition that should provide them as `source`"
        raise PoolError(
            f"Partition {name!r} cannot grow by {workers_in_words(count)}, because {reason}. "
            f"Start more workers, or {advice}."
        )
    return _in_order(steward, spare, name)[:count]


def _leaving(steward: Steward, name: str, count: int) -> dict[Seat, str | None]:
    """Return the seats of workers that can leave a partition, with their destinations.

    Raises PoolError if fewer than its minimum would be left.
    """
    members = _settled_members(steward, name)
    minimum = steward.rules[name].minimum
    if len(members) - count < minimum:
        raise PoolError(
            f"Partition {name!r} cannot shrink by {workers_in_words(count)}, because it has "
            f"{workers_in_words(len(members))} and its minimum is {minimum}."
        )
    leaving = _in_order(steward, members)[:count]
    return {seat: _destination(steward, seat) for seat in leaving}


def _destination(steward: Steward, seat: Seat) -> str | None:
    """Return the partition of a worker that leaves its partition, or None for no partition.

    A borrowed worker returns to its home, and other workers go to the partition with the rule
    `rest`. Workers that leave this partition are in none.
    """
    if seat.partition == (remainder := steward.remainder()):
        return None
    home = steward.home(seat)
    return remainder if home == seat.partition else home or remainder


async def _move(
    steward: Steward, targets: Mapping[Seat, str | None], timeout_s: float
) -> list[str]:
    """Move workers to partitions, or out of all partitions if the target is None.

    Returns the names of the workers. Raises PoolError if tasks of a worker do not end in time. Such
    a worker stays where it is.
    """
    origins = {seat: (seat.partition, seat.slots) for seat in targets}
    for seat, target in targets.items():
        steward.resize(seat.partition, -1)
        steward.resize(target, 1)
        steward.put(seat, target)
    late = await steward.arrive(targets, timeout_s)
    for seat in late:
        origin, slots = origins[seat]
        target = targets[seat]
        if seat.partition != target or (origin and origin not in steward.rules):
            continue  # another client has moved it, or dissolved its partition
        steward.resize(target, -1)
        steward.resize(origin, 1)
        steward.put(seat, origin, slots)
    if late:
        await steward.arrive(late, _STAY_S)  # so that they can be moved again at once
        raise PoolError(
            f"{len(late)} of {workers_in_words(len(targets))} could not be moved within "
            f"{timeout_s:g} s. A worker is not moved while it runs tasks or does not respond. "
            f"These workers stay in their partition: {names_of(late)}. Wait for their tasks, or "
            "pass a longer `timeout_s`."
        )
    return [seat.info.name for seat in targets if not seat.removed]


def _settled_members(steward: Steward, name: str) -> list[Seat]:
    """Return the members that may be moved.

    Members that are just arriving do not count: they may return to their former partition.
    """
    return [seat for seat in steward.members(name) if steward.settled(seat)]


def _in_order(
    steward: Steward, seats: Sequence[Seat], destination: str | None = None
) -> list[Seat]:
    """Sort seats by the order in which their workers are moved to a destination.

    Workers whose home is the destination come first, then workers without a partition and borrowed
    workers. Among these, the least busy workers come first, and those with long-running tasks last.
    """

    def order(seat: Seat) -> tuple[bool, bool, int, int]:
        worker = steward.scheduler.workers[seat.info.address]
        is_home = seat.partition is not None and steward.home(seat) == seat.partition
        returns = destination is not None and steward.home(seat) == destination
        return not returns, is_home, len(worker.long_running), len(worker.processing)

    return sorted(seats, key=order)


# -- dissolving partitions ------------------------------------------------------------------------


def ask_to_dissolve(client: Client, names: Collection[str] | None, timeout_s: float) -> list[str]:
    """Ask the steward to undo partitions, or every partition if `names` is None."""
    arguments = {"names": names, "timeout_s": timeout_s, "client_id": client.id}
    try:
        dissolved: list[str] = ask(client, dissolve, **arguments)
    finally:
        forget_registrations()
    return dissolved


async def dissolve(
    steward: Steward, names: Collection[str] | None, timeout_s: float, client_id: str
) -> list[str]:
    """Undo partitions, or every partition if `names` is None, and return their names.

    `client_id` names the client that asks. That client has to register again.
    """
    scheduler = steward.scheduler
    await _wait_for_tasks(steward, names, timeout_s)
    # Until the next await nothing else happens on the scheduler; before, another client may have
    # dissolved the same partitions, or made some.
    dissolved = _existing(steward, names)
    seats = [seat for seat in steward.seats.values() if _belongs(seat, dissolved)]
    for name in dissolved:
        del steward.rules[name]
        for seat in steward.seats.values():
            if seat.home == name:  # also if another partition has borrowed the worker
                seat.home = None
        # At once, even if the client dies or workers do not answer.
        lower(scheduler, name)
    release(scheduler, dissolved, client_id, had_rule=True)
    if names is None:  # this includes partitions that workers were started with: these have no rule
        release(scheduler, names_with_features(scheduler), client_id)
    if not steward.rules:
        for feature in FEATURES:
            feature.end_all(scheduler)
        release_statistics(scheduler)
    for seat in seats:
        home = steward.home(seat)
        steward.resize(home, 1)
        steward.assign(seat, home)
    lift_restrictions(scheduler, dissolved)  # lost results are recomputed on any worker
    await features_settled()  # then tasks lend no more
    # An absent worker comes back as it was started.
    present = [seat for seat in seats if not seat.away]
    if late := await steward.arrive(present, max(timeout_s, _RETURN_S)):
        raise PoolError(
            f"Some workers did not respond while {_in_words(dissolved)} "
            f"{'was' if len(dissolved) == 1 else 'were'} dissolved: {names_of(late)}. Their "
            "original resources are restored as soon as they respond."
        )
    return dissolved


def _in_words(partitions: Sequence[str]) -> str:
    """Return partitions for a message, such as "partitions 'A' and 'B'"."""
    plural = "s" if len(partitions) > 1 else ""
    return f"partition{plural} {' and '.join(map(repr, partitions))}"


def _existing(steward: Steward, names: Collection[str] | None) -> list[str]:
    """Return the partitions of these names that exist, or every partition if `names` is None."""
    return [name for name in steward.rules if names is None or name in names]


def _belongs(seat: Seat, names: Collection[str]) -> bool:
    """Return whether a worker is in a partition of `names`, or was started in such a partition.

    Only workers without a partition are judged by their start.
    """
    if seat.partition is None:
        return not seat.original.keys().isdisjoint(names)
    return seat.partition in names


async def _wait_for_tasks(
    steward: Steward, names: Collection[str] | None, timeout_s: float
) -> None:
    """Wait until the tasks of partitions have ended.

    Raises PoolError if they do not end in time.
    """
    deadline = time.monotonic() + timeout_s
    # Tasks that the client just submitted arrive by another connection, milliseconds later.
    await asyncio.sleep(_LOOK_EVERY_S)
    while tasks := _unfinished(steward.scheduler, _existing(steward, names)):
        if time.monotonic() >= deadline:
            one = len(tasks) == 1
            raise PoolError(
                f"{len(tasks)} {'task' if one else 'tasks'} of "
                f"{_in_words(_existing(steward, names))} {'has' if one else 'have'} not finished "
                f"after {timeout_s:g} s, for example {tasks[0].key!r}. Wait for the tasks or "
                "cancel them, and dissolve again."
            )
        await asyncio.sleep(_LOOK_EVERY_S)


def _unfinished(scheduler: Any, names: Collection[str]) -> list[Any]:
    """Return the states of the tasks of partitions that have not ended."""
    tasks = scheduler.tasks.values()
    return [task for task in tasks if task.state in _UNFINISHED and asks_for(task, names)]
