"""How busy a partition is and what it has done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from distributed import Client

from .fence_plugin import fences_of
from .remote import on_scheduler
from .stats_plugin import NAME, Statistics, members, running_on, slots_of


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


def watch(client: Client) -> None:
    """Count tasks from now on; does nothing where they are counted already."""
    on_scheduler(client, _watch)


def unwatch(client: Client) -> None:
    """Count no more, and forget what was counted."""
    on_scheduler(client, _unwatch)


def statistics_of(scheduler: Any) -> Statistics:
    """Find the scheduler's statistics; count from now on if it has none."""
    statistics: Statistics | None = scheduler.plugins.get(NAME)
    if statistics is None:
        statistics = Statistics(scheduler)
        scheduler.add_plugin(statistics)
    return statistics


async def _watch(dask_scheduler: Any = None) -> None:
    statistics_of(dask_scheduler)


async def _unwatch(dask_scheduler: Any = None) -> None:
    forget_statistics(dask_scheduler)


def forget_statistics(scheduler: Any) -> None:
    """Do what `unwatch` does, on the scheduler."""
    if NAME in scheduler.plugins:
        scheduler.remove_plugin(NAME)


async def _told(name: str, dask_scheduler: Any = None) -> dict[str, Any]:
    return told(dask_scheduler, name)


def told(scheduler: Any, name: str) -> dict[str, Any]:
    """Statistics of a partition as plain values; runs on the scheduler."""
    workers = members(scheduler, name)
    by_worker = [running_on(worker, name) for worker in workers]
    running: Counter[str] = sum(by_worker, Counter())
    slots = [slots_of(worker, name) for worker in workers]
    busy = sum(min(stages.total(), has) for stages, has in zip(by_worker, slots, strict=True))
    return {
        "name": name,
        "workers": len(workers),
        "slots": sum(slots),
        "busy": busy,
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
