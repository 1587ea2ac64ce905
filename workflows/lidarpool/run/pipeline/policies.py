"""Policies of the driver, as pure functions: how large batches are, where they go, when to retry.

Nothing here reads a clock, the cluster or the driver.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence

from poolpart.task_locations import TaskLocations

from .batches import Batch, BatchState, Outcome
from .names import COLLECT, INTERSECT

BATCH_SECONDS = 0.2  # casting time that makes a batch worth its overhead
SMALL_SECONDS = 0.05  # casting time of a batch that no slot idles for at the end
BATCHES_LEAST = 16  # batches for each slot, so that none idles for long at the end
GROWTH = 8  # times as many scans as the largest of the last batches that the next may have
TASK_SECONDS = 0.4  # casting time that makes a task worth its overhead, and
SLOT_SECONDS = 0.008  # more of it with each slot: a driver has some 125 tasks a second
TASK_BATCHES = 32  # batches of one task, at most
AHEAD = 2  # tasks offered to a worker for each of its slots, so that it need not wait
COLLECTING = 3  # tasks whose batches a collector is given at a time
WORTH_S = 20.0  # casting time that makes another slot worth its start
SPAN = 8  # batches that the newest may be ahead of the oldest, for each that may be under way
SUSPECT_DEATHS = 2  # workers that may die with a batch before it is tried alone
KILLS_MOST = 3  # workers that a single scan may kill, alone
LATE_S = 60.0  # a batch is late when it takes so long at one place, and
LATE_FACTOR = 20.0  # so much longer than others


# -- how much is under way -------------------------------------------------------------------


def most_scans(fit: int, scan_count: int, slots: int) -> int:
    """Find how many scans a batch may have: so many `fit` into its memory, and all slots get some.

    One at least: a scan is never split.
    """
    return max(1, min(fit, scan_count // (BATCHES_LEAST * slots)))


def scans_per_batch(
    last: Sequence[tuple[float, int]], fit: int, scan_count: int, slots: int
) -> int:
    """Choose how many scans a batch should have, from casting times and scans of the last ones.

    Several, because those of one vary: what a campaign had learned of one batch went up and down
    fourfold. For the others see `most_scans`; a small batch is not divided further.
    """
    a_second = statistics.median(scans / max(seconds, 1e-6) for seconds, scans in last)
    wanted = min(int(BATCH_SECONDS * a_second), GROWTH * max(scans for _, scans in last))
    most = max(most_scans(fit, scan_count, slots), int(SMALL_SECONDS * a_second))
    return max(1, min(wanted, most, fit))


def batches_per_task(last: Sequence[tuple[float, int]], slots: int) -> int:
    """Choose how many small batches a casting task has, from casting times of the last ones.

    A task takes the scheduler 0.5 to 1 ms. With one batch in each, a receipt took 2.5 ms of the
    scheduler's processor time; with several, it takes 0.4 to 0.9 ms.
    """
    if not last:
        return 1
    typical = max(statistics.median(seconds for seconds, _ in last), 1e-6)
    worth_s = max(TASK_SECONDS, SLOT_SECONDS * slots)
    return max(1, min(int(worth_s / typical), TASK_BATCHES))


def weight(batches: Iterable[Batch], per_task: int) -> float:
    """How many small batches some batches count as, where a task has so many.

    All of a task's batches are in a worker's memory at a time: one that takes half of what is there
    counts as half a task.
    """
    return sum([max(1.0, per_task * batch.share) for batch in batches])


def most_under_way(slots: int, collectors: int, per_task: int = 1) -> int:
    """Batches that may be under way by their `weight`, so many in a task."""
    return (AHEAD * slots + COLLECTING * collectors + 2) * per_task


def slots_wanted(left: int, scan_s: float | None) -> int:
    """Slots that so many scans are worth, if each takes `scan_s` seconds to cast, None if unknown.

    Then as many as may be of use: who waits in a queue twice waits twice as long.
    """
    return left if scan_s is None else min(left, math.ceil(left * scan_s / WORTH_S))


# -- where batches go ------------------------------------------------------------------------


def kills(batch: Batch, stage: str) -> int:
    """How many workers of a stage died with a batch while it was tried alone; below 0: it is not.

    After some deaths a batch is suspect, and tried alone. An innocent one succeeds then; one whose
    worker dies again is divided, down to single scans. A scan is the cause if `KILLS_MOST` workers
    in a row die with it alone.
    """
    return batch.deaths[stage] - SUSPECT_DEATHS


def suspect(batch: Batch, stage: str) -> bool:
    """Whether a batch may be what kills the workers of a stage: then it is tried alone."""
    return bool(batch.deaths) and kills(batch, stage) >= 0


def offers(
    batches: Sequence[Batch], slots: Mapping[str, int], most: int, per_task: int = 1
) -> list[tuple[list[Batch], str]]:
    """Choose workers for waiting batches, at most so many under way in all.

    The worker with the least work for its slots gets the next task, of up to `per_task` batches of
    jobs that share a scene; of fewer only if a slot is idle and stage 4 keeps up. A batch with
    which a worker has died gets a task for itself, or its neighbours would share the blame for the
    next one. A suspect batch gets a worker for itself, and is waited for: the others must not
    occupy all workers. Batches that wait are taken in their order. `slots` says how many tasks each
    worker runs at a time.
    """
    casting = [b for b in batches if b.place is BatchState.CASTING]
    load = Counter(worker for _, worker in {(b.key, b.worker) for b in casting})
    alone = {batch.worker for batch in casting if suspect(batch, INTERSECT)}
    waiting = [b for b in batches if b.place is BatchState.WAITING]
    behind = [b for b in batches if b.place in (BatchState.CAST, BatchState.COLLECTING)]
    left = most - weight([*behind, *(b for b in casting if b.worker in slots)], per_task)
    backlog = any(b.place is BatchState.CAST for b in behind)
    idle = sum(max(0, count - load[a]) for a, count in slots.items() if a not in alone)
    spread = -(-weight(waiting, per_task) // max(1, idle))  # all idle slots get some
    size = per_task if backlog else min(per_task, spread)
    groups: dict[object, deque[Batch]] = {}  # those that may share a task
    for batch in waiting:
        groups.setdefault(_group(batch), deque()).append(batch)
    chosen: list[tuple[list[Batch], str]] = []
    passed: set[Batch] = set()
    for first in waiting:
        if first in passed:
            continue
        wary = suspect(first, INTERSECT)
        fullness = {
            address: load[address] / (1 if wary else AHEAD * count)
            for address, count in slots.items()
            if address not in alone
        }
        address = min(fullness, key=lambda a: (fullness[a], a), default="")
        if not address or fullness[address] >= 1 or left < 1:
            break
        group = groups[_group(first)]
        busy = backlog or load[address] >= slots[address]
        if busy and not first.deaths and min(left, weight(group, per_task)) < per_task:
            passed.update(group)  # a task that has to wait may become larger
            continue
        task = _task(group, min(size, left), per_task)
        left -= weight(task, per_task)
        passed.update(task)
        chosen.append((task, address))
        load[address] += 1
        if wary:
            alone.add(address)
    return chosen


def _group(batch: Batch) -> object:
    """Return what the batches of a task have in common."""
    if batch.deaths:
        return batch
    return batch.job.number if batch.divided else batch.job.scene_name


def _task(group: deque[Batch], most: float, per_task: int) -> list[Batch]:
    """Take the batches of a task from a group, one at least."""
    task = [group.popleft()]
    taken = weight(task, per_task)
    while group and (taken := taken + weight([group[0]], per_task)) <= most:
        task.append(group.popleft())
    return task


def handovers(
    batches: Sequence[Batch], collectors: Mapping[str, str]
) -> list[tuple[list[Batch], str]]:
    """Choose collectors for batches that were cast, those of a task together.

    Those with which a collector has died come alone. A collector on the host of the columns is
    preferred. A suspect batch is collected while there is no other in stage 4: several collectors
    may share a process. `collectors` has the address of the worker of each.
    """
    ready = [b for b in batches if b.place is BatchState.CAST]
    busy = [b for b in batches if b.place is BatchState.COLLECTING]
    if suspects := [b for b in ready if suspect(b, COLLECT)]:
        ready = [] if busy else suspects[:1]
    if any(suspect(b, COLLECT) for b in busy):
        return []
    load = Counter(name for _, name in {(b.key, b.collector) for b in busy})
    tasks: dict[tuple[str, Batch | None], list[Batch]] = {}
    for batch in ready:
        tasks.setdefault((batch.key, batch if batch.deaths[COLLECT] else None), []).append(batch)
    chosen: list[tuple[list[Batch], str]] = []
    for task in tasks.values():
        free = [name for name in collectors if load[name] < COLLECTING]
        if not free:
            break
        near = [name for name in free if _host(collectors[name]) == _host(task[0].worker)]
        name = min(near or free, key=lambda n: (load[n], n))
        chosen.append((task, name))
        load[name] += 1
    return chosen


def _host(address: str) -> str:
    """Host of a worker's address."""
    return address.rpartition("/")[2].rpartition(":")[0]


# -- when a batch is tried again -------------------------------------------------------------


def late_after_s(last: Sequence[tuple[float, int]]) -> float:
    """Seconds after which a batch is late, from casting times of the last; inf without any."""
    if not last:
        return float("inf")
    return max(LATE_S, LATE_FACTOR * statistics.median(seconds for seconds, _ in last))


def loss(
    batch: Batch, seen: TaskLocations, prepared: int, now: float, late_s: float
) -> Outcome | None:
    """Whether a batch should be offered again although its task has not failed, and why.

    It depends on what was `seen` of workers and tasks, and on the number of workers that are
    `prepared`: while there is no other, a batch is waited for. A worker that Dask has paused starts
    no task until memory is free, perhaps never: what it has not started is offered elsewhere.
    """
    if batch.place in (BatchState.CASTING, BatchState.CAST):
        if batch.worker not in seen.members:
            return Outcome.DIED if batch.place is BatchState.CASTING else Outcome.GONE
        if batch.worker in seen.silent:
            if prepared:
                return Outcome.GONE
        elif batch.worker not in seen.free and batch.place is BatchState.CASTING:
            task = seen.tasks.get(batch.key)
            # "no-worker": not even sent there, as the worker was paused before.
            if task and task.state in ("no-worker", "processing") and not task.started:
                return Outcome.REFUSED
    late = batch.place in (BatchState.CASTING, BatchState.COLLECTING) and now - batch.since > late_s
    return Outcome.LATE if late and (prepared > 1 or batch.place is BatchState.COLLECTING) else None
