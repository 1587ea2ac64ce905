"""Jobs that end as soon as their running tasks have finished.

An adaptive partition drains jobs to make room for the jobs of other users. A worker of such a job
receives no new tasks, hands its waiting tasks to other workers of the partition, and copies its
results to them.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .internals.scheduler import (
    copy_results,
    hand_off_tasks,
    holds_nothing,
    resume_assigning,
    stop_assigning,
)

COPY_TIMEOUT_S = 10.0  # maximum time to copy the results of a job after its last task
RETRY_AFTER_S = 300.0  # time before a job whose results could not be copied is selected again


@dataclass
class _Drain:
    """Progress of a job that is being drained. Times are values of `time.monotonic`."""

    workers: Sequence[Any]
    requested_moves: set[Any] = field(default_factory=set)  # tasks that workers were asked for
    finished_at: float | None = None  # time when the job was found without tasks
    copying: asyncio.Future[Any] | None = None  # done when the results have been copied


class DrainingJobs:
    """The jobs of a partition that are being drained."""

    def __init__(self, scheduler: Any, partition: str) -> None:
        self._scheduler = scheduler
        self._partition = partition
        self._drains: dict[str, _Drain] = {}
        self._kept_until: dict[str, float] = {}  # {job: time when it may be selected again}

    def __contains__(self, job: str) -> bool:
        return job in self._drains

    def __len__(self) -> int:
        return len(self._drains)

    def update(self, running: Mapping[str, Sequence[Any]], count: int) -> dict[str, list[Any]]:
        """Drain the given number of jobs, and return those that have finished.

        If more jobs are being drained already, the workers of the jobs that were selected last
        receive tasks again.

        Parameters
        ----------
        running
            Jobs and the states of their workers.
        count
            Number of jobs to drain.

        Returns
        -------
        dict
            Jobs without tasks and results, and the states of their workers.
        """
        for job, drain in list(self._drains.items()):
            # A worker that was lost or restarted has another state, which accepts tasks.
            is_unchanged = list(running.get(job, ())) == list(drain.workers)
            if not is_unchanged or not all(map(self._can_drain, drain.workers)):
                self._resume(job)
        for job in list(self._drains)[count:]:
            self._resume(job)
        self._kept_until = {job: until for job, until in self._kept_until.items() if job in running}
        for job in self._candidates(running)[: count - len(self._drains)]:
            self._drains[job] = _Drain(running[job])
        return {job: [*self._drains[job].workers] for job in list(self._drains) if self._step(job)}

    def loads(self, running: Mapping[str, Sequence[Any]]) -> list[int]:
        """Return the number of tasks of each job that can be drained, in the order of selection.

        Jobs that are already being drained come first. Their number of tasks is given as -1.
        """
        draining = [-1 for job in self._drains if job in running]
        return draining + [_count_tasks(running[job]) for job in self._candidates(running)]

    def _candidates(self, running: Mapping[str, Sequence[Any]]) -> list[str]:
        """Return the jobs that can be drained, starting with the jobs with the fewest tasks."""
        now = time.monotonic()
        jobs = [
            job
            for job, workers in running.items()
            if job not in self._drains
            and self._kept_until.get(job, now) <= now
            and all(map(self._can_drain, workers))
        ]
        return sorted(jobs, key=lambda job: _count_tasks(running[job]))

    def _can_drain(self, worker: Any) -> bool:
        """Return whether the tasks of a worker are expected to finish.

        Tasks that have seceded often wait for others until the end of a run.
        """
        is_member = bool(worker.resources.get(self._partition))
        return is_member and not worker.long_running and not worker.actors

    def _step(self, job: str) -> bool:
        """Move tasks off a job's workers, and return whether neither tasks nor results are left."""
        drain = self._drains[job]
        for worker in drain.workers:
            # A worker that Dask pauses and resumes because of its memory accepts tasks again.
            stop_assigning(self._scheduler, worker)
            hand_off_tasks(self._scheduler, worker, {self._partition}, drain.requested_moves)
        if any(worker.processing for worker in drain.workers):
            drain.finished_at = None
            return False
        if all(holds_nothing(self._scheduler, worker) for worker in drain.workers):
            return True
        now = time.monotonic()
        drain.finished_at = drain.finished_at or now
        if drain.copying is None or drain.copying.done():
            if now - drain.finished_at >= COPY_TIMEOUT_S:
                self._kept_until[job] = now + RETRY_AFTER_S
                self._resume(job)
            else:
                copy = copy_results(self._scheduler, drain.workers, self._partition)
                drain.copying = asyncio.ensure_future(copy)
        return False

    def _resume(self, job: str) -> None:
        """Assign tasks to the workers of a job again."""
        for worker in self._drains.pop(job).workers:
            resume_assigning(self._scheduler, worker)


def _count_tasks(workers: Sequence[Any]) -> int:
    return sum(len(worker.processing) for worker in workers)
