"""Policies of the driver for batch sizes, worker selection and retries.

They are pure functions, which do not access the clock, the cluster or the driver.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from .batches import Batch, BatchState, Outcome
from .stage_names import COLLECT, INTERSECT

if TYPE_CHECKING:
    from poolpart.task_locations import PartitionSnapshot

BATCH_SECONDS = 0.2  # casting time of a batch for which its overhead is negligible
SMALL_SECONDS = 0.05  # casting time of batches that need not be smaller to balance the load
MIN_BATCHES_PER_SLOT = 16  # ensures that no slot is idle for long at the end
MAX_GROWTH = 8  # maximum size of the next batch as a multiple of the largest recent batch
TASK_SECONDS = 0.4  # casting time of a task for which its overhead is negligible
SLOT_SECONDS = 0.008  # casting time of a task per slot, because a driver starts 125 tasks per s
MAX_BATCHES_PER_TASK = 32
TASKS_PER_SLOT = 2  # tasks that are offered per slot, so that slots do not wait for new tasks
TASKS_PER_COLLECTOR = 3  # tasks whose batches are assigned to a collector at the same time
SLOT_WORTH_S = 20.0  # casting time for which it is worth starting another slot
MAX_SPAN = 8  # span from the oldest to the newest batch as a multiple of the batches in flight
SUSPECT_DEATHS = 2  # number of workers that may die with a batch before it is tried alone
MAX_KILLS = 3  # number of workers that a single scan may kill while it is tried alone
LATE_S = 60.0  # a batch is late if it has been in a state longer than this, and longer than
LATE_FACTOR = 20.0  # this multiple of the median casting time


# -- amount of work in flight ----------------------------------------------------------------


def max_scans_per_batch(scans_per_task: int, scan_count: int, slots: int) -> int:
    """Return the maximum number of scans in a batch.

    The result is at least 1, because scans are never divided.

    Parameters
    ----------
    scans_per_task
        Number of scans that fit in the memory of a casting task.
    scan_count
        Number of scans in all jobs of the run that have not ended. They are divided so that all
        slots receive some of them.
    slots
        Number of casting tasks that run concurrently.
    """
    return max(1, min(scans_per_task, scan_count // (MIN_BATCHES_PER_SLOT * slots)))


def scans_per_batch(
    recent_casts: Sequence[tuple[float, int]], scans_per_task: int, scan_count: int, slots: int
) -> int:
    """Choose the number of scans in a batch, based on the casting times of recent batches.

    Several recent batches are considered, because casting times vary. When only the last batch was
    considered, the size varied by a factor of four during a campaign.

    Parameters
    ----------
    recent_casts
        Casting time in seconds and number of scans for each recent batch. Must not be empty.
    scans_per_task
        Number of scans that fit in the memory of a casting task.
    scan_count
        Number of scans in all jobs of the run that have not ended.
    slots
        Number of casting tasks that run concurrently.
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
    """Choose the number of small batches in a casting task, based on recent casting times.

    Each task takes the scheduler 0.5 to 1 ms. With one batch per task, a receipt took 2.5 ms of the
    scheduler's CPU time. With several batches, it takes 0.4 to 0.9 ms.

    Parameters
    ----------
    recent_casts
        Casting time in seconds and number of scans for each recent batch.
    slots
        Number of casting tasks that run concurrently.
    """
    if not recent_casts:
        return 1
    median_s = max(statistics.median(seconds for seconds, _ in recent_casts), 1e-6)
    target_s = max(TASK_SECONDS, SLOT_SECONDS * slots)
    return max(1, min(int(target_s / median_s), MAX_BATCHES_PER_TASK))


def weight(batches: Iterable[Batch], per_task: int) -> float:
    """Return the total weight of batches. A small batch has the weight 1.

    A full task has the weight `per_task`. All batches of a task are in the memory of a worker at
    the same time, so a batch that fills half of the memory of a task (`batch.share` is 0.5) has the
    weight ``per_task / 2``. The minimum weight of a batch is 1.
    """
    return sum(max(1.0, per_task * batch.share) for batch in batches)


def max_weight_in_flight(slots: int, collectors: int, per_task: int = 1) -> int:
    """Return the maximum total `weight` of batches in flight.

    Parameters
    ----------
    slots
        Number of casting tasks that run concurrently.
    collectors
        Number of collectors.
    per_task
        Number of small batches in a task.
    """
    return (TASKS_PER_SLOT * slots + TASKS_PER_COLLECTOR * collectors + 2) * per_task


def slots_wanted(scan_count: int, scan_s: float | None) -> int:
    """Return the number of casting slots to request for a number of scans.

    The casting time of a scan in seconds is given by `scan_s`. If it is None because it is not
    known yet, one slot is requested per scan, because slots that are requested later from a batch
    system would have to wait in the queue again.
    """
    return (
        scan_count
        if scan_s is None
        else min(scan_count, math.ceil(scan_count * scan_s / SLOT_WORTH_S))
    )


# -- choice of workers and collectors ---------------------------------------------------------


def kills_alone(batch: Batch, stage: str) -> int:
    """Return how many workers of a stage have died while they processed only this batch.

    The number is negative if the batch is not suspect yet.

    After `SUSPECT_DEATHS` deaths, a batch is suspect and is tried alone. If it is not the cause, it
    then succeeds. If its worker dies again, the batch is divided, down to single scans. A scan is
    considered the cause if `MAX_KILLS` consecutive workers die while processing only this scan.
    """
    return batch.deaths[stage] - SUSPECT_DEATHS


def is_suspect(batch: Batch, stage: str) -> bool:
    """Return True if a batch may have killed workers of a stage, and must be tried alone."""
    return bool(batch.deaths) and kills_alone(batch, stage) >= 0


class TaskOffer(NamedTuple):
    """Batches of a casting task, and the worker to which the task is offered."""

    batches: list[Batch]
    worker: str  # address


def choose_offers(
    batches: Sequence[Batch], slots: Mapping[str, int], max_weight: int, per_task: int = 1
) -> list[TaskOffer]:
    """Group waiting batches into casting tasks, and choose a worker for each task.

    Waiting batches are processed in order. The worker with the lowest load relative to its slots
    receives the next task. A task contains up to `per_task` batches of jobs with the same scene.
    Smaller tasks are offered only if a slot is idle and stage 4 keeps up.

    If a worker died with a batch, the batch gets a separate task, so that other batches are not
    blamed for the next death. A suspect batch even gets a separate worker, and later batches wait
    until there is one, so that they do not occupy all workers.

    Parameters
    ----------
    batches
        Waiting batches in their order, and all batches in flight.
    slots
        Number of concurrent casting tasks, by worker address.
    max_weight
        Maximum `weight` of all batches in flight.
    per_task
        Number of small batches in a task.
    """
    state = _OfferState.from_batches(batches, slots, max_weight, per_task)
    waiting = [batch for batch in batches if batch.state is BatchState.WAITING]
    idle_slots = state.idle_slots()
    # Weight of a task if the waiting batches are divided among all idle slots, rounded up.
    idle_share = -(-weight(waiting, per_task) // max(1, idle_slots))
    task_size = per_task if state.has_backlog else min(per_task, idle_share)
    groups: dict[object, deque[Batch]] = {}  # batches that may share a task
    for batch in waiting:
        groups.setdefault(_group_key(batch), deque()).append(batch)
    chosen: list[TaskOffer] = []
    passed: set[Batch] = set()  # batches in chosen tasks, or in tasks that may still grow
    for first in waiting:
        if first in passed:
            continue
        suspect = is_suspect(first, INTERSECT)
        worker = state.least_loaded(alone=suspect)
        if worker is None or state.free_weight < 1:
            break
        group = groups[_group_key(first)]
        if state.may_wait(first, group, worker):
            passed.update(group)  # the task would have to wait anyway, and may still grow
            continue
        task = _take_task(group, min(task_size, state.free_weight), per_task)
        passed.update(task)
        chosen.append(TaskOffer(task, worker))
        state.count_task(task, worker, alone=suspect)
    return chosen


@dataclass(eq=False)
class _OfferState:
    """Load of the casting workers, which is updated with each task that is offered."""

    slots: Mapping[str, int]  # {address: number of concurrent casting tasks}
    per_task: int  # number of small batches in a task
    load: Counter[str]  # {address: number of tasks on the worker}
    reserved: set[str]  # addresses of workers that are trying a suspect batch
    free_weight: float  # weight of the batches that may still be offered
    has_backlog: bool  # True if cast batches are waiting for a collector

    @classmethod
    def from_batches(
        cls, batches: Sequence[Batch], slots: Mapping[str, int], max_weight: int, per_task: int
    ) -> _OfferState:
        """Compute the load that results from the batches in flight."""
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
        """Return the number of idle slots on workers that are not reserved."""
        return sum(
            max(0, count - self.load[address])
            for address, count in self.slots.items()
            if address not in self.reserved
        )

    def least_loaded(self, *, alone: bool) -> str | None:
        """Return the worker with the lowest load relative to its slots, or None if all are full.

        If `alone` is True, all workers with tasks are considered full.
        """
        fullness = {
            address: self.load[address] / (1 if alone else TASKS_PER_SLOT * count)
            for address, count in self.slots.items()
            if address not in self.reserved
        }
        address = min(fullness, key=lambda a: (fullness[a], a), default="")
        return address if address and fullness[address] < 1 else None

    def may_wait(self, first: Batch, group: Collection[Batch], worker: str) -> bool:
        """Return True if a task is not full yet and its worker is busy, so that it can wait."""
        busy = self.has_backlog or self.load[worker] >= self.slots[worker]
        if not busy or first.deaths:
            return False
        return min(self.free_weight, weight(group, self.per_task)) < self.per_task

    def count_task(self, task: Collection[Batch], worker: str, *, alone: bool) -> None:
        """Count a task that is offered to a worker, and reserve the worker if `alone` is set."""
        self.free_weight -= weight(task, self.per_task)
        self.load[worker] += 1
        if alone:
            self.reserved.add(worker)


def _group_key(batch: Batch) -> object:
    """Return the group of a batch. Batches in the same group may share a task.

    Normally, batches of all jobs with the same scene may share a task. After a task with several
    jobs has failed, its batches only share tasks with batches of the same job. If a worker died
    with a batch, the batch gets a separate task.
    """
    if batch.deaths:
        return batch
    return batch.job.number if batch.single_job else batch.job.scene_name


def _take_task(group: deque[Batch], max_weight: float, per_task: int) -> list[Batch]:
    """Remove the batches of the next task from a group, and return them.

    The task contains at least one batch. Further batches are added as long as the `weight` of the
    task does not exceed `max_weight`.
    """
    task = [group.popleft()]
    task_weight = weight(task, per_task)
    while group and (task_weight := task_weight + weight([group[0]], per_task)) <= max_weight:
        task.append(group.popleft())
    return task


class Handover(NamedTuple):
    """Batches of a casting task, and the collector to which they are assigned."""

    batches: list[Batch]
    collector: str  # name of the collector


def choose_handovers(batches: Sequence[Batch], collectors: Mapping[str, str]) -> list[Handover]:
    """Choose collectors for batches that have been cast.

    The batches of a casting task are assigned to the same collector, except for batches with which
    a collector has died. Collectors on the host that holds the columns are preferred. A suspect
    batch is assigned only while no other batch is in stage 4, because several collectors may share
    a process.

    Parameters
    ----------
    batches
        All batches in flight.
    collectors
        Addresses of the workers that run the collectors, by collector name.
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
    return address.rpartition("/")[2].rpartition(":")[0]


# -- retries ---------------------------------------------------------------------------------


def late_after_s(recent_casts: Sequence[tuple[float, int]]) -> float:
    """Return the time in seconds after which a batch in the same state is late.

    Without recent casting times, the result is infinity.
    """
    if not recent_casts:
        return float("inf")
    return max(LATE_S, LATE_FACTOR * statistics.median(seconds for seconds, _ in recent_casts))


def find_loss(
    batch: Batch, locations: PartitionSnapshot, prepared_workers: int, now_s: float, late_s: float
) -> Outcome | None:
    """Return why a batch must be offered again, although its task has not failed.

    Parameters
    ----------
    batch
        Batch in flight.
    locations
        Workers of the partition (`members`), workers without a recent heartbeat (`silent`), workers
        that are not paused (keys of `free`), and the states of their tasks.
    prepared_workers
        Number of workers that can cast. If there is no alternative, the batch stays with a worker
        that is silent or late.
    now_s
        Current time on the clock of `Batch.since`.
    late_s
        Time in seconds after which a batch is late.

    Returns
    -------
    DIED if the worker died while casting, GONE if the worker does not respond or has left with the
    columns, REFUSED if the worker is paused and has not started the task, LATE if casting or
    collecting takes too long, or None if the batch should not be offered again. A paused worker may
    never start its tasks, because it waits until its memory usage decreases.
    """
    if batch.state in (BatchState.CASTING, BatchState.CAST):
        if batch.worker not in locations.members:
            return Outcome.DIED if batch.state is BatchState.CASTING else Outcome.GONE
        if batch.worker in locations.silent:
            if prepared_workers:
                return Outcome.GONE
        elif batch.worker not in locations.free and batch.state is BatchState.CASTING:
            task = locations.tasks.get(batch.key)
            # The state is "no-worker" if the worker was already paused when the task was submitted.
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
