"""How busy a partition is and what it has done.

A plugin of the scheduler counts tasks by partition and stage. A task's partition is the
resource that it asks for, "" for a task that asks for none; its stage is the prefix of its key,
which for most tasks is the function's name. What is kept is bounded: counters for so many
stages, the latest tasks, and the keys of tasks that the scheduler itself still keeps.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .fence import fences_of
from .remote import on_scheduler

logger = logging.getLogger(__name__)

NAME = "poolpart-stats"
RECENT_TASKS = 4000
MOST_STAGES = 200  # counters, over all partitions; later stages share one
OTHER_STAGES = "(others)"
TOTALS_TOPIC = "poolpart-totals"  # `Client.log_event` of it adds to the totals of the page
_MOST_TOTALS = 20
_LOOK_AT_MOST = 1000  # tasks of one worker, in search of those that run
_PRESENT = frozenset(("waiting", "queued", "no-worker", "processing"))


@dataclass(slots=True)
class Tally:
    """Counts of one stage in one partition."""

    waiting: int = 0  # for other tasks
    queued: int = 0  # for a worker, on the scheduler
    processing: int = 0  # given to a worker, running or not
    done: int = 0
    failed: int = 0
    recomputed: int = 0
    seconds: float = 0.0

    def enter(self, state: str, by: int) -> None:
        """Count a task in or out of a state."""
        if state == "processing":
            self.processing += by
        elif state == "waiting":
            self.waiting += by
        elif state in _PRESENT:
            self.queued += by


@dataclass(frozen=True, slots=True)
class Ran:
    """A task that has run; times are seconds since the epoch."""

    worker: str
    partition: str
    stage: str
    start: float
    stop: float
    failed: bool


class Statistics(SchedulerPlugin):
    """Counts what the scheduler's tasks do, from when it was made."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.totals: dict[str, Any] = {}  # what users have told, for the page
        self.tallies: dict[tuple[str, str], Tally] = {}  # {(partition, stage): counts}
        self.recent: deque[Ran] = deque(maxlen=RECENT_TASKS)
        self.ran = 0  # tasks that were ever put into `recent`
        self._done: set[Any] = set()  # keys that were counted as done and are still known
        self._count_present()

    def _count_present(self) -> None:
        for task in self.scheduler.tasks.values():
            if task.state in _PRESENT:
                self._tally(task).enter(task.state, +1)

    # -- what the scheduler tells ------------------------------------------------------

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, stimulus_id: str = "", **kwargs: Any
    ) -> None:
        """Count a change of a task's state."""
        task = self.scheduler.tasks[key]
        tally = self._tally(task)
        if start in _PRESENT:
            tally.enter(start, -1)
        if finish in _PRESENT:
            tally.enter(finish, +1)
        elif finish == "forgotten":
            self._done.discard(key)
        elif start == "processing" and finish in ("memory", "erred"):
            self._ended(task, tally, finish == "erred", kwargs)

    def _ended(self, task: Any, tally: Tally, failed: bool, told: Mapping[str, Any]) -> None:
        if failed:
            tally.failed += 1
        elif task.key in self._done:
            tally.recomputed += 1
        else:
            tally.done += 1
            self._done.add(task.key)
        worker = self.scheduler.workers.get(told.get("worker"))
        for span in told.get("startstops") or ():
            if span["action"] == "compute":
                tally.seconds += span["stop"] - span["start"]
                name = str(worker.name) if worker else ""
                where = partition_of(task), task.prefix.name
                self.recent.append(Ran(name, *where, span["start"], span["stop"], failed))
                self.ran += 1

    def restart(self, scheduler: Any) -> None:
        """Forget what is under way: the scheduler has."""
        self._done.clear()
        for tally in self.tallies.values():
            tally.waiting = tally.queued = tally.processing = 0
        self._count_present()

    def log_event(self, topic: str, msg: Any) -> None:
        """Keep totals that somebody tells, a dictionary of plain values."""
        if topic == TOTALS_TOPIC and isinstance(msg, dict):
            self.totals.update((str(name)[:40], value) for name, value in msg.items())
            for name in list(self.totals)[:-_MOST_TOTALS]:
                del self.totals[name]

    def _tally(self, task: Any) -> Tally:
        where = partition_of(task), task.prefix.name
        tally = self.tallies.get(where)
        if tally is None:
            if len(self.tallies) >= MOST_STAGES:
                where = where[0], OTHER_STAGES
            tally = self.tallies.setdefault(where, Tally())
        return tally

    # -- answers -----------------------------------------------------------------------

    def stages(self, partition: str) -> dict[str, Tally]:
        """Get the counts of a partition by stage."""
        return {stage: t for (name, stage), t in self.tallies.items() if name == partition}

    def since(self, number: int) -> Iterator[Ran]:
        """Tasks that have run after the first `number`, as far as they are kept."""
        fresh = min(len(self.recent), max(0, self.ran - number))
        return islice(self.recent, len(self.recent) - fresh, None)


def partition_of(task: Any) -> str:
    """Resource that a task asks for, "" for none."""
    asked = task.resource_restrictions
    return next(iter(asked)) if asked else ""


def members(scheduler: Any, partition: str) -> list[Any]:
    """States of the workers of a partition; for "", of those that declare nothing."""
    workers = scheduler.workers.values()
    if partition:
        return [worker for worker in workers if worker.resources.get(partition)]
    return [worker for worker in workers if not any(worker.resources.values())]


def slots_of(worker: Any, partition: str) -> int:
    """Slots that a worker has for a partition; its threads, for tasks of none."""
    return int(worker.resources.get(partition, 0)) if partition else int(worker.nthreads)


def running_on(worker: Any, partition: str) -> tuple[Counter[str], int]:
    """Tasks of a partition that a worker runs, by stage, and the slots that they hold.

    As far as the scheduler knows, which is what it gave to a worker: of that, as many run as the
    worker has slots. Tasks that were submitted from inside others take none, but a thread each.
    """
    slots, threads = slots_of(worker, partition), worker.nthreads
    held = nested = 0
    stages: Counter[str] = Counter()
    for task in islice(worker.processing, _LOOK_AT_MOST):
        if partition_of(task) != partition:
            continue
        takes = int(task.resource_restrictions[partition]) if partition else 1
        if held + takes > slots or (not takes and nested == threads):
            continue
        held += takes
        nested += not takes
        stages[task.prefix.name] += 1
    return stages, held


@dataclass(frozen=True)
class StageStats:
    """Tasks of one stage, that is, with one key prefix.

    Parameters
    ----------
    waiting
        Tasks that wait for results of others.
    queued
        Tasks that wait for a worker, or for their turn on one.
    running
        Tasks that run. The scheduler does not see when a task starts: of what it gave to a
        worker, as many count as running as the worker has slots.
    done
        Tasks that have ended well; each once, however often it ran.
    recomputed
        Times that a task ended well again, since its result was lost with a worker.
    failed
        Times that a task raised an error or was given up after too many dead workers. Those
        that depend on it and never ran do not count.
    seconds
        Time that tasks have run, with the recomputed and failed ones; of those that were lost
        with their worker, nobody knows.
    """

    waiting: int = 0
    queued: int = 0
    running: int = 0
    done: int = 0
    recomputed: int = 0
    failed: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class PartitionStats(StageStats):
    """What a partition does now and has done since its tasks are counted.

    Counting begins when the cluster is divided, when the first statistics are asked for, or
    when the page is opened, whichever comes first.

    Parameters
    ----------
    name
        Name of the partition.
    workers
        Workers that it has now.
    slots, busy
        Slots that they have, and how many of those are held by a task. Tasks submitted from
        inside others run without holding one.
    exclusive
        Whether a fence keeps other tasks out.
    stages
        The same counts by stage.
    """

    name: str = ""
    workers: int = 0
    slots: int = 0
    busy: int = 0
    exclusive: bool = False
    stages: Mapping[str, StageStats] = field(default_factory=dict)

    @property
    def occupancy(self) -> float:
        """Share of the slots that is busy; 0 without slots."""
        return self.busy / self.slots if self.slots else 0.0


def partition_stats(client: Client, name: str) -> PartitionStats:
    """Statistics of a partition, whoever made it.

    Raises
    ------
    PoolError
        If the scheduler lacks this package.
    """
    told = on_scheduler(client, _told, name=name)
    stages = {stage: StageStats(**counts) for stage, counts in told.pop("stages").items()}
    sums = {
        count: sum(getattr(stage, count) for stage in stages.values())
        for count in StageStats.__dataclass_fields__
    }
    return PartitionStats(**told, **sums, stages=stages)


def statistics_of(scheduler: Any) -> Statistics:
    """Find the scheduler's statistics; count from now on if it has none."""
    statistics: Statistics | None = scheduler.plugins.get(NAME)
    if statistics is None:
        statistics = Statistics(scheduler)
        scheduler.add_plugin(statistics)
    return statistics


def forget_statistics(scheduler: Any) -> None:
    """Count no more, and forget what was counted."""
    if NAME in scheduler.plugins:
        scheduler.remove_plugin(NAME)


async def _told(name: str, dask_scheduler: Any = None) -> dict[str, Any]:
    return told(dask_scheduler, name)


def told(scheduler: Any, name: str) -> dict[str, Any]:
    """Statistics of a partition as plain values; runs on the scheduler."""
    workers = members(scheduler, name)
    by_worker = [running_on(worker, name) for worker in workers]
    running: Counter[str] = sum((stages for stages, _ in by_worker), Counter())
    return {
        "name": name,
        "workers": len(workers),
        "slots": sum(slots_of(worker, name) for worker in workers),
        "busy": sum(held for _, held in by_worker),
        "exclusive": name in fences_of(scheduler),
        "stages": {
            stage: {
                "waiting": tally.waiting,
                "queued": tally.queued + max(0, tally.processing - running[stage]),
                "running": min(running[stage], tally.processing),
                "done": tally.done,
                "recomputed": tally.recomputed,
                "failed": tally.failed,
                "seconds": tally.seconds,
            }
            for stage, tally in statistics_of(scheduler).stages(name).items()
        },
    }
