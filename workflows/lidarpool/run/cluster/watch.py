"""Waiting for a scheduler and workers, at the start and later, with messages and a limit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any

from dask.utils import format_bytes
from distributed import Client

from lidarsim.base.errors import LidarError
from lidarsim.base.vocabulary import PATIENCE_S
from lidarsim.base.words import plural
from poolpart.task_locations import look_for_tasks
from poolpart.workers import worker_identities

WATCH_EVERY_S = 1.0
TELL_EVERY_S = 5.0  # messages about waiting; less often in a long wait


class Waiting:
    """Time that something may take to come, from the first time that it is asked or told.

    `tell` is called every few seconds with a line that says what it waits for.
    """

    def __init__(self, seconds: float = 0.0, tell: Callable[[str], None] = lambda words: None):
        self.seconds = seconds
        self._tell = tell
        self._told = float("-inf")

    @cached_property
    def _began(self) -> float:
        return time.monotonic()

    def begin(self) -> None:
        """Begin anew: what was waited for has been there."""
        self._began = time.monotonic()

    def left(self, now: float | None = None) -> float:
        """Seconds that are left; 0 when it is over."""
        now = time.monotonic() if now is None else now
        return max(0.0, self._began + self.seconds - now)

    def tell(self, what: str, why: str = "") -> None:
        """Say what is waited for, if it is time to."""
        now = time.monotonic()
        if now - max(self._told, self._began) >= max(TELL_EVERY_S, (now - self._began) / 10):
            self._told = now
            left = f"for another {self.left(now):.0f} s"
            self._tell(f"waiting for {what}, {left}{f': {why}' if why else ''}")


def queued(jobs: int) -> str:
    """Say that jobs are on their way."""
    return f"{plural(jobs, 'job')} in the queue, or starting"


class Watch:
    """Detects a partition that stays without workers, or whose workers take no tasks.

    Dask itself would wait for ever. The workers of the partitions `names` get new tasks during the
    run; tasks of `lasting` ones last as long as the run, so their workers need not take more. One
    may be empty for `patience_s`; `tell` is called every few seconds with a message meanwhile.
    """

    def __init__(
        self,
        client: Client,
        names: Iterable[str],
        lasting: Iterable[str] = (),
        patience_s: float = PATIENCE_S,
        tell: Callable[[str], None] = lambda words: None,
    ) -> None:
        self.client = client
        self.lasting = frozenset(lasting)
        self._tell = tell
        # {partition: how long it may be without workers}
        self._waits = {name: Waiting(patience_s, tell) for name in (*names, *self.lasting)}
        self._looked = float("-inf")
        self.notes: list[str] = []  # what a user should know: workers that Dask has paused

    def forget(self, names: Iterable[str]) -> None:
        """Stop watching these partitions, which have no more work."""
        for name in names:
            self._waits.pop(name, None)

    def look(self) -> None:
        """Check from time to time; LidarError if a partition was empty for too long."""
        now = time.monotonic()
        if now - self._looked < WATCH_EVERY_S:
            return
        self._looked = now
        # partitions with workers, and with those that take no tasks
        there = set()
        paused = set()
        for worker in worker_identities(self.client).values():
            for name in self._waits.keys() & worker["resources"].keys():
                if worker["status"] == "running" or name in self.lasting:
                    there.add(name)
                else:
                    paused.add(name)
                    if worker["status"] == "paused":
                        self._note_paused(name, worker)
        for name, waiting in self._waits.items():
            if name in there:
                waiting.begin()
            elif not waiting.left():
                raise LidarError(_lacking(name, name in paused, f"{waiting.seconds:.0f} s"))
            elif name in paused:
                advice = "give them a larger --memory-limit"
                waiting.tell(f"paused workers of partition {name}", advice)
            else:
                coming = look_for_tasks(self.client, name).coming
                waiting.tell(f"workers of partition {name}", queued(coming) if coming else "")

    def _note_paused(self, partition: str, worker: Mapping[str, Any]) -> None:
        """Say once of each worker that it gets no more tasks."""
        note = (
            f"Dask has paused worker {worker['name']} of partition {partition}, whose memory limit "
            f"is {format_bytes(worker['memory_limit'])}: others get its work until memory is free"
        )
        if note not in self.notes:
            self.notes.append(note)
            self._tell(note)


def _lacking(name: str, paused: bool, seconds: str) -> str:
    """Say that a partition was without workers for so long, or that they were paused."""
    start = f'start some with --resources "{name}=1" and run it again.'
    if paused:
        return (
            f"The workers of partition {name!r} have taken no tasks for {seconds}, so the run "
            "was ended: Dask pauses those whose memory is nearly full. Give them a larger "
            f"--memory-limit, or {start}"
        )
    return f"Partition {name!r} has had no workers for {seconds}, so the run was ended: {start}"
