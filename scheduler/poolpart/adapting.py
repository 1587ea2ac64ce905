"""Adaptive clusters (`cluster.adapt`): which workers may be stopped, and how many are wanted.

Dask asks the scheduler for both, and counts work over all workers: an idle worker is one too
many though it is the last of its partition, and a partition without workers gets none while
those of others are idle. Here partitions keep their minimum, and work is counted by partition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import dask
from dask.utils import parse_timedelta

from .book import Book, Seat
from .override import Overrides
from .placing import asks_for
from .rules import Count, PerGpu, PerHost, Rest


class Adapting:
    """What an adaptive cluster is told; part of the steward.

    Parameters
    ----------
    scheduler
        The scheduler.
    book
        Who is where.
    """

    def __init__(self, scheduler: Any, book: Book) -> None:
        self.scheduler, self.book = scheduler, book
        self._overrides = Overrides()

    def install(self) -> None:
        """Be asked for the number of workers from now on.

        Raises
        ------
        PoolError
            If this version of Dask asks for it in another way.
        """
        self._overrides.put(self.scheduler, {"adaptive_target": self._target})
        self.scheduler.handlers["adaptive_target"] = self.scheduler.adaptive_target

    def uninstall(self) -> None:
        """Take that back."""
        self._overrides.take_back()
        self.scheduler.handlers["adaptive_target"] = self.scheduler.adaptive_target

    def spare(self, workers: Iterable[Any]) -> list[Any]:
        """Those of the workers that may be stopped: each partition keeps its minimum.

        Parameters
        ----------
        workers
            States of those that Dask would stop if they were idle.
        """
        may_stop = {worker.address: worker for worker in workers}
        for name, rule in self.book.rules.items():
            members = self.book.members(name, present=True)
            offered = [m.info.address for m in members if m.info.address in may_stop]
            kept_anyhow = len(members) - len(offered)
            # The busiest, which are stopped last in any case.
            offered.sort(key=lambda address: _load(may_stop[address]), reverse=True)
            for address in offered[: max(0, rule.minimum - kept_anyhow)]:
                del may_stop[address]
        return list(may_stop.values())

    def _target(
        self, original: Callable[..., int], target_duration: str | float | None = None
    ) -> int:
        """Workers that the cluster should have."""
        asked = original(target_duration)
        if target_duration is None:
            target_duration = dask.config.get("distributed.adaptive.target-duration")
        seconds = parse_timedelta(target_duration)
        more = sum(self._more(name, seconds) for name in self.book.rules)
        return max(asked, len(self.scheduler.workers) + more) if more else asked

    def _more(self, name: str, target_s: float) -> int:
        """Workers that a partition needs beside those that it has, as its rule allows."""
        members = self.book.members(name)
        room = _room(self.book, name, members)
        if not room:
            return 0
        if not members:
            # How long they take is not known, nor how many slots a worker will have.
            return int(any(asks_for(task, [name]) for task in self.scheduler.unrunnable))
        states = [self.scheduler.workers[m.info.address] for m in members if m.absent_since is None]
        tasks = sum(len(state.processing) for state in states)
        slots = sum(member.slots for member in members) / len(members)
        work_s = sum(state.occupancy for state in states)
        wanted = min(math.ceil(work_s / target_s / slots), math.ceil(tasks / slots))
        return int(min(room, max(0, wanted - len(members))))


def _room(book: Book, name: str, members: list[Seat]) -> float:
    """How many workers that join would become members, whatever they are."""
    rule = book.rules[name]
    if isinstance(rule, Rest):
        return math.inf
    if isinstance(rule, Count):
        return max(0, rule.workers - len(members))
    if isinstance(rule, PerGpu | PerHost):  # more than that depends on where they are
        return max(0, max(rule.minimum, 1) - len(members))
    return 0


def _load(worker: Any) -> tuple[int, int]:
    return len(worker.processing), worker.nbytes
