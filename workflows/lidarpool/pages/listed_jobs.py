"""Lists of the running, recently finished and failed jobs of a run."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Container, Mapping, Sequence
from typing import Any

from lidarfiles.datasets.job_table import JobRow, Value
from lidarsim.words import format_rounded

LIST_EVERY_S = 0.5  # minimum time between updates of the running jobs
# Maximum number of rows in the table.
MAX_ENDED = 10
MAX_FAILED = 6
MAX_UNDER_WAY = 12


class RecentJobs:
    """Most recent jobs of a run, and totals over all jobs that have ended.

    `names` are the names of the values that the jobs vary, in the order of the table columns.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self.sums = Counter(done=0, failed=0, points=0, rays=0)
        self.under_way: Sequence[Mapping[str, Any]] = ()
        self._list_at = 0.0
        self._ended: deque[dict[str, Any]] = deque(maxlen=MAX_ENDED)
        self._failures: deque[dict[str, Any]] = deque(maxlen=MAX_FAILED)

    def update(self, under_way: Callable[[], Sequence[Mapping[str, Any]]], is_last: bool) -> None:
        """Update the running jobs if enough time has passed or if `is_last` is set."""
        time_s = time.monotonic()
        if time_s >= self._list_at or is_last:
            self._list_at = time_s + LIST_EVERY_S
            self.under_way = under_way()

    def add_ended_job(self, row: JobRow, opens: bool) -> None:
        """Count a job that has ended, and move it from the running jobs to the ended jobs.

        `opens` states whether the page can open the job.
        """
        self.under_way = [job for job in self.under_way if job["name"] != row.name]
        entry = {name: getattr(row, name) for name in ("name", "error", "points", "seconds")}
        entry |= {"number": row.number, "opens": opens, "values": self._format_values(row.values)}
        (self._ended if row.done else self._failures).append(entry)
        ended = "done" if row.done else "failed"
        self.sums.update({ended: 1, "points": row.points, "rays": row.rays})

    def name_of(self, number: int) -> str:
        """Return the name of a recently finished job.

        Raises
        ------
        KeyError
            If the job is not in the list.
        """
        names = {job["number"]: job["name"] for job in list(self._ended)}
        return str(names[number])

    def news(self, readable: Container[int]) -> dict[str, Any]:
        """Return the job lists as JSON-compatible objects.

        Jobs whose numbers are in `readable` can be opened as well.
        """
        under_way = self.under_way
        return dict(self.sums) | {
            "names": list(self._names),
            "busy": len(under_way),
            "under_way": [
                {**job, "values": self._format_values(job["values"])}
                for job in under_way[:MAX_UNDER_WAY]
            ],
            "failures": [*reversed(list(self._failures))],
            "ended": [
                job | {"opens": job["opens"] or job["number"] in readable}
                for job in reversed(list(self._ended))
            ],
        }

    def _format_values(self, values: Mapping[str, Value | None]) -> list[str]:
        shown = ("" if (value := values.get(name)) is None else value for name in self._names)
        words = (format_rounded(value, 4) if isinstance(value, float) else value for value in shown)
        return [str(value).lower() if isinstance(value, bool) else str(value) for value in words]
