"""Statistics of tasks by partition and by stage.

A scheduler plugin counts finished tasks. The partition of a task is the resource that it requests,
or "". Its stage is the prefix of its key, which is the name of the function for most tasks.
Unfinished tasks are counted on request.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

from distributed.diagnostics.plugin import SchedulerPlugin

from .adapting import shared_queue_of
from .features import FEATURES
from .fence import fence_names
from .internals.scheduler import in_running_order
from .partition_stats import PartitionStats, StageStats, describe_size
from .shares import clients_of
from .steward import target_of
from .task_table import MAX_ENDED_TASKS, TaskRow, to_datetime

NAME = "poolpart-stats"
PEAKS = "poolpart-peaks"  # topic of events about the peak memory of stages
_ERROR_LETTERS = 200  # maximum length of the error of a task
_MAX_EXAMINED = 1000  # number of tasks per worker that are searched for running tasks
_RUNNABLE = {"processing", "queued", "no-worker"}  # states of tasks whose inputs are available
# Our state of a task by Dask's state. "assigned" tasks are either running or queued.
_WAITING = {
    "waiting": "waiting",
    "queued": "queued",
    "no-worker": "queued",
    "processing": "assigned",
}


class _EndedTask(NamedTuple):
    """Finished task, from which a table row is only created on request, to save time."""

    state: str  # according to Dask
    key: Any
    function: str
    worker: Any  # name of the worker, or None
    slots: int
    queued: float | None  # times in seconds since 1970
    started: float | None
    finished: float | None
    error: str | None

    def to_row(self) -> TaskRow:
        started = to_datetime(self.started)
        finished = to_datetime(self.finished)
        return TaskRow(
            state="done" if self.state == "memory" else "failed",
            key=str(self.key),
            function=self.function,
            worker="" if self.worker is None else str(self.worker),
            slots=self.slots,
            queued=to_datetime(self.queued),
            started=started,
            finished=finished,
            error=" ".join((self.error or "").split())[:_ERROR_LETTERS],
            seconds=(finished - started).total_seconds() if started and finished else None,
        )


class TaskStatistics(SchedulerPlugin):
    """Scheduler plugin that counts the tasks that finish after its creation."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.since = time.time()  # time when counting began
        # Whether the counts are kept after the last client of a partition has closed.
        self.is_kept = False
        # {(partition, stage): totals of finished tasks, by field of `StageStats`}
        self.ended: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
        # {partition: finished tasks, newest first}
        self.recent: dict[str, deque[_EndedTask]] = defaultdict(
            lambda: deque(maxlen=MAX_ENDED_TASKS)
        )
        self._runnable: dict[Any, float] = {}  # {task key: time when its inputs were available}
        self._deaths: dict[Any, int] = {}  # {task key: workers that died while it was assigned}
        for feature in FEATURES:
            feature.begin_counting(self)

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, stimulus_id: str = "", **kwargs: Any
    ) -> None:
        """Count a finished task, or record when a task has become ready to run."""
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
        if finish == "released":  # its worker has died, or it was canceled or rescheduled
            if task.suspicious > self._deaths.get(key, 0):
                self._deaths[key] = task.suspicious
                self.ended[partition_of(task), task.prefix.name]["lost"] += 1
            return
        counts: dict[str, Any] = self.ended[partition_of(task), task.prefix.name]
        counts["done" if finish == "memory" else "failed"] += 1
        computing = [span for span in kwargs.get("startstops") or () if span["action"] == "compute"]
        counts["seconds"] += sum(span["stop"] - span["start"] for span in computing)
        self._keep(task, finish, runnable, computing, kwargs)
        if computing and runnable is not None:  # Dask converts both to the scheduler's clock
            counts["queued_seconds"] += max(0.0, computing[0]["start"] - runnable)

    def add_pipe_wait(self, key: Any, seconds: float) -> None:
        """Record how long a running task has waited for a pipe."""
        task = self.scheduler.tasks.get(key)
        if task is not None:
            self.ended[partition_of(task), task.prefix.name]["pipe_seconds"] += seconds  # type: ignore[assignment]

    def log_event(self, topic: str, msg: Any) -> None:
        """Record the memory of a worker process that runs a stage."""
        if topic == PEAKS:
            counts = self.ended[msg["partition"], msg["stage"]]
            counts["peak_memory"] = max(counts["peak_memory"], msg["bytes"])

    def queued_since(self, key: Any) -> float | None:
        """Return when a task became ready to run, or None if this is unknown.

        The time is in seconds since 1970.
        """
        return self._runnable.get(key)

    def _keep(
        self,
        task: Any,
        finish: str,
        runnable: float | None,
        computing: list[Any],
        report: Mapping[str, Any],
    ) -> None:
        """Keep what a table shows of a finished task, given the `report` of its worker."""
        partition = partition_of(task)
        worker = self.scheduler.workers.get(report.get("worker"))
        self.recent[partition].appendleft(
            _EndedTask(
                finish,
                task.key,
                task.prefix.name,
                None if worker is None else worker.name,
                _slots_taken(task, partition),
                runnable,
                computing[0]["start"] if computing else None,
                computing[-1]["stop"] if computing else None,
                report.get("exception_text"),
            )
        )

    def all_stats(self) -> list[PartitionStats]:
        """Return the statistics of each partition, and of the tasks without a partition."""
        names = {name for name, _ in self.ended}
        for worker in self.scheduler.workers.values():
            names.update(name for name, slots in worker.resources.items() if slots)
        return stats_of(sorted(names | {""}), self.scheduler)

    def stop(self) -> None:
        """Notify all features that counting has stopped."""
        for feature in FEATURES:
            feature.end_counting(self)

    async def close(self) -> None:
        """Stop counting when the scheduler closes."""
        self.stop()


def partition_of(task: Any) -> str:
    """Return the first resource that a task requests, or ""."""
    resources = task.resource_restrictions
    return next(iter(resources)) if resources else ""


def workers_of(scheduler: Any, partition: str) -> list[Any]:
    """Return the states of a partition's workers. "" selects workers without resources."""
    workers = scheduler.workers.values()
    if partition:
        return [worker for worker in workers if worker.resources.get(partition)]
    return [worker for worker in workers if not any(worker.resources.values())]


def slots_of(worker: Any, partition: str) -> int:
    """Return a worker's number of slots in a partition. For "", return its thread count."""
    return int(worker.resources.get(partition, 0)) if partition else int(worker.nthreads)


def running_on(worker: Any, partition: str) -> tuple[Counter[str], int]:
    """Count a partition's running tasks on a worker by stage, and their slots.

    The scheduler does not know which assigned tasks are running, so it assumes that as many of them
    run as the worker has slots. Therefore, if nested tasks run in the slots of a waiting task, some
    of these tasks are not counted as running.
    """
    held = 0
    stages: Counter[str] = Counter()
    for task in _running_tasks(worker, partition):
        held += _slots_taken(task, partition)
        stages[task.prefix.name] += 1
    return stages, held


def _running_tasks(worker: Any, partition: str) -> Iterator[Any]:
    free = slots_of(worker, partition)
    for task in islice(in_running_order(worker), _MAX_EXAMINED):
        if partition_of(task) == partition and (takes := _slots_taken(task, partition)) <= free:
            free -= takes
            yield task


def _slots_taken(task: Any, partition: str) -> int:
    return int(task.resource_restrictions[partition]) if partition else 1


def tasks_of(name: str, dask_scheduler: Any = None) -> tuple[list[TaskRow], float]:
    """Return a table row for each unfinished task and each recently finished task of a partition.

    The second value is the time when counting began, in seconds since 1970. Runs on the scheduler.
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
    rows += [task.to_row() for task in statistics.recent.get(name, ())]
    return rows, statistics.since


def _times_of_running(task: Any) -> tuple[float | None, float | None]:
    """Return when a running task started, and for how many seconds it has been running.

    The start is in seconds since 1970. Both values are None until the first heartbeat after the
    start, because workers report running times with their heartbeats.
    """
    worker = task.processing_on
    reported_s = worker.executing.get(task)
    if reported_s is None:
        return None, None
    started = worker.last_seen - reported_s
    return started, max(reported_s, time.time() - started)


def size_of(name: str, dask_scheduler: Any = None) -> str:
    """Describe how many workers and slots a partition has, without counting its tasks.

    Runs on the scheduler.
    """
    workers = workers_of(dask_scheduler, name)
    slots = sum(slots_of(worker, name) for worker in workers)
    return describe_size(len(workers), target_of(dask_scheduler, name), slots)


def statistics_of(scheduler: Any, keep: bool = True) -> TaskStatistics:
    """Return the scheduler's statistics, and start counting if this has not been done.

    If `keep` is true, the counts are kept after the last client of a partition has closed.
    """
    statistics: TaskStatistics | None = scheduler.plugins.get(NAME)
    if statistics is None:
        statistics = TaskStatistics(scheduler)
        scheduler.add_plugin(statistics)
    statistics.is_kept |= keep
    return statistics


def forget_statistics(scheduler: Any) -> None:
    """Stop counting and delete the counts."""
    statistics: TaskStatistics | None = scheduler.plugins.get(NAME)
    if statistics is not None:
        statistics.stop()
        scheduler.remove_plugin(NAME)


def stats_of(names: Sequence[str], dask_scheduler: Any = None) -> list[PartitionStats]:
    """Return the statistics of each named partition. Runs on the scheduler."""
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
        sums: dict[str, Any] = {
            count: sum(getattr(stage, count) for stage in stages.values())
            for count in StageStats.__dataclass_fields__
        }
        sums["peak_memory"] = max((stage.peak_memory for stage in stages.values()), default=0)
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
                clients=clients_of(scheduler, name),
                queue=shared_queue_of(scheduler, name),
                **sums,
            )
        )
    return answers
