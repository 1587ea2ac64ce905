"""Time limits and messages for a run that waits for its scheduler or workers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any

from dask.utils import format_bytes
from distributed import Client

from lidarsim.errors import LidarError, as_sentence
from lidarsim.schema.vocabulary import PATIENCE_S
from lidarsim.words import plural
from poolpart.task_locations import take_snapshot
from poolpart.workers import worker_identities

WATCH_EVERY_S = 1.0
REPORT_EVERY_S = 5.0  # minimum interval between messages, which become less frequent over time


class WaitTimer:
    """Time limit for waiting. The time starts when the object is first used.

    Parameters
    ----------
    seconds
        Time limit in seconds.
    report
        Function that is called every few seconds with a message.
    """

    def __init__(self, seconds: float = 0.0, report: Callable[[str], None] = lambda words: None):
        self.seconds = seconds
        self._report = report
        self._reported_at = float("-inf")

    @cached_property
    def _start_s(self) -> float:
        return time.monotonic()

    def restart(self) -> None:
        """Reset the time limit."""
        self._start_s = time.monotonic()

    def remaining_s(self, now_s: float | None = None) -> float:
        """Return the remaining time in seconds, or 0 if the limit has been exceeded.

        `now_s` is the monotonic time, which defaults to the current time.
        """
        now_s = time.monotonic() if now_s is None else now_s
        return max(0.0, self._start_s + self.seconds - now_s)

    def report(self, awaited: str, reason: str = "") -> None:
        """Report that the run is waiting for `awaited`, unless it was reported recently."""
        now_s = time.monotonic()
        if now_s - max(self._reported_at, self._start_s) >= max(
            REPORT_EVERY_S, (now_s - self._start_s) / 10
        ):
            self._reported_at = now_s
            remaining = f"for up to {self.remaining_s(now_s):.0f} s more"
            self._report(f"waiting for {awaited} {remaining}{f': {reason}' if reason else ''}")


def queued_clause(jobs: int) -> str:
    """Return a clause about queued or starting jobs."""
    return f"{plural(jobs, 'job is', 'jobs are')} in the queue or starting"


class Watch:
    """Watchdog for partitions that have no workers, or whose workers do not accept tasks.

    Dask itself would wait forever.

    Parameters
    ----------
    client
        Client of the cluster.
    names
        Partitions whose workers receive new tasks during the run.
    lasting
        Partitions whose tasks run until the end, so that their workers need not accept new tasks.
    worker_timeout_s
        Time in seconds that a partition may be without workers.
    report
        Function that is called every few seconds with a message during this time.
    """

    def __init__(
        self,
        client: Client,
        names: Iterable[str],
        lasting: Iterable[str] = (),
        worker_timeout_s: float = PATIENCE_S,
        report: Callable[[str], None] = lambda words: None,
    ) -> None:
        self.client = client
        self.lasting = frozenset(lasting)
        self._report = report
        # Time limit for each partition without workers.
        self._waits = {
            name: WaitTimer(worker_timeout_s, report) for name in (*names, *self.lasting)
        }
        self._checked_at = float("-inf")
        self.notes: list[str] = []  # notes for the user about workers that Dask has paused

    def remove_partitions(self, names: Iterable[str]) -> None:
        """Stop watching partitions that have no tasks left."""
        for name in names:
            self._waits.pop(name, None)

    def check(self) -> None:
        """Check the workers, unless they were checked recently.

        Raise LidarError if workers have been missing for too long.
        """
        now_s = time.monotonic()
        if now_s - self._checked_at < WATCH_EVERY_S:
            return
        self._checked_at = now_s
        staffed = set()  # partitions with workers that accept tasks
        paused = set()  # partitions with workers that accept no tasks
        for worker in worker_identities(self.client).values():
            for name in self._waits.keys() & worker["resources"].keys():
                if worker["status"] == "running" or name in self.lasting:
                    staffed.add(name)
                else:
                    paused.add(name)
                    if worker["status"] == "paused":
                        self._note_paused(name, worker)
        for name, waiting in self._waits.items():
            if name in staffed:
                waiting.restart()
            elif not waiting.remaining_s():
                raise LidarError(
                    _missing_workers_message(name, name in paused, f"{waiting.seconds:.0f} s")
                )
            elif name in paused:
                advice = "their memory is nearly full. Start them with a larger `--memory-limit`"
                waiting.report(f"paused workers of partition {name}", advice)
            else:
                coming = take_snapshot(self.client, name).queued_jobs
                waiting.report(
                    f"workers of partition {name}", queued_clause(coming) if coming else ""
                )

    def _note_paused(self, partition: str, worker: Mapping[str, Any]) -> None:
        note = (
            f"Dask paused worker {worker['name']} of partition {partition}, because its memory "
            f"is nearly full (limit: {format_bytes(worker['memory_limit'])}). Other workers take "
            "over its work until it resumes"
        )
        if note not in self.notes:
            self.notes.append(note)
            self._report(note)


def _missing_workers_message(name: str, paused: bool, seconds: str) -> str:
    """Return a message about a partition whose workers are missing or all paused."""
    start = f'start workers with `--resources "{name}=1"` and repeat the run.'
    if paused:
        return (
            f"The run was stopped because the workers of partition {name!r} have accepted no tasks "
            f"for {seconds}. Dask pauses workers whose memory is nearly full. Increase their "
            f"`--memory-limit`, or {start}"
        )
    return (
        f"The run was stopped because partition {name!r} has had no workers for {seconds}. "
        f"{as_sentence(start)}"
    )
