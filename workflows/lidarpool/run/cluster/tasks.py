"""Tasks of a partition that the driver submits a few at a time, and what each is for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from distributed import Future

from lidarsim.base.plugins import Plugin
from poolpart import Partition
from poolpart.fetch import fetch_available
from poolpart.task_locations import TaskLocations, look_for_tasks

from ...base.software import call_alike, call_with_plugins
from ..pipeline.task_book import TaskBook

T = TypeVar("T")


class Tasks(Generic[T]):
    """Tasks that have been submitted; `book` has the records of those that are done.

    Each returns its result and its record. `sources` is ``lidarpool`` of the run's `software`.
    """

    def __init__(self, partition: Partition, sources: str) -> None:
        self._client = partition.client
        self.partition = partition
        self._sources = sources
        self.book = TaskBook()
        self.running: dict[Future, T] = {}  # {future: what it is for}
        # {plug-in that the tasks use: its version, which their workers must have}
        self.plugins: Mapping[Plugin, str] = {}

    def submit(self, of: T, function: Callable[..., Any], *arguments: Any, **options: Any) -> None:
        """Submit a task; `options` as of `Partition.submit`."""
        call = (call_with_plugins, self.plugins, function) if self.plugins else (function,)
        future = self.partition.submit(call_alike, self._sources, *call, *arguments, **options)
        self.running[future] = of

    def take_done(self) -> list[tuple[T, Any]]:
        """Take those that are done, with their results."""
        done = {future.key: future for future in self.running if future.status == "finished"}
        taken = []
        for key, (result, record) in fetch_available(self._client, [*done]).items() if done else ():
            self.book.add(record)
            taken.append((self.running.pop(done[key]), result))
        return taken

    def take_failed(self) -> list[tuple[T, Future]]:
        """Take those that have failed, or were cancelled; Dask itself runs lost ones again."""
        failed = [future for future in self.running if future.status in ("error", "cancelled")]
        return [(self.running.pop(future), future) for future in failed]

    def look(self) -> TaskLocations:
        """Ask where they are."""
        keys = [future.key for future in self.running]
        return look_for_tasks(self._client, self.partition.name, keys)

    def cancel(self) -> None:
        """Drop all of them; those that have begun run to their end."""
        self._client.cancel([*self.running])
        self.running.clear()
