"""A partition: the workers that declare one Dask resource, and work for them alone."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

from distributed import Client

from . import moves
from .backoff import Backoff
from .dissolve import dissolve
from .errors import PoolError
from .identities import worker_identities
from .stats import PartitionStats, partition_stats
from .submitter import Submitter
from .wording import counted
from .worker_info import WorkerInfo


class Partition(Submitter):
    """The workers of a cluster that declare the resource `name`.

    Whatever it submits takes one slot of that resource, so that it runs on these workers and
    on no others. Membership is what the workers declare now: a worker that its nanny
    restarted, or one that joined with the resource, belongs.

    Parameters
    ----------
    name
        Name of the partition and of the resource.
    client
        Client of the cluster. By default, in a task, that of its worker.
    note
        Something a user should know of it, such as that it had to do without GPUs.
    priority
        Priority of its tasks where none is given: of tasks that wait for the same worker,
        those of a higher one run first. It can be changed.

    Notes
    -----
    It can be given to a task, which submits with the client of its worker then.
    """

    def __init__(
        self, name: str, client: Client | None = None, note: str = "", priority: int = 0
    ) -> None:
        super().__init__(name, client, priority)
        self.note = note

    def __reduce__(self) -> tuple[Any, ...]:
        if self._quota is not None:
            raise TypeError(
                f"A handle on {self.name!r} with a quota cannot be sent to a task, since it counts "
                "what is submitted where it was made: send the partition, and limit it there."
            )
        return Partition, (self.name, None, self.note, self.priority)

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """The members now, by name."""
        identities = worker_identities(self.client)
        members = (WorkerInfo.from_identity(a, i) for a, i in identities.items())
        return tuple(sorted((w for w in members if w.resources.get(self.name)), key=_by_name))

    @property
    def slots(self) -> int:
        """Tasks that the partition runs at a time."""
        return _slots(self.workers, self.name)

    def __len__(self) -> int:
        return len(self.workers)

    def __repr__(self) -> str:
        if self.client.status != "running":
            return f"<Partition {self.name!r}: its client is {self.client.status}>"
        workers = self.workers
        names = [worker.name for worker in workers]
        shown = ", ".join(names[:4]) + (", …" if len(names) > 4 else "")
        note = f"; {self.note}" if self.note else ""
        return (
            f"<Partition {self.name!r}: {counted(len(names), 'worker')} "
            f"({shown}), {counted(_slots(workers, self.name), 'slot')}{note}>"
        )

    def stats(self) -> PartitionStats:
        """How busy it is and what it has done, whoever submitted the tasks."""
        return partition_stats(self.client, self.name)

    def wait(self, n_workers: int = 1, timeout_s: float | None = None) -> None:
        """Wait until the partition has so many workers.

        Dask itself waits silently, and for ever, with a task that no worker may take.

        Raises
        ------
        PoolError
            If it has fewer after so many seconds.
        """
        deadline = time.monotonic() + (float("inf") if timeout_s is None else timeout_s)
        pause = Backoff(0.01, 0.2)
        while (there := len(self)) < n_workers:
            if time.monotonic() >= deadline:
                raise PoolError(
                    f"Partition {self.name!r} has {there} of {counted(n_workers, 'worker')} after "
                    f'{timeout_s} s: start some with dask worker … --resources "{self.name}=1"'
                )
            pause.sleep()

    # -- workers that come and go ------------------------------------------------------

    @property
    def minimum(self) -> int:
        """Workers that it keeps whatever is moved, as said when it was made."""
        return moves.minimum(self.client, self.name)

    def grow(
        self, workers: int = 1, *, source: str | None = None, timeout_s: float = 60.0
    ) -> list[str]:
        """Move workers into this partition while everything runs; returns their names.

        What a worker has begun for the partition that it leaves ends there first, and what it
        has not begun goes to others. Where the partition was made of a number of workers, that
        number grows too.

        Parameters
        ----------
        workers
            How many.
        source
            Name of the partition that they leave; by default they are taken of workers that
            belong to none and of the partition that has the rest.
        timeout_s
            How long to wait for them to come free.

        Raises
        ------
        PoolError
            If there are too few, counting those that `source` needs; or if tasks do not end
            in time, in which case their workers stay where they are.

        Examples
        --------
        >>> gpu.grow(2, source="OTHER")                                # doctest: +SKIP
        ['5', '6']
        """
        return moves.grow(self.client, self.name, workers, source, timeout_s)

    def shrink(self, workers: int = 1, *, timeout_s: float = 60.0) -> list[str]:
        """Move workers out of this partition while everything runs; returns their names.

        They go to the partition that has the rest, if there is one, or to none; those with
        the least to do go first, in the way that `grow` describes.

        Raises
        ------
        PoolError
            If fewer than its minimum would be left, or their tasks do not end in time.
        """
        return moves.shrink(self.client, self.name, workers, timeout_s)

    def dissolve(self, timeout_s: float = 30.0) -> None:
        """Undo this partition; see `Pool.dissolve`."""
        dissolve(self.client, [self.name], timeout_s)


def _slots(workers: Iterable[WorkerInfo], name: str) -> int:
    return int(sum(worker.resources[name] for worker in workers))


def _by_name(worker: WorkerInfo) -> tuple[int, str]:
    """Sort key that puts worker 10 behind worker 9."""
    return len(worker.name), worker.name
