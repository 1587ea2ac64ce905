"""Handle client requests to create partitions, move workers, and dissolve partitions.

Each operation is a single request, which the scheduler completes or rejects even if the client dies
in the meantime. Concurrent requests are processed one after the other.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from distributed import Client

from .errors import PoolError
from .features import FEATURES, enable_features, names_with_features, wait_for_features
from .fence import lower_fence, raise_fence
from .internals.client import ANSWER_S
from .internals.scheduler import lift_restrictions, requires_any
from .membership import release_partitions, release_statistics
from .registration import forget_registrations
from .rules import (
    Rule,
    check_count,
    divide_workers,
    find_shortfalls,
    format_workers,
    n_workers,
    rest,
)
from .stats import statistics_of
from .steward import Steward, WorkerRecord, join_names, steward_of
from .workers import WorkerInfo, run_on_scheduler

PATIENCE_S = 60.0  # time for new members to declare their resources
_RETURN_S = 10.0  # minimum time for workers to declare their former resources
_STAY_S = 1.0  # time for workers that could not be moved to become members again
_CHECK_EVERY_S = 0.05  # interval between checks for unfinished tasks
_MOVES = "the number of workers to move"
_UNFINISHED = ("waiting", "queued", "no-worker", "processing")


def call_steward(client: Client, operation: Callable[..., Any], **arguments: Any) -> Any:
    """Call `operation(steward, **arguments)` on the scheduler, and return its result.

    `operation` is a coroutine function of this module, for example `grow_partition`. If it raises a
    PoolError on the scheduler, this function raises a PoolError with the same message.
    """
    # The steward waits up to `timeout_s` for tasks and then up to `timeout_s` for workers.
    answer_s = ANSWER_S + 2 * arguments.get("timeout_s", 0.0)
    result, complaint = run_on_scheduler(
        client, _run_operation, operation=operation, arguments=arguments, answer_s=answer_s
    )
    if complaint:
        raise PoolError(complaint)
    return result


async def _run_operation(
    operation: Callable[..., Any], arguments: Mapping[str, Any], dask_scheduler: Any = None
) -> tuple[Any, str]:
    """Call a function on the scheduler, with the steward as its first argument.

    The result consists of the return value and "" or, after a PoolError, of None and the error
    message.
    """
    # If the error were raised here, Dask would log it with a traceback.
    with steward_of(dask_scheduler) as steward:
        try:
            return await operation(steward, **arguments), ""
        except PoolError as error:
            return None, str(error)


# -- creating partitions ---------------------------------------------------------------


async def create_partitions(
    steward: Steward,
    rules: Mapping[str, Rule],
    pool: Mapping[str, WorkerInfo],
    known_partitions: Collection[str],
    own_partitions: Collection[str],
) -> tuple[dict[str, str], list[WorkerInfo], str]:
    """Create either all new partitions or none, and apply their rules to workers that join later.

    Parameters
    ----------
    steward
        The scheduler's steward.
    rules
        Rules by partition name.
    pool
        Workers to select from, by name, as the client saw them, including their GPUs.
    known_partitions
        Partitions that the client knew when it sent the request. It may create them again.
    own_partitions
        Partitions that were created from the same pool. Their workers are not reported as missing.

    Returns
    -------
    notes
        Notes for users by partition name, possibly empty, about the selected workers and about
        features that this version of Dask does not support.
    remainder
        Workers of the pool that no rule has selected.
    scheduler
        ID of the scheduler.

    Raises
    ------
    PoolError
        If there are too few workers, if another client has a partition of the same name, or if a
        worker leaves in the meantime.
    """
    # Nothing else runs on the scheduler until the first await.
    records = {
        record.info.address: record for record in steward.records.values() if not record.is_absent
    }
    present = [
        replace(record.info, resources=steward.target_resources(record))
        for record in records.values()
    ]
    # Workers are identified by name, because the address changes when a worker is restarted.
    candidates = [w.with_gpus(pool[w.name].gpus) for w in present if w.name in pool]
    chosen, notes = divide_workers(rules, candidates)
    as_seen = [
        worker
        if worker.partitions & {*own_partitions}
        else replace(worker, resources=pool[worker.name].resources)
        for worker in candidates
    ]
    notes = {**find_shortfalls(rules, candidates, as_seen), **notes}
    other = steward.remainder_name()
    for name in rules:
        if isinstance(rules[name], rest) and other not in (None, *rules):
            note = (
                f"Workers that join later are assigned to partition {other!r}, which already has "
                "the rule `rest()`."
            )
            notes[name] = " ".join(filter(None, (notes.get(name), note)))
    for name in rules:
        # If the client knows the partition, it may create it again from the same workers.
        permitted = {worker.address for worker in chosen[name]} if name in known_partitions else ()
        foreign = [
            worker.address
            for worker in present
            if name in worker.partitions and worker.address not in permitted
        ]
        if foreign:
            raise PoolError(
                _exists_message(steward, name, [records[address] for address in foreign])
            )
    common_note = _prepare_scheduler(steward, rules)
    for worker in candidates:
        if worker.gpus:
            records[worker.address].info = records[worker.address].info.with_gpus(worker.gpus)
    for name, rule in rules.items():
        steward.set_rule(name, rule)
        for worker in chosen[name]:
            steward.set_home(records[worker.address], name, rule.slots_of(worker))
    await wait_for_features()  # so that the tasks of the members can lend their slots
    members = [records[worker.address] for group in chosen.values() for worker in group]
    await _expect_arrival(steward, members)
    notes_of_all = {name: " ".join(filter(None, (notes.get(name), common_note))) for name in rules}
    remainder = [worker for worker in candidates if records[worker.address] not in members]
    return notes_of_all, remainder, str(steward.scheduler.id)


def _exists_message(steward: Steward, name: str, members: Sequence[WorkerRecord]) -> str:
    """Return an error message if a rule does not select all workers of an existing partition."""
    if name in steward.rules:
        return (
            f"Partition {name!r} already exists, and this call does not select all of its workers. "
            f"Its workers are {join_names(members)}. To use the existing partition, call "
            f"`Pool.from_client(client)[{name!r}]`. To create another partition, choose a "
            "different name."
        )
    use = f"Use the existing partition with `Pool.from_client(client)[{name!r}]`"
    for record in members:
        names = [resource for resource, slots in record.original.items() if slots]
        if len(names) > 1:
            return (
                f"Worker {record.info.name} was started with the resources {', '.join(names)}, but "
                f"a worker can belong to only one partition. {use}, or start the worker with only "
                f'`--resources "{name}=1"`.'
            )
    return (
        f"The rule does not select all workers that were started with the resource {name!r}. "
        f"Workers that are not selected: {join_names(members)}. {use}, pass a rule that "
        "selects all of these workers, such as `rest()`, or choose another name. A partition with "
        f"another name and the rule `n_workers(1, minimum=0)` can take workers from {name!r} with "
        f"`partition.resize(1, source={name!r})`."
    )


async def _expect_arrival(steward: Steward, members: Sequence[WorkerRecord]) -> None:
    """Wait until the new members of partitions have declared their resources.

    Raises
    ------
    PoolError
        If a member leaves or does not respond in time.
    """
    late = await steward.wait_until_settled(members, PATIENCE_S)
    if absent := [record for record in members if record in late or record.is_removed]:
        partitions = _format_partitions(sorted({str(record.partition) for record in absent}))
        raise PoolError(
            f"Some workers left or did not respond while they were assigned to {partitions}: "
            f"{join_names(absent)}. The other workers were assigned. Create a new pool to divide "
            "it again."
        )


def _prepare_scheduler(steward: Steward, rules: Mapping[str, Rule]) -> str:
    """Prepare the scheduler for tasks in new partitions, and return a note for users or "".

    This enables features such as inheritance (see `features.py`), raises fences around exclusive
    partitions (see `fence.py`), and starts counting tasks (see `stats.py`). The note lists features
    that this version of Dask does not support.

    Raises
    ------
    PoolError
        If a rule is exclusive and this version of Dask does not support fences.
    """
    scheduler = steward.scheduler
    try:
        note = enable_features(scheduler, rules)
        for name, rule in rules.items():
            if rule.exclusive:
                raise_fence(scheduler, name)
            elif name in steward.rules and steward.rules[name].exclusive:
                lower_fence(scheduler, name)
    except PoolError:  # this version of Dask does not support fences
        added = rules.keys() - steward.rules.keys()
        for name in added:
            lower_fence(scheduler, name)
        release_partitions(scheduler, added)
        raise
    statistics_of(scheduler)
    return note


# -- moving workers --------------------------------------------------------------------
#
# A worker that leaves its partition receives no new tasks of the partition. Its waiting tasks are
# moved to other members, and its running tasks finish before it declares its new resources.
# Borrowed workers, whose home is another partition, leave first.


async def grow_partition(
    steward: Steward, name: str, count: int, source: str | None, timeout_s: float
) -> list[str]:
    """Move workers into a partition, and return their names."""
    check_count(_MOVES, count)
    steward.adopt_partition(name)
    joining = _select_joining(steward, name, count, source)
    return await move_workers(steward, dict.fromkeys(joining, name), timeout_s)


async def shrink_partition(steward: Steward, name: str, count: int, timeout_s: float) -> list[str]:
    """Move workers out of a partition, and return their names."""
    check_count(_MOVES, count)
    steward.adopt_partition(name)
    return await move_workers(steward, _select_leaving(steward, name, count), timeout_s)


async def resize_partition(
    steward: Steward, name: str, count: int, source: str | None, timeout_s: float
) -> list[str]:
    """Change the number of workers in a partition, and return the names of the workers moved."""
    check_count(f"the number of workers of partition {name!r}", count, minimum=0)
    steward.adopt_partition(name)
    rule = steward.rules[name]
    if count < rule.minimum:
        raise PoolError(
            f"Partition {name!r} cannot be resized to {format_workers(count)}, because its "
            f"minimum is {rule.minimum}."
        )
    size = len(steward.members(name))  # includes members that are being restarted
    targets: dict[WorkerRecord, str | None] = {}
    if count > size:
        targets = dict.fromkeys(_select_joining(steward, name, count - size, source), name)
    elif count < size:
        targets = _select_leaving(steward, name, size - count)
    # If a worker was lost, the rule requests more workers than there are. The target is set to the
    # present size first, because moving workers changes it by the number of workers moved.
    steward.change_target(name, size - _requested_workers(rule, size))
    try:
        return await move_workers(steward, targets, timeout_s)
    finally:
        if name in steward.rules:
            minimum = min(rule.minimum, _requested_workers(steward.rules[name], rule.minimum))
            steward.rules[name] = replace(steward.rules[name], minimum=minimum)


def _requested_workers(rule: Rule, default: int) -> int:
    """Return the number of workers that an `n_workers` rule requests, or else the default."""
    return rule.workers if isinstance(rule, n_workers) else default


def _select_joining(
    steward: Steward, name: str, count: int, source: str | None
) -> list[WorkerRecord]:
    """Select the workers to move into a partition.

    Raises
    ------
    PoolError
        If fewer than `count` workers can be moved.
    """
    if source == name:
        raise PoolError(
            f"Partition {name!r} cannot take workers from itself. Pass another partition as "
            "`source`."
        )
    if source is not None:
        steward.adopt_partition(source)
    donor = source or steward.remainder_name()
    spare = (
        []
        if source
        else [record for record in steward.free_records() if steward.is_settled(record)]
    )
    if donor is not None and donor != name:
        members = settled_members(steward, donor)
        spared = max(0, len(members) - steward.rules[donor].minimum)
        spare += in_moving_order(steward, members, name)[:spared]
    if len(spare) < count:
        available = f"only {format_workers(len(spare))}" if spare else "no workers"
        if source:
            reason = f"partition {source!r} has {available} to spare beyond its minimum"
            advice = "pass another partition as `source`"
        else:
            reason = f"the remainder of the pool has {available} to spare"
            advice = "pass the partition that should provide them as `source`"
        raise PoolError(
            f"Partition {name!r} cannot grow by {format_workers(count)}, because {reason}. "
            f"Start more workers, or {advice}."
        )
    return in_moving_order(steward, spare, name)[:count]


def _select_leaving(steward: Steward, name: str, count: int) -> dict[WorkerRecord, str | None]:
    """Select workers to move out of a partition, and return the destination of each worker.

    Raises
    ------
    PoolError
        If fewer workers than the minimum of the partition would remain.
    """
    members = settled_members(steward, name)
    minimum = steward.rules[name].minimum
    if len(members) - count < minimum:
        raise PoolError(
            f"Partition {name!r} cannot shrink by {format_workers(count)}, because it has "
            f"{format_workers(len(members))} and its minimum is {minimum}."
        )
    leaving = in_moving_order(steward, members)[:count]
    return {record: _destination(steward, record) for record in leaving}


def _destination(steward: Steward, record: WorkerRecord) -> str | None:
    """Return the partition to which a worker moves when it leaves its own, or None.

    A borrowed worker returns to its home, and other workers go to the partition with the rule
    `rest`. A worker that leaves the latter partition has no partition afterwards.
    """
    if record.partition == (remainder := steward.remainder_name()):
        return None
    home = steward.home_of(record)
    return remainder if home == record.partition else home or remainder


async def move_workers(
    steward: Steward, targets: Mapping[WorkerRecord, str | None], timeout_s: float
) -> list[str]:
    """Move workers to the given partitions. The target None stands for no partition.

    The result contains the names of the workers. A worker whose tasks do not finish in time stays
    in its partition.

    Raises
    ------
    PoolError
        If a worker could not be moved in time.
    """
    origins = {record: (record.partition, record.slots) for record in targets}
    for record, target in targets.items():
        steward.change_target(record.partition, -1)
        steward.change_target(target, 1)
        steward.set_partition(record, target)
    late = await steward.wait_until_settled(targets, timeout_s)
    for record in late:
        origin, slots = origins[record]
        target = targets[record]
        if record.partition != target or (origin and origin not in steward.rules):
            continue  # another client has moved the worker or dissolved its partition
        steward.change_target(target, -1)
        steward.change_target(origin, 1)
        steward.set_partition(record, origin, slots)
    if late:
        await steward.wait_until_settled(late, _STAY_S)  # so that they can be moved again soon
        raise PoolError(
            f"{len(late)} of {format_workers(len(targets))} could not be moved within "
            f"{timeout_s:g} s. A worker is not moved while it runs tasks or does not respond. "
            f"These workers stay in their partition: {join_names(late)}. Wait for their tasks, or "
            "pass a longer `timeout_s`."
        )
    return [record.info.name for record in targets if not record.is_removed]


def settled_members(steward: Steward, name: str) -> list[WorkerRecord]:
    """Return the members that can be moved now.

    Members that are about to arrive are excluded, because they may still return to their former
    partition.
    """
    return [record for record in steward.members(name) if steward.is_settled(record)]


def in_moving_order(
    steward: Steward, records: Sequence[WorkerRecord], destination: str | None = None
) -> list[WorkerRecord]:
    """Sort workers into the order in which they are moved to a destination.

    Workers whose home is the destination come first, followed by workers without a partition and
    borrowed workers, and then by all others. Within each of these groups, workers without
    long-running tasks come first, and then those with the fewest tasks.
    """

    def order(record: WorkerRecord) -> tuple[bool, bool, int, int]:
        worker = steward.scheduler.workers[record.info.address]
        is_home = record.partition is not None and steward.home_of(record) == record.partition
        returns = destination is not None and steward.home_of(record) == destination
        return not returns, is_home, len(worker.long_running), len(worker.processing)

    return sorted(records, key=order)


# -- dissolving partitions ------------------------------------------------------------------------


def request_dissolution(
    client: Client, names: Collection[str] | None, timeout_s: float
) -> list[str]:
    """Dissolve the named partitions, or all if `names` is None, and return their names."""
    arguments = {"names": names, "timeout_s": timeout_s, "client_id": client.id}
    try:
        dissolved: list[str] = call_steward(client, dissolve_partitions, **arguments)
    finally:
        forget_registrations()
    return dissolved


async def dissolve_partitions(
    steward: Steward, names: Collection[str] | None, timeout_s: float, client_id: str
) -> list[str]:
    """Dissolve the named partitions, or all if `names` is None, and return their names.

    `client_id` is the ID of the client that sends the request. The client has to register again
    afterwards.
    """
    scheduler = steward.scheduler
    await _wait_for_tasks(steward, names, timeout_s)
    # During the wait, another client may have created or dissolved partitions. From here to the
    # next await, nothing else runs on the scheduler.
    dissolved = _existing(steward, names)
    records = [record for record in steward.records.values() if _belongs(record, dissolved)]
    for name in dissolved:
        del steward.rules[name]
        for record in steward.records.values():
            if record.home == name:  # even if another partition has borrowed the worker
                record.home = None
        # The fence is lowered immediately, even if the client dies or workers do not respond.
        lower_fence(scheduler, name)
    release_partitions(scheduler, dissolved, client_id, had_rule=True)
    if names is None:  # includes partitions without a rule, which workers were started with
        release_partitions(scheduler, names_with_features(scheduler), client_id)
    if not steward.rules:
        for feature in FEATURES:
            feature.clean_up(scheduler)
        release_statistics(scheduler)
    for record in records:
        home = steward.home_of(record)
        steward.change_target(home, 1)
        steward.set_home(record, home)
    lift_restrictions(scheduler, dissolved)  # any worker may recompute lost results
    await wait_for_features()  # until tasks have stopped lending slots
    # Absent workers are not awaited, because they rejoin with their original resources.
    present = [record for record in records if not record.is_absent]
    if late := await steward.wait_until_settled(present, max(timeout_s, _RETURN_S)):
        raise PoolError(
            f"Some workers did not respond while {_format_partitions(dissolved)} "
            f"{'was' if len(dissolved) == 1 else 'were'} dissolved: {join_names(late)}. Their "
            "original resources are restored as soon as they respond."
        )
    return dissolved


def _format_partitions(partitions: Sequence[str]) -> str:
    """Format partition names for a message, such as "partitions 'A' and 'B'"."""
    plural = "s" if len(partitions) > 1 else ""
    return f"partition{plural} {' and '.join(map(repr, partitions))}"


def _existing(steward: Steward, names: Collection[str] | None) -> list[str]:
    """Return the names of existing partitions, restricted to `names` unless it is None."""
    return [name for name in steward.rules if names is None or name in names]


def _belongs(record: WorkerRecord, names: Collection[str]) -> bool:
    """Return whether a worker belongs to one of the given partitions.

    A worker without a partition belongs to a partition if it was started with its resource.
    """
    if record.partition is None:
        return not record.original.keys().isdisjoint(names)
    return record.partition in names


async def _wait_for_tasks(
    steward: Steward, names: Collection[str] | None, timeout_s: float
) -> None:
    """Wait until all tasks in the given partitions have finished.

    Raises
    ------
    PoolError
        If they do not finish in time.
    """
    deadline = time.monotonic() + timeout_s
    # Tasks that the client has just submitted arrive on another connection, milliseconds later.
    await asyncio.sleep(_CHECK_EVERY_S)
    while tasks := _unfinished(steward.scheduler, _existing(steward, names)):
        if time.monotonic() >= deadline:
            one = len(tasks) == 1
            partitions = _format_partitions(_existing(steward, names))
            raise PoolError(
                f"{len(tasks)} {'task' if one else 'tasks'} of {partitions} "
                f"{'has' if one else 'have'} not finished after {timeout_s:g} s, for example "
                f"{tasks[0].key!r}. Wait for the tasks or cancel them, and dissolve again."
            )
        await asyncio.sleep(_CHECK_EVERY_S)


def _unfinished(scheduler: Any, names: Collection[str]) -> list[Any]:
    tasks = scheduler.tasks.values()
    return [task for task in tasks if task.state in _UNFINISHED and requires_any(task, names)]
