"""Partitions whose workers are a group of a deployment that scales groups, such as Kubernetes.

The scheduler decides (`adapting.py`), as for jobs of a queue. Each second a thread of this process
asks for the size that each group shall have, and passes changes on.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, Self

from distributed import Client

from ..adapting import GroupAdvice, GroupReport, JobKind, begin, look_at_groups
from ..errors import PoolError
from ..rules import check_count, check_name
from ..workers import on_scheduler
from .clusters import take_bounds

logger = logging.getLogger(__name__)

ADAPT_EVERY_S = 1.0  # seconds between two questions to the scheduler


class WorkerGroups(Protocol):
    """Interface of an object that scales groups of workers, wherever the workers run."""

    def scale(self, group: str, n: int, leaving: Sequence[str] = ()) -> object:
        """Give a group `n` workers.

        The call is repeated until it succeeds, so that a part of it may have been done before.

        Parameters
        ----------
        group
            Name of the partition.
        n
            Number of workers, without the workers in `leaving`.
        leaving
            Names of workers that have been closed, and must not be started again. No other worker
            may be removed: it may have tasks, and results that no other worker has.

        Raises
        ------
        Exception
            If that is not possible now; it is tried again.
        """


def scale_groups(
    client: Client,
    groups: WorkerGroups,
    partitions: Mapping[str, Mapping[str, Any]],
    tell: Callable[[str], object] = logger.warning,
) -> GroupScaler:
    """Let the sizes of groups of workers follow the work of their partitions.

    Workers join with the resource of their partition, such as ``--resources "GPU=1"``. A group has
    its least number of workers when this is called. A worker that has not joined yet is not
    cancelled: if its task has ended meanwhile, it joins, and is closed once it has been idle.

    Parameters
    ----------
    client
        Client of the cluster.
    groups
        What scales the groups, such as a `KubernetesGroups`.
    partitions
        {name: options}. ``adapt`` is the least and the greatest number of workers, such as
        ``[0, 8]``; ``slots`` the tasks that each takes at a time, 1 by default; ``idle_s`` after
        how many seconds without work a worker is closed, 60 by default. `Partition.adapt` changes
        the range.
    tell
        Called with why a group cannot be scaled; each message once.

    Returns
    -------
    GroupScaler
        Ends with its ``with`` block, with the client, or by its `close`. The groups keep their
        sizes then.

    Raises
    ------
    PoolError
        If an option is wrong, or the scheduler lacks this package.

    Examples
    --------
    >>> with scale_groups(client, KubernetesGroups(cluster), {"GPU": {"adapt": [0, 8]}}):
    ...     results = list(Partition("GPU", client).map(cast, scans))   # doctest: +SKIP
    """
    if not callable(getattr(groups, "scale", None)):
        raise PoolError(
            f"scale_groups takes an object with scale(group, n, leaving), not {groups!r}; for "
            "dask-kubernetes give KubernetesGroups(cluster)."
        )
    kinds = {name: _kind(name, options) for name, options in partitions.items()}
    on_scheduler(client, begin, kinds=kinds)
    return GroupScaler(client, groups, kinds, tell)


def _kind(name: str, options: Mapping[str, Any]) -> JobKind:
    """Read and check the options of a partition.

    Raises PoolError if an option is wrong.
    """
    check_name(name)
    remaining = dict(options)
    bounds = take_bounds(name, remaining)
    slots = remaining.pop("slots", 1)
    check_count(f"The number of slots of partition {name!r}", slots)
    if bounds is None or remaining:
        wrong = f"not {', '.join(sorted(remaining))}" if remaining else "adapt is missing"
        raise PoolError(
            f'Partition {name!r} takes "adapt", such as [0, 8], "slots" and "idle_s"; {wrong}.'
        )
    return JobKind(slots, bounds=bounds, cancellable=False)


class GroupScaler:
    """The thread of `scale_groups`."""

    def __init__(
        self,
        client: Client,
        groups: WorkerGroups,
        kinds: Mapping[str, JobKind],
        tell: Callable[[str], object],
    ) -> None:
        self._client = client
        self._groups = groups
        self._tell = tell
        self._reports = {
            name: GroupReport(kind.bounds.minimum if kind.bounds else 0)
            for name, kind in kinds.items()
        }
        self._messages: set[str] = set()  # passed on so far
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="poolpart-groups", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop scaling, and wait for a call of `scale` that is under way."""
        self._closed.set()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _follow(self) -> None:
        """Ask the scheduler for sizes, and pass them on, until this or the client is closed."""
        while not self._closed.wait(ADAPT_EVERY_S):
            try:
                advice = on_scheduler(self._client, look_at_groups, reports=self._reports)
            except (PoolError, OSError):  # the client is closed, or is connecting again
                if self._client.status in ("closing", "closed"):
                    return
                continue
            for name, advice_of_group in advice.items():
                self._scale(name, advice_of_group)

    def _scale(self, name: str, advice: GroupAdvice) -> None:
        """Scale a group.

        If that fails, the next advice is the same.
        """
        if advice == GroupAdvice(self._reports[name].size):
            return
        try:
            self._groups.scale(name, advice.size, advice.leaving)
        except Exception as error:
            message = f"Group {name!r} cannot be scaled to {advice.size} workers: {error}"
            if message not in self._messages:
                self._messages.add(message)
                self._tell(message)
        else:
            self._reports[name] = GroupReport(advice.size, advice.leaving)
