"""Tasks of a partition that the driver submits a few at a time, each with its purpose."""

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


class Tasks(Generic[T]):
    """Submitted tasks of a partition, and a `book` with the records of finished tasks.

    Each task returns its result and its record. `sources` is ``lidarpool`` of the run's `software`.
    """

    def __init__(self, partition: Partition, sources: str) -> None:
        self._client = partition.client
        self.partition = partition
        self._sources = sources
        self.book = TaskBook()
        self.running: dict[Future, T] = {}  # {future: its purpose}
        # {plug-in that the tasks use: version that the workers must have}
        self.plugins: Mapping[Plugin, str] = {}

    def submit(
        self, purpose: T, function: Callable[..., Any], *arguments: Any, **options: Any
    ) -> None:
        """Submit a task with its purpose, and `options` as of `Partition.submit`."""
        call = (call_with_plugins, self.plugins, function) if self.plugins else (function,)
        future = self.partition.submit(
            call_with_same_sources, self._sources, *call, *arguments, **options
        )
        self.running[future] = purpose

    def take_done(self) -> list[tuple[T, Any]]:
        """Remove the finished tasks, and return their purposes and results."""
        finished = {future.key: future for future in self.running if future.status == "finished"}
        results: list[tuple[T, Any]] = []
        if not finished:
            return results
        for key, (result, record) in fetch_available(self._client, [*finished]).items():
            self.book.add(record)
            results.append((self.running.pop(finished[key]), result))
        return results

    def take_failed(self) -> list[tuple[T, Future]]:
        """Remove and return failed and cancelled tasks, which Dask does not repeat."""
        failed = [future for future in self.running if future.status in ("error", "cancelled")]
        return [(self.running.pop(future), future) for future in failed]

    def look(self) -> PartitionSnapshot:
        """Return the locations of the running tasks."""
        keys = [future.key for future in self.running]
        return take_snapshot(self._client, self.partition.name, keys)

    def cancel(self) -> None:
        """Cancel all tasks, although tasks that have begun run to their end."""
        self._client.cancel([*self.running])
        self.running.clear()
