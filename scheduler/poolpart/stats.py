"""Load and finished tasks of a partition.

A plugin of the scheduler counts tasks that have ended, by partition and stage. A task's partition
is the resource that it asks for, or ""; its stage is the prefix of its key, for most tasks the
function's name; there are as many stages as Dask itself keeps. Tasks under way are counted on
request.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .features import FEATURES
from .fence import fence_names
from .partition_stats import PartitionStats, StageStats, describe_size
from .steward import target_of
from .task_table import MAX_ENDED_TASKS, TaskRow, to_datetime

NAME = "poolpart-stats"
_ERROR_LETTERS = 200  # letters kept of the error of a task
_LOOK_AT_MOST = 1000  # tasks of one worker that are examined for running ones
_RUNNABLE = {"processing", "queued", "no-worker"}  # states of tasks whose inputs are there
# {Dask's state of a task: how the task is counted}; some assigned tasks run, some are queued
_WAITING = {
    "waiting": "waiting",
    "queued": "queued",
    "no-worker": "queued",
    "processing": "assigned",
}


class TaskStatistics(SchedulerPlugin):
    """Counts the scheduler's tasks that end, from its creation on."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.since = time.time()  # when counting began
        # Whether the counts outlive the clients that submit to partitions.
        self.is_kept = False
        # {(partition, stage): sums of its tasks that have ended, by fields of `StageStats`}
        self.ended: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
        # {partition: its tasks that have ended, newest first}
        self.recent: dict[str, deque[TaskRow]] = defaultdict(lambda: deque(maxlen=MAX_ENDED_TASKS))
        self._runnable: dict[Any, float] = {}  # {key: time since when a task could run}
        self._deaths: dict[Any, int] = {}  # {key of a task: workers that died while they ran it}
        for feature in FEATURES:
            feature.begin_counting(self)

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, stimulus_id: str = "", **kwargs: Any
    ) -> None:
        """Count a task that has ended, and note when a task could run."""
        if start == "waiting" and finish in _RUNNABLE:
            self._runnable[key] = time.time()
        if finish in _RUNNABLE:
            return
        runnable = self._runnable.pop(key, None)
        if finish == "forgotten":
            self._deaths.pop(key, None)
        if start != "processing" or finish not in ("memory", "erred", "released"):
            return
        task = self.scheduler.tasks[key]
        if finish == "released":  # its worker has died, or it was cancelled or rescheduled
            if task.suspicious > self._deaths.get(key, 0):
                self._deaths[key] = task.suspicious
                self.ended[partition_of(task), task.prefix.name]["lost"] += 1
            return
        counts: dict[str, Any] = self.ended[partition_of(task), task.prefix.name]
        counts["done" if finish == "memory" else "failed"] += 1
        computing = [span for span in kwargs.get("startstops") or () if span["action"] == "compute"]
        counts["seconds"] += sum(span["stop"] - span["start"] for span in computing)
        self._keep(task, finish, runnable, computing, kwargs)
        if computing and runnable is not None:  # both by the scheduler's clock: Dask corrects them
            counts["queued_seconds"] += max(0.0, computing[0]["start"] - runnable)

    def queued_since(self, key: Any) -> float | None:
        """Return the time since when a task could run, seconds since 1970, or None if unknown."""
        return self._runnable.get(key)

    def _keep(
        self,
        task: Any,
        finish: str,
        runnable: float | None,
        computing: list[Any],
        report: Mapping[str, Any],
    ) -> None:
        """Keep a task that has ended: `report` is what its worker told of it."""
        partition = partition_of(task)
        worker = self.scheduler.workers.get(report.get("worker"))
        started = to_datetime(computing[0]["start"] if computing else None)
        finished = to_datetime(computing[-1]["stop"] if computing else None)
        seconds = (finished - started).total_seconds() if started and finished else None
        self.recent[partition].appendleft(
            TaskRow(
                state="done" if finish == "memory" else "failed",
                key=str(task.key),
                function=task.prefix.name,
                worker="" if worker is None else str(worker.name),
                slots=_slots_taken(task, partition),
                queued=to_datetime(runnable),
                started=started,
                finished=finished,
                error=" ".join(str(report.get("exception_text") or "").split())[:_ERROR_LETTERS],
                seconds=seconds,
            )
        )

    def all_stats(self) -> list[PartitionStats]:
        """Return the statistics of each partition, and of tasks without a partition."""
        names = {name for name, _ in self.ended}
        for worker in self.scheduler.workers.values():
            names.update(name for name, slots in worker.resources.items() if slots)
        return stats_of(sorted(names | {""}), self.scheduler)

    def stop(self) -> None:
        """End what features do with the counts."""
        for feature in FEATURES:
            feature.end_counting(self)

    async def close(self) -> None:
        """Stop with the scheduler."""
        self.stop()


def partition_of(task: Any) -> str:
    """Return the resource that a task asks for, or ""."""
    resources = task.resource_restrictions
    return next(iter(resources)) if resources else ""


def workers_of(scheduler: Any, partition: str) -> list[Any]:
    """Return the states of the workers of a partition or, for "", of workers without resources."""
    workers = scheduler.workers.values()
    if partition:
        return [worker for worker in workers if worker.resources.get(partition)]
    return [worker for worker in workers if not any(worker.resources.values())]


def slots_of(worker: Any, partition: str) -> int:
    """Return the slots of a worker for a partition or, for "", the threads of the worker."""
    return int(worker.resources.get(partition, 0)) if partition else int(worker.nthreads)


def running_on(worker: Any, partition: str) -> tuple[Counter[str], int]:
    """Return the tasks of a partition that a worker runs, by stage, and their slots.

    The scheduler only knows which tasks it gave to a worker: as many of them run as the worker
    has slots. So of a task that waits and the nested tasks in its slots, some do not count.
    """
    held = 0
    stages: Counter[str] = Counter()
    for task in _running_tasks(worker, partition):
        held += _slots_taken(task, partition)
        stages[task.prefix.name] += 1
    return stages, held


def _running_tasks(worker: Any, partition: str) -> Iterator[Any]:
    """Yield the tasks of a partition that a worker runs."""
    free = slots_of(worker, partition)
    for task in islice(worker.processing, _LOOK_AT_MOST):
        if partition_of(task) == partition and (takes := _slots_taken(task, partition)) <= free:
            free -= takes
            yield task


def _slots_taken(task: Any, partition: str) -> int:
    """Return the slots of a partition that a task holds while it runs."""
    return int(task.resource_restrictions[partition]) if partition else 1


def tasks_of(name: str, dask_scheduler: Any = None) -> tuple[list[TaskRow], float]:
    """Return the unfinished tasks of a partition, and the ended tasks that are kept.

    Also returns when counting began, in seconds since 1970. Runs on the scheduler.
    """
    scheduler = dask_scheduler
    statistics = statistics_of(scheduler)
    running = {
        task.key for worker in workers_of(scheduler, name) for task in _running_tasks(worker, name)
    }
    rows = []
    for task in scheduler.tasks.values():
        state = _WAITING.get(task.state)
        if state is None or partition_of(task) != name:
            continue
        if state == "assigned":
            state = "running" if task.key in running else "queued"
        worker = task.processing_on
        started, seconds = _times_of_running(task) if state == "running" else (None, None)
        rows.append(
            TaskRow(
                state=state,
                key=str(task.key),
                function=task.prefix.name,
                worker="" if worker is None else str(worker.name),
                slots=_slots_taken(task, name),
                queued=to_datetime(statistics.queued_since(task.key)),
                started=to_datetime(started),
                seconds=seconds,
            )
        )
    return [*rows, *statistics.recent.get(name, ())], statistics.since


def _times_of_running(task: Any) -> tuple[float | None, float | None]:
    """Return when a running task started, in seconds since 1970, and for how long it has run.

    A worker reports the running time of its tasks with each heartbeat. Both are None before the
    first heartbeat after the start.
    """
    worker = task.processing_on
    reported_s = worker.executing.get(task)
    if reported_s is None:
        return None, None
    started = worker.last_seen - reported_s
    return started, max(reported_s, time.time() - started)


def size_of(name: str, dask_scheduler: Any = None) -> str:
    """Return the number of workers and slots of a partition in words, without counting its tasks.

    Runs on the scheduler.
    """
    workers = workers_of(dask_scheduler, name)
    slots = sum(slots_of(worker, name) for worker in workers)
    return describe_size(len(workers), target_of(dask_scheduler, name), slots)


def statistics_of(scheduler: Any, keep: bool = True) -> TaskStatistics:
    """Find the scheduler's statistics, or start counting.

    With `keep`, the counts outlive the clients that submit to partitions.
    """
    statistics: TaskStatistics | None = scheduler.plugins.get(NAME)
    if statistics is None:
        statistics = TaskStatistics(scheduler)
        scheduler.add_plugin(statistics)
    statistics.is_kept |= keep
    return statistics


def forget_statistics(scheduler: Any) -> None:
    """Stop counting, and delete the counts."""
    statistics: TaskStatistics | None = scheduler.plugins.get(NAME)
    if statistics is not None:
        statistics.stop()
        scheduler.remove_plugin(NAME)


def stats_of(names: Sequence[str], dask_scheduler: Any = None) -> list[PartitionStats]:
    """Return the statistics of partitions.

    Runs on the scheduler.
    """
    scheduler = dask_scheduler
    statistics = statistics_of(scheduler)
    under_way: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for task in scheduler.tasks.values():
        if count := _WAITING.get(task.state):
            under_way[partition_of(task), task.prefix.name][count] += 1
    all_stages = sorted(under_way.keys() | statistics.ended.keys())
    answers = []
    for name in names:
        workers = workers_of(scheduler, name)
        by_worker = [running_on(worker, name) for worker in workers]
        running: Counter[str] = sum((stages for stages, _ in by_worker), Counter())
        stages = {}
        for partition, stage in all_stages:
            if partition == name:
                counts = under_way[name, stage]
                ended = statistics.ended.get((name, stage), Counter[str]())
                runs = min(running[stage], counts["assigned"])
                queued = counts["queued"] + counts["assigned"] - runs
                stages[stage] = StageStats(counts["waiting"], queued, runs, **ended)
        sums = {
            count: sum(getattr(stage, count) for stage in stages.values())
            for count in StageStats.__dataclass_fields__
        }
        answers.append(
            PartitionStats(
                name=name,
                workers=len(workers),
                slots=sum(slots_of(worker, name) for worker in workers),
                busy=sum(held for _, held in by_worker),
                exclusive=name in fence_names(scheduler),
                since=to_datetime(statistics.since),
                target=target_of(scheduler, name),
                stages=stages,
                **sums,
            )
        )
    return answers
