"""Partitions whose workers are scaled as groups by another system, such as Kubernetes.

As with queued jobs, `adapting.py` makes the decisions on the scheduler. Once per second, a thread
of this process requests the target size of each group and passes changes on.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, Self

from distributed import Client

from ..adapting import GroupAdvice, GroupReport, JobSpec, add_partitions, advise_groups
from ..errors import PoolError
from ..rules import check_count, check_name
from ..workers import run_on_scheduler
from .clusters import pop_bounds

logger = logging.getLogger(__name__)

ADAPT_EVERY_S = 1.0  # interval between requests to the scheduler


class WorkerGroups(Protocol):
    """Interface for objects that set the sizes of worker groups on any system."""

    def scale(self, group: str, n: int, leaving: Sequence[str] = ()) -> object:
        """Set the number of workers in a group.

        The call is repeated until it succeeds, so a part of the work may already have been done by
        an earlier call.

        Parameters
        ----------
        group
            Name of the partition.
        n
            Number of workers, without the workers in `leaving`.
        leaving
            Names of workers that have been closed and must not be started again. Other workers must
            not be removed, because they may have tasks, or results that no other worker has.

        Raises
        ------
        Exception
            If the group cannot be scaled at the moment. The call is repeated later.
        """


def scale_groups(
    client: Client,
    groups: WorkerGroups,
    partitions: Mapping[str, Mapping[str, Any]],
    report: Callable[[str], object] = logger.warning,
) -> GroupScaler:
    """Adapt the sizes of worker groups to the amount of work in their partitions.

    Workers join with the resource of their partition, for example with ``--resources "GPU=1"``.
    Initially, each group has its minimum number of workers. Workers that have not joined yet are
    not canceled. If their tasks have ended in the meantime, they join and are closed after they
    have been idle.

    Parameters
    ----------
    client
        Client of the cluster.
    groups
        Object that scales the groups, such as a `KubernetesGroups`.
    partitions
        Mapping of each name to its options. ``adapt`` is the minimum and maximum number of workers,
        for example ``[0, 8]``. ``slots`` is the number of tasks that each worker runs at the same
        time (1 by default). ``idle_s`` is the time in seconds without work after which a worker is
        closed (60 by default). `Partition.adapt` changes the range.
    report
        Function that is called with the reason if a group cannot be scaled, once for each message.

    Returns
    -------
    GroupScaler
        Stops scaling at the end of its ``with`` block, when the client closes, or when its `close`
        is called. The groups then keep their sizes.

    Raises
    ------
    PoolError
        If an option is invalid, or if poolpart is not installed in the environment of the
        scheduler.

    Examples
    --------
    >>> with scale_groups(client, KubernetesGroups(cluster), {"GPU": {"adapt": [0, 8]}}):
    ...     results = list(Partition("GPU", client).map(cast, scans))   # doctest: +SKIP
    """
    if not callable(getattr(groups, "scale", None)):
        raise PoolError(
            "`scale_groups` expects an object with a method `scale(group, n, leaving)`, but got "
            f"{groups!r}. For dask-kubernetes, pass `KubernetesGroups(cluster)`."
        )
    specs = {name: _job_spec(name, options) for name, options in partitions.items()}
    run_on_scheduler(client, add_partitions, specs=specs)
    return GroupScaler(client, groups, specs, report)


def _job_spec(name: str, options: Mapping[str, Any]) -> JobSpec:
    """Validate the options of a partition.

    Raises
    ------
    PoolError
        If an option is invalid.
    """
    check_name(name)
    remaining = dict(options)
    bounds = pop_bounds(name, remaining)
    slots = remaining.pop("slots", 1)
    check_count(f"the number of slots of partition {name!r}", slots)
    if bounds is None or remaining:
        unknown = f"Unknown options: {', '.join(sorted(remaining))}."
        problem = unknown if remaining else "`adapt` is missing."
        raise PoolError(
            f"Invalid options for partition {name!r}. {problem} Expected `adapt`, for example "
            "[0, 8], and optionally `slots` and `idle_s`."
        )
    return JobSpec(slots, bounds=bounds, cancellable=False)


class GroupScaler:
    """Thread that scales worker groups, started by `scale_groups`."""

    def __init__(
        self,
        client: Client,
        groups: WorkerGroups,
        specs: Mapping[str, JobSpec],
        report: Callable[[str], object],
    ) -> None:
        self._client = client
        self._groups = groups
        self._report = report
        self._reports = {
            name: GroupReport(spec.bounds.minimum if spec.bounds else 0)
            for name, spec in specs.items()
        }
        self._messages: set[str] = set()  # reported messages
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="poolpart-groups", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop scaling. If a call to `scale` is in progress, wait for it to return."""
        self._closed.set()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        """Scale the groups to the requested sizes until the scaler or the client is closed."""
        while not self._closed.wait(ADAPT_EVERY_S):
            try:
                advice = run_on_scheduler(self._client, advise_groups, reports=self._reports)
            except (PoolError, OSError):  # the client is closed or reconnecting
                if self._client.status in ("closing", "closed"):
                    return
                continue
            for name, advice_of_group in advice.items():
                self._scale(name, advice_of_group)

    def _scale(self, name: str, advice: GroupAdvice) -> None:
        """Scale a group. A failed call is repeated, because the next advice will be the same."""
        if advice == GroupAdvice(self._reports[name].size):
            return
        try:
            self._groups.scale(name, advice.size, advice.leaving)
        except Exception as error:
            message = f"Group {name!r} could not be scaled to {advice.size} workers: {error}"
            if message not in self._messages:
                self._messages.add(message)
                self._report(message)
        else:
            self._reports[name] = GroupReport(advice.size, advice.leaving)
