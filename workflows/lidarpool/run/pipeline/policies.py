"""Policies of the driver, as pure functions: sizes of batches, choice of workers, retries.

Nothing here reads a clock, the cluster or the driver.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from poolpart.task_locations import PartitionSnapshot

from .batches import Batch, BatchState, Outcome
from .stage_names import COLLECT, INTERSECT

BATCH_SECONDS = 0.2  # casting time that makes a batch worth its overhead
SMALL_SECONDS = 0.05  # casting time of a batch that no slot idles for at the end
MIN_BATCHES_PER_SLOT = 16  # so that no slot idles for long at the end
MAX_GROWTH = 8  # scans of the next batch, as a multiple of the largest recent batch
TASK_SECONDS = 0.4  # casting time that makes a task worth its overhead
SLOT_SECONDS = 0.008  # casting time of a task, for each slot: a driver starts 125 tasks a second
MAX_BATCHES_PER_TASK = 32
TASKS_PER_SLOT = 2  # offered tasks for each slot of a worker, so that the slot need not wait
TASKS_PER_COLLECTOR = 3  # tasks whose batches a collector has at a time
SLOT_WORTH_S = 20.0  # casting time that makes another slot worth its start
MAX_SPAN = 8  # batches from the oldest to the newest, as a multiple of the batches under way
SUSPECT_DEATHS = 2  # workers that may die with a batch before the batch is tried alone
MAX_KILLS = 3  # workers that a single scan may kill while it is tried alone
LATE_S = 60.0  # a batch is late when it stays longer than this in a state, and
LATE_FACTOR = 20.0  # longer than this multiple of the median casting time


# -- how much is under way -------------------------------------------------------------------


def max_scans_per_batch(scans_per_task: int, scan_count: int, slots: int) -> int:
    """Return the largest number of scans of a batch, at least 1, since a scan is never split.

    Parameters
    ----------
    scans_per_task
        Scans that fit into the memory of a casting task.
    scan_count
        Scans that the run is about to cast, of all jobs that have not ended. They are divided so
        that all slots get some.
    slots
        Casting tasks that run at a time.
    """
    return max(1, min(scans_per_task, scan_count // (MIN_BATCHES_PER_SLOT * slots)))


def scans_per_batch(
    recent_casts: Sequence[tuple[float, int]], scans_per_task: int, scan_count: int, slots: int
) -> int:
    """Choose the number of scans of a batch from the casting times of recent batches.

    Several recent batches, because casting times vary: with the last batch alone, the size went up
    and down fourfold during a campaign. A small batch is not divided further.

    Parameters
    ----------
    recent_casts
        Casting time in seconds and number of scans of each recent batch; not empty.
    scans_per_task
        Scans that fit into the memory of a casting task.
    scan_count
        Scans that the run is about to cast, as of `max_scans_per_batch`.
    slots
        Casting tasks that run at a time.
    """
    scans_per_second = statistics.median(
        scans / max(seconds, 1e-6) for seconds, scans in recent_casts
    )
    worthwhile_scans = min(
        int(BATCH_SECONDS * scans_per_second), MAX_GROWTH * max(scans for _, scans in recent_casts)
    )
    max_scans = max(
        max_scans_per_batch(scans_per_task, scan_count, slots),
        int(SMALL_SECONDS * scans_per_second),
    )
    return max(1, min(worthwhile_scans, max_scans, scans_per_task))


def batches_per_task(recent_casts: Sequence[tuple[float, int]], slots: int) -> int:
    """Choose the number of small batches of a casting task from casting times of recent batches.

    A task takes the scheduler 0.5 to 1 ms. With a batch a task, a receipt took 2.5 ms of the
    scheduler's processor time; with several, it takes 0.4 to 0.9 ms.

    Parameters
    ----------
    recent_casts
        Casting time in seconds and number of scans of each recent batch.
    slots
        Casting tasks that run at a time.
    """
    if not recent_casts:
        return 1
    median_s = max(statistics.median(seconds for seconds, _ in recent_casts), 1e-6)
    target_s = max(TASK_SECONDS, SLOT_SECONDS * slots)
    return max(1, min(int(target_s / median_s), MAX_BATCHES_PER_TASK))


def weight(batches: Iterable[Batch], per_task: int) -> float:
    """Return the weight of batches, in small batches, if a task has `per_task` small batches.

    All batches of a task are in a worker's memory at a time: a batch that fills half the memory of
    a task (`batch.share` is 0.5) counts as half a task, `per_task / 2`. A batch counts as 1 at
    least.
    """
    return sum(max(1.0, per_task * batch.share) for batch in batches)


def max_under_way(slots: int, collectors: int, per_task: int = 1) -> int:
    """Return the largest `weight` of batches under way, if a task has `per_task` batches."""
    return (TASKS_PER_SLOT * slots + TASKS_PER_COLLECTOR * collectors + 2) * per_task


def slots_wanted(scan_count: int, scan_s: float | None) -> int:
    """Return the number of casting slots that `scan_count` scans are worth.

    `scan_s` is the casting time of a scan in seconds. If it is unknown, None, each scan is worth a
    slot: a job of a batch queue that asks for more slots later waits a second time.
    """
    return (
        scan_count
        if scan_s is None
        else min(scan_count, math.ceil(scan_count * scan_s / SLOT_WORTH_S))
    )


# -- where batches go ------------------------------------------------------------------------


def kills_alone(batch: Batch, stage: str) -> int:
    """Return the number of a stage's workers that died with a batch alone.

    The number is negative if the batch is not yet suspect.

    After `SUSPECT_DEATHS` deaths a batch is suspect, and tried alone. An innocent batch succeeds
    then; a batch whose worker dies again is divided, down to single scans. A scan is the cause if
    `MAX_KILLS` workers in a row die with that scan alone.
    """
    return batch.deaths[stage] - SUSPECT_DEATHS


def is_suspect(batch: Batch, stage: str) -> bool:
    """Return True if a batch may be the cause of dying workers of a stage, to be tried alone."""
    return bool(batch.deaths) and kills_alone(batch, stage) >= 0


class TaskOffer(NamedTuple):
    """A casting task and the worker that gets the task."""

    batches: list[Batch]
    worker: str  # address


def offers(
    batches: Sequence[Batch], slots: Mapping[str, int], max_weight: int, per_task: int = 1
) -> list[TaskOffer]:
    """Group waiting batches into casting tasks, and choose a worker for each task.

    The worker with the least work for its slots gets the next task, of up to `per_task` batches of
    jobs that share a scene; of fewer only if a slot is idle and stage 4 keeps up. If a worker died
    with a batch, the batch gets a task for itself, or its neighbors would share the blame for the
    next death. A suspect batch gets a worker for itself, and later batches wait for the suspect:
    they must not occupy all workers. Waiting batches are taken in their order.

    Parameters
    ----------
    batches
        Waiting batches in their order, and all batches under way.
    slots
        {address of a worker: casting tasks that the worker runs at a time}.
    max_weight
        Largest `weight` of all batches under way.
    per_task
        Small batches of a task.
    """
    state = _OfferState.from_batches(batches, slots, max_weight, per_task)
    waiting = [batch for batch in batches if batch.state is BatchState.WAITING]
    idle_slots = state.idle_slots()
    # Weight of a task if the waiting batches are shared by all idle slots, rounded up.
    idle_share = -(-weight(waiting, per_task) // max(1, idle_slots))
    task_size = per_task if state.has_backlog else min(per_task, idle_share)
    groups: dict[object, deque[Batch]] = {}  # batches that may share a task
    for batch in waiting:
        groups.setdefault(_group_key(batch), deque()).append(batch)
    chosen: list[TaskOffer] = []
    passed: set[Batch] = set()  # batches in a chosen task, or left to wait for a larger task
    for first in waiting:
        if first in passed:
            continue
        suspect = is_suspect(first, INTERSECT)
        worker = state.least_loaded(alone=suspect)
        if worker is None or state.free_weight < 1:
            break
        group = groups[_group_key(first)]
        if state.may_wait(first, group, worker):
            passed.update(group)  # a task that has to wait may become larger
            continue
        task = _take_task(group, min(task_size, state.free_weight), per_task)
        passed.update(task)
        chosen.append(TaskOffer(task, worker))
        state.add(task, worker, alone=suspect)
    return chosen


@dataclass(eq=False)
class _OfferState:
    """Load of the casting workers while tasks are offered."""

    slots: Mapping[str, int]  # {address: casting tasks at a time}
    per_task: int  # small batches of a task
    load: Counter[str]  # {address: tasks that the worker has}
    reserved: set[str]  # addresses of workers that try a suspect batch
    free_weight: float  # weight of batches that may still be offered
    has_backlog: bool  # True if batches that were cast wait for a collector

    @classmethod
    def from_batches(
        cls, batches: Sequence[Batch], slots: Mapping[str, int], max_weight: int, per_task: int
    ) -> _OfferState:
        """Return the load by the batches that are under way."""
        casting = [b for b in batches if b.state is BatchState.CASTING]
        behind = [b for b in batches if b.state in (BatchState.CAST, BatchState.COLLECTING)]
        counted = [*behind, *(b for b in casting if b.worker in slots)]
        return cls(
            slots,
            per_task,
            load=Counter(worker for _, worker in {(b.key, b.worker) for b in casting}),
            reserved={batch.worker for batch in casting if is_suspect(batch, INTERSECT)},
            free_weight=max_weight - weight(counted, per_task),
            has_backlog=any(b.state is BatchState.CAST for b in behind),
        )

    def idle_slots(self) -> int:
        """Return the number of slots without a task, on workers that are not reserved."""
        return sum(
            max(0, count - self.load[address])
            for address, count in self.slots.items()
            if address not in self.reserved
        )

    def least_loaded(self, *, alone: bool) -> str | None:
        """Return the worker with the least work for its slots, or None if all are full.

        With `alone`, only a worker without any task is not full.
        """
        fullness = {
            address: self.load[address] / (1 if alone else TASKS_PER_SLOT * count)
            for address, count in self.slots.items()
            if address not in self.reserved
        }
        address = min(fullness, key=lambda a: (fullness[a], a), default="")
        return address if address and fullness[address] < 1 else None

    def may_wait(self, first: Batch, group: Collection[Batch], worker: str) -> bool:
        """Return True if a task of a group would be small, and has to wait on its worker anyway."""
        busy = self.has_backlog or self.load[worker] >= self.slots[worker]
        if not busy or first.deaths:
            return False
        return min(self.free_weight, weight(group, self.per_task)) < self.per_task

    def add(self, task: Collection[Batch], worker: str, *, alone: bool) -> None:
        """Count a task that is offered to a worker. A task `alone` reserves the worker."""
        self.free_weight -= weight(task, self.per_task)
        self.load[worker] += 1
        if alone:
            self.reserved.add(worker)


def _group_key(batch: Batch) -> object:
    """Return a key that is equal for batches that may share a task.

    If a worker died with a batch, the batch shares with none. A batch of a task that has failed,
    with several jobs in it, shares only with its own job; all others share with jobs of their
    scene.
    """
    if batch.deaths:
        return batch
    return batch.job.number if batch.single_job else batch.job.scene_name


def _take_task(group: deque[Batch], max_weight: float, per_task: int) -> list[Batch]:
    """Remove the batches of a task from a group and return the batches.

    There is at least 1 batch; further batches are added while the `weight` of the task is at most
    `max_weight`, both in small batches. `per_task` small batches fill a task.
    """
    task = [group.popleft()]
    task_weight = weight(task, per_task)
    while group and (task_weight := task_weight + weight([group[0]], per_task)) <= max_weight:
        task.append(group.popleft())
    return task


class Handover(NamedTuple):
    """Batches from one casting task, and the collector that stores the batches."""

    batches: list[Batch]
    collector: str  # name


def handovers(batches: Sequence[Batch], collectors: Mapping[str, str]) -> list[Handover]:
    """Choose collectors for batches that were cast.

    Batches of a task stay together.

    If a collector died with batches, these come alone. A collector on the host of the columns
    is preferred. A suspect batch is collected while no other batch is in stage 4: several
    collectors may share a process. `collectors` is {name of a collector: address of its worker}.
    """
    ready = [b for b in batches if b.state is BatchState.CAST]
    busy = [b for b in batches if b.state is BatchState.COLLECTING]
    if suspects := [b for b in ready if is_suspect(b, COLLECT)]:
        ready = [] if busy else suspects[:1]
    if any(is_suspect(b, COLLECT) for b in busy):
        return []
    load = Counter(name for _, name in {(b.key, b.collector) for b in busy})
    tasks: dict[tuple[str, Batch | None], list[Batch]] = {}
    for batch in ready:
        tasks.setdefault((batch.key, batch if batch.deaths[COLLECT] else None), []).append(batch)
    chosen: list[Handover] = []
    for task in tasks.values():
        free = [name for name in collectors if load[name] < TASKS_PER_COLLECTOR]
        if not free:
            break
        on_host = [name for name in free if _host(collectors[name]) == _host(task[0].worker)]
        name = min(on_host or free, key=lambda n: (load[n], n))
        chosen.append(Handover(task, name))
        load[name] += 1
    return chosen


def _host(address: str) -> str:
    """Return the host of a worker's address."""
    return address.rpartition("/")[2].rpartition(":")[0]


# -- when a batch is tried again -------------------------------------------------------------


def late_after_s(recent_casts: Sequence[tuple[float, int]]) -> float:
    """Return the age in seconds after which a batch is late.

    The age is infinite without recent casting times.
    """
    if not recent_casts:
        return float("inf")
    return max(LATE_S, LATE_FACTOR * statistics.median(seconds for seconds, _ in recent_casts))


def loss(
    batch: Batch, locations: PartitionSnapshot, prepared_workers: int, now_s: float, late_s: float
) -> Outcome | None:
    """Return why a batch should be offered again although its task has not failed, or None.

    The worker died (DIED), or the columns are gone with it or the worker is silent (GONE); the
    worker is paused and has not started the task (REFUSED); the batch has been cast or collected
    for too long (LATE).

    A worker that Dask has paused starts no task until memory is free, perhaps never: its tasks
    that have not started are offered elsewhere.

    Parameters
    ----------
    batch
        A batch under way.
    locations
        Workers of the partition (`members`), those without a recent heartbeat (`silent`), those
        that are not paused (keys of `free`), and the states of their tasks.
    prepared_workers
        Workers that can cast. Without another worker, a silent or late worker is waited
        for.
    now_s
        Current time, by the clock of `Batch.since`.
    late_s
        Age in seconds after which a batch is late.
    """
    if batch.state in (BatchState.CASTING, BatchState.CAST):
        if batch.worker not in locations.members:
            return Outcome.DIED if batch.state is BatchState.CASTING else Outcome.GONE
        if batch.worker in locations.silent:
            if prepared_workers:
                return Outcome.GONE
        elif batch.worker not in locations.free and batch.state is BatchState.CASTING:
            task = locations.tasks.get(batch.key)
            # "no-worker": not even sent there, as the worker was paused before.
            if task and task.state in ("no-worker", "processing") and not task.started:
                return Outcome.REFUSED
    late = (
        batch.state in (BatchState.CASTING, BatchState.COLLECTING) and now_s - batch.since > late_s
    )
    return (
        Outcome.LATE
        if late and (prepared_workers > 1 or batch.state is BatchState.COLLECTING)
        else None
    )
