"""A partition: the workers that declare one Dask resource, and work for them alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from distributed import Client, Future, as_completed

from .worker_info import WorkerInfo


class Partition:
    """The workers of a cluster that declare the resource `name`.

    Whatever it submits takes one slot of that resource, so that it runs on these workers and
    on no others. Membership is what the workers declare now: a worker that its nanny
    restarted, or one that joined with the resource, belongs.

    Parameters
    ----------
    name
        Name of the partition and of the resource.
    client
        Client of the cluster.
    note
        Something a user should know of it, such as that it had to do without GPUs.
    """

    def __init__(self, name: str, client: Client, note: str = "") -> None:
        self.name, self.client, self.note = name, client, note

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """The members now, by name."""
        identities = self.client.scheduler_info(n_workers=-1)["workers"]
        members = (WorkerInfo.from_identity(a, i) for a, i in identities.items())
        return tuple(sorted((w for w in members if w.resources.get(self.name)), key=_by_name))

    @property
    def slots(self) -> int:
        """Tasks that the partition runs at a time."""
        return int(sum(worker.resources[self.name] for worker in self.workers))

    def __len__(self) -> int:
        return len(self.workers)

    def __repr__(self) -> str:
        names = [worker.name for worker in self.workers]
        shown = ", ".join(names[:4]) + (", …" if len(names) > 4 else "")
        note = f"; {self.note}" if self.note else ""
        return (
            f"<Partition {self.name!r}: {len(names)} worker{'s' * (len(names) != 1)} "
            f"({shown}), {self.slots} slots{note}>"
        )

    def submit(
        self,
        function: Callable[..., Any],
        /,
        *args: Any,
        key: str | None = None,
        priority: int = 0,
        **kwargs: Any,
    ) -> Future:
        """Submit one task to these workers.

        Parameters
        ----------
        function, args, kwargs
            What to call.
        key
            The task's key; by default a new one, so that equal calls run each by itself.
        priority
            Higher runs first.

        Returns
        -------
        Future
        """
        return self.client.submit(
            function,
            *args,
            key=key,
            pure=False,
            priority=priority,
            resources={self.name: 1},
            **kwargs,
        )

    def map(
        self, function: Callable[..., Any], /, *iterables: Iterable[Any], priority: int = 0
    ) -> list[Future]:
        """Submit one task for each item, all at once; see `imap` for many items."""
        return [
            self.submit(function, *args, priority=priority)
            for args in zip(*iterables, strict=False)
        ]

    def imap(
        self,
        function: Callable[..., Any],
        items: Iterable[Any],
        window: int | None = None,
        ordered: bool = True,
    ) -> Iterator[Any]:
        """Results of `function` for each item, with a bounded number of tasks under way.

        Dask does not hold back tasks that need a resource, so mapping a long iterable at once
        would fill the workers with results that nobody has taken yet.

        Parameters
        ----------
        function
            Called with one item.
        items
            The items; taken as they are needed.
        window
            Tasks under way at most; twice the slots by default.
        ordered
            Results in the order of the items, or else as they come.

        Yields
        ------
        object
            Results. An error of a task is raised here.
        """
        window = window or max(2, 2 * self.slots)
        source = iter(items)
        if ordered:
            waiting: deque[Future] = deque()
            for item in source:
                waiting.append(self.submit(function, item))
                if len(waiting) >= window:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
            return
        running = as_completed([], loop=self.client.loop)
        for item in source:
            running.add(self.submit(function, item))
            if running.count() >= window:
                yield next(running).result()
        for future in running:
            yield future.result()


def _by_name(worker: WorkerInfo) -> tuple[int, str]:
    """Sort key that puts worker 10 behind worker 9."""
    return len(worker.name), worker.name
