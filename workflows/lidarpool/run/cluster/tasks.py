"""Groups of tasks that the driver submits to a partition gradually."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from distributed import Future

from lidarsim.environment.plugins import Plugin
from poolpart import Partition
from poolpart.fetch import fetch_available
from poolpart.task_locations import PartitionSnapshot, take_snapshot

from ...identity.software import call_with_plugins, call_with_same_sources
from ..pipeline.task_book import TaskBook

T = TypeVar("T")


class TaskGroup(Generic[T]):
    """Tasks on a partition. Each task is associated with its purpose, such as a job.

    Each task returns its result and its record. The records of finished tasks are added to `book`.

    Parameters
    ----------
    partition
        Partition on which the tasks run.
    sources
        Value of ``lidarpool`` in the software of the run, which workers must have.
    """

    def __init__(self, partition: Partition, sources: str) -> None:
        self._client = partition.client
        self.partition = partition
        self._sources = sources
        self.book = TaskBook()
        self.running: dict[Future, T] = {}  # {future: purpose of the task}
        # Versions of the plug-ins that the tasks use, which workers must have.
        self.plugins: Mapping[Plugin, str] = {}

    def submit(
        self, purpose: T, function: Callable[..., Any], *arguments: Any, **options: Any
    ) -> None:
        """Submit a task, passing any options to `Partition.submit`."""
        call = (call_with_plugins, self.plugins, function) if self.plugins else (function,)
        future = self.partition.submit(
            call_with_same_sources, self._sources, *call, *arguments, **options
        )
        self.running[future] = purpose

    def pop_finished(self) -> list[tuple[T, Any]]:
        """Remove the finished tasks, and return their purposes and results."""
        finished = {future.key: future for future in self.running if future.status == "finished"}
        results: list[tuple[T, Any]] = []
        if not finished:
            return results
        for key, (result, record) in fetch_available(self._client, [*finished]).items():
            self.book.add_task(record)
            results.append((self.running.pop(finished[key]), result))
        return results

    def pop_failed(self) -> list[tuple[T, Future]]:
        """Remove the failed and canceled tasks, and return their purposes and futures."""
        failed = [future for future in self.running if future.status in ("error", "cancelled")]
        return [(self.running.pop(future), future) for future in failed]

    def locate(self) -> PartitionSnapshot:
        """Return the locations of the running tasks."""
        keys = [future.key for future in self.running]
        return take_snapshot(self._client, self.partition.name, keys)

    def cancel(self) -> None:
        """Cancel all tasks without interrupting those that are already running."""
        self._client.cancel([*self.running])
        self.running.clear()
