"""Statistics of partitions and their stages, for users and for the ``/metrics`` endpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

from dask.utils import format_bytes

from .html_table import format_seconds, html_table, text_table
from .rules import format_workers

COUNTS = ("waiting", "queued", "running", "done", "failed")  # task states, in the order of tables
HEAD_OF_COUNTS = (*COUNTS, "seconds", "peak memory")
_HEAD_OF_STAGES = ("stage", *HEAD_OF_COUNTS)
NO_PARTITION = "no partition"  # label for workers without a partition and for plain Dask tasks
_HEAD_OF_PARTITIONS = ("partition", "workers", "slots", "busy", *HEAD_OF_COUNTS)
HEAD_OF_CLIENTS = ("client", "weight", "share", "slots", "waiting", "wait", "seconds")
HEAD_OF_QUEUES = ("partition", "waiting jobs of others", "jobs being released", "state")


def describe_size(workers: int, target: int | None, slots: int) -> str:
    """Describe the size of a partition, for example as "1 of 2 workers, 4 slots"."""
    counted = format_workers(workers)
    if target is not None and target != workers:
        counted = f"{workers} of {format_workers(target)}"
    return f"{counted}, {slots} {'slot' if slots == 1 else 'slots'}"


@dataclass(frozen=True)
class SharedQueue:
    """Queue in which a partition yields to other users, as of its last listing.

    Parameters
    ----------
    waiting
        Number of waiting jobs of other users, or None if the queue cannot be listed.
    releasing
        Number of jobs of the partition that end after their running tasks to make room.
    problem
        Reason why the queue cannot be listed, or "".
    """

    waiting: int | None = 0
    releasing: int = 0
    problem: str = ""

    def __str__(self) -> str:
        if self.waiting is None:
            return f"queue cannot be listed: {self.problem}"
        return f"{self.waiting} waiting {'job' if self.waiting == 1 else 'jobs'} of other users"

    @property
    def cells(self) -> list[object]:
        """Table cells in the order of the columns, after the name of the partition."""
        if self.waiting is None:
            return ["unknown", self.releasing, f"cannot be listed: {self.problem}"]
        return [self.waiting, self.releasing, "listed"]


@dataclass(frozen=True)
class ClientStats:
    """Use of a partition by one client, including its nested tasks.

    Parameters
    ----------
    weight
        Weight of the client, as set by `Pool.set_weight`.
    share
        Fraction of the slot time of the last minute that the client's finished tasks have used.
    slots
        Number of slots that the client's tasks take, including short tasks that were assigned to
        workers in advance.
    waiting
        Number of tasks that wait for a slot.
    wait_s
        Mean time in seconds that recent tasks have waited for a slot.
    seconds
        Total slot time of finished tasks in seconds.
    queued_seconds
        Total time in seconds that tasks have waited for a slot.
    """

    weight: float = 1.0
    share: float = 0.0
    slots: int = 0
    waiting: int = 0
    wait_s: float = 0.0
    seconds: float = 0.0
    queued_seconds: float = 0.0

    @property
    def cells(self) -> list[object]:
        """Table cells in the order of the columns, after the name of the client."""
        return [
            f"{self.weight:g}",
            f"{self.share:.0%}",
            self.slots,
            self.waiting,
            format_seconds(self.wait_s),
            format_seconds(self.seconds),
        ]


@dataclass(frozen=True)
class StageStats:
    """Statistics of a stage, which consists of all tasks with the same key prefix.

    For most tasks, the prefix is the name of the function. Tasks of `Partition.map` have the suffix
    ``-map``.

    Parameters
    ----------
    waiting
        Number of tasks that wait for results of other tasks.
    queued
        Number of tasks that wait for a worker, or for a slot of a worker.
    running
        Number of running tasks. The scheduler is not notified when a task starts, so it assumes
        that a worker runs as many of its tasks as it has slots.
    done
        Number of successful runs, including those whose results were lost and recomputed.
    failed
        Number of tasks that raised an error, or that Dask stopped retrying after too many workers
        had died. Their dependents, which never ran, are not counted.
    seconds
        Total running time in seconds of tasks that finished or raised an error. Lost runs and tasks
        that exceeded their time limit are not included.
    queued_seconds
        Total time in seconds that these tasks waited for a worker or a slot after their inputs were
        available.
    pipe_seconds
        Time in seconds that tasks waited for pipes, because a pipe was full or empty. For finished
        tasks, it is part of `seconds`. Running tasks are included.
    lost
        Number of times that a worker died while it was running a task, as far as the scheduler
        knows. Dask runs these tasks again. Finished results that are lost are not counted. A task
        that Dask stops retrying after too many workers have died is counted as failed instead.
    peak_memory
        Highest memory usage of a worker process (its resident set size) in bytes while it was
        running a task of the stage, or 0 if it was not measured. It is sampled ten times a second
        and when a task ends, and includes everything in the process: libraries, stored results, and
        other tasks that run at the same time. In a process with several workers, it includes all of
        them. For a partition, it is the maximum of all stages.
    """

    waiting: int = 0
    queued: int = 0
    running: int = 0
    done: int = 0
    failed: int = 0
    seconds: float = 0.0
    queued_seconds: float = 0.0
    lost: int = 0
    pipe_seconds: float = 0.0
    peak_memory: int = 0

    def _repr_html_(self) -> str:
        return html_table(type(self).__name__, HEAD_OF_COUNTS, [self.cells])

    @property
    def cells(self) -> list[object]:
        """Table cells in the order of the columns, after the name of the stage."""
        return [
            *(getattr(self, count) for count in COUNTS),
            format_seconds(self.seconds),
            format_bytes(self.peak_memory) if self.peak_memory else "–",
        ]


@dataclass(frozen=True, repr=False)
class PartitionStats(StageStats):
    """Statistics of a partition, its workers, and its tasks.

    Counting of finished tasks begins when the cluster is divided, a client submits its first task
    to a partition, statistics are first requested, or the page is opened, whichever comes first.

    Parameters
    ----------
    name
        Name of the partition.
    workers
        Current number of workers.
    target
        Number of workers that the rule requests, or None if the rule, such as `rest`, does not
        request a number. It is greater than `workers` if a worker has been lost.
    slots, busy
        Total number of slots of these workers, and number of slots in use.
    exclusive
        Whether other tasks are kept off the workers.
    stages
        Counts of each stage, by name.
    clients
        Use of the partition by each client, keyed by its name or, if it has no name, its ID.
    since
        Time in UTC when counting began.
    queue
        Queue that the partition shares with other users if it has the option `yield_to_others`,
        otherwise None.
    """

    name: str = ""
    workers: int = 0
    slots: int = 0
    busy: int = 0
    exclusive: bool = False
    stages: Mapping[str, StageStats] = field(default_factory=dict)
    clients: Mapping[str, ClientStats] = field(default_factory=dict)
    since: datetime | None = None
    target: int | None = None
    queue: SharedQueue | None = None

    def __repr__(self) -> str:
        size = describe_size(self.workers, self.target, self.slots)
        since = f", counted since {self.since:%H:%M:%S} UTC" if self.since else ""
        stages = [[stage, *stats.cells] for stage, stats in self.stages.items()]
        lost = f", {self.lost} lost {'task' if self.lost == 1 else 'tasks'}" if self.lost else ""
        queue = f", {self.queue}" if self.queue else ""
        title = f"<PartitionStats {self.name!r}: {size}, {self.busy} busy{lost}{since}{queue}>"
        tables = [text_table(_HEAD_OF_STAGES, [*stages, ["all", *self.cells]])]
        if len(self.clients) > 1:
            tables.append(text_table(HEAD_OF_CLIENTS, self._client_rows))
        return "\n".join([title, *tables])

    def _repr_html_(self) -> str:
        name = self.name or NO_PARTITION
        row = [name, self.workers, self.slots, self.busy, *self.cells]
        tables = html_table("Partition", _HEAD_OF_PARTITIONS, [row])
        if self.stages:
            stages = [[stage, *stats.cells] for stage, stats in self.stages.items()]
            tables += html_table("Stages", _HEAD_OF_STAGES, stages)
        if len(self.clients) > 1:
            tables += html_table("Clients", HEAD_OF_CLIENTS, self._client_rows)
        if self.queue:
            tables += html_table("Shared queue", HEAD_OF_QUEUES, [[name, *self.queue.cells]])
        return tables

    @property
    def _client_rows(self) -> list[list[object]]:
        return [[client, *stats.cells] for client, stats in self.clients.items()]
