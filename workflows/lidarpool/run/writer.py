"""LIDAR workers that write jobs into a data set, several small ones at a time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future as Done
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from distributed import Client, Future

from poolpart import Partition, Recorder, TaskRecord, fetch_available, look_for_tasks

from ..base.errors import LidarpoolError
from ..base.software import call_alike
from ..columns.parts import StoredCloud
from ..export.dataset import DataSet, Listing
from ..export.jobs import JobRow
from ..export.sweeps import Sweeps
from ..pipeline import EXPORT, LIDAR, JobError
from ..pipeline.failures import raise_if_failed, was_killed
from ..pipeline.task_book import TaskBook

WRITING = 2  # tasks that wait to be done, for each free slot of LIDAR
TOGETHER, TOGETHER_POINTS = 32, 1_000_000  # jobs that one task writes, and their points
BEGIN_S = 10.0  # for any job to begin to be written; then the driver writes one


class JobFiles(NamedTuple):
    """What the files of a job are made of; `row` lacks what is counted of the points."""

    row: JobRow
    cloud: StoredCloud
    sweeps: Sweeps
    made_of: Sequence[Sequence[str]]


Written = JobRow | LidarpoolError


def write_jobs(
    dataset: DataSet, probes: tuple[Any, Any], jobs: Sequence[JobFiles]
) -> tuple[list[Written] | None, TaskRecord]:
    """Write the files of jobs on a LIDAR worker; a row of each, or why it cannot be made.

    None in place of the rows if the worker does not see the data set, or the parts.
    """
    recorder = Recorder(EXPORT, LIDAR)
    (place, *probe), (parts, *other) = probes
    if not place.sees(*probe) or not parts.sees(*other):
        return None, recorder.done()
    written = [_written(dataset, job) for job in jobs]
    return written, recorder.done(sum(int(job.sweeps.scans[-1]) for job in jobs))


def _written(dataset: DataSet, job: JobFiles) -> Written:
    """Write a job; JobError if that fails, LidarpoolError if it is because of the place."""
    listing = Listing.of(dataset.place)
    try:
        return dataset.write_job(*job, listing=listing)
    except Exception as error:
        why = error if isinstance(error, OSError) else error.__cause__
        told = str(error) if isinstance(error, LidarpoolError) else repr(error)
        if isinstance(why, OSError):  # a full disk fails all jobs
            name = "" if isinstance(error, LidarpoolError) else f"job {job.row.name}: "
            return LidarpoolError(f"{name}{told}")
        with suppress(OSError):
            listing.prune(listing.files)
        return JobError(told)


@dataclass(eq=False)
class JobWriter:
    """Has LIDAR workers write jobs into the data set; what they cannot see is written here."""

    client: Client
    partition: Partition
    dataset: DataSet
    probes: tuple[Any, Any]
    sources: str
    book: TaskBook = field(default_factory=TaskBook)
    waiting: deque[JobFiles] = field(default_factory=deque)
    writing: dict[Future, list[JobFiles]] = field(default_factory=dict)
    here: dict[Done[Written], JobFiles] = field(default_factory=dict)
    hidden: bool = False  # whether a worker did not see the data set
    _thread: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "write"))
    _moved_at: float = field(default_factory=time.monotonic)

    @property
    def jobs(self) -> Iterator[JobRow]:
        """Jobs that wait or are being written."""
        yield from (job.row for jobs in self.writing.values() for job in jobs)
        yield from (job.row for job in (*self.here.values(), *self.waiting))

    def step(self, slots: int) -> list[tuple[JobFiles, Written]]:
        """Submit what there is room for; returns the rows of jobs, or why they were not written.

        Errors of single jobs are JobErrors; others are of the place, or of a worker's software.
        """
        while self.waiting and len(self.writing) < WRITING * slots:
            jobs = self._next()
            future = self.partition.submit(
                call_alike, self.sources, write_jobs, self.dataset, self.probes, jobs, priority=5
            )
            self.writing[future] = jobs
        ended: list[tuple[JobFiles, Written]] = []
        done = {f.key: f for f in self.writing if f.status == "finished"}
        for key, (rows, record) in fetch_available(self.client, [*done]).items() if done else ():
            jobs = self.writing.pop(done[key])
            self.book.add(record)
            if rows is None:
                self.hidden = True
                self._write_here(jobs)
            else:
                ended += zip(jobs, rows, strict=True)
        for future in [f for f in self.writing if f.status not in ("pending", "finished")]:
            jobs = self.writing.pop(future)
            if future.status == "error" and was_killed(future):
                self._write_here(jobs)
                continue
            try:
                raise_if_failed(future, "writing it")
                self.waiting += jobs  # lost: it is done again
            except LidarpoolError as error:
                ended += [(job, error) for job in jobs]
        for result in [one for one in self.here if one.done()]:
            ended.append((self.here.pop(result), result.result()))
        self._relieve(bool(ended))
        return ended

    def _next(self) -> list[JobFiles]:
        """Take the jobs of the next task."""
        jobs = [self.waiting.popleft()]
        points = len(jobs[0].cloud)
        while self.waiting and len(jobs) < TOGETHER:
            points += len(self.waiting[0].cloud)
            if points > TOGETHER_POINTS:
                break
            jobs.append(self.waiting.popleft())
        return jobs

    def _relieve(self, moved: bool) -> None:
        """Write jobs here if none has begun for long: all slots are held, or have gone."""
        now = time.monotonic()
        if moved or self.here or not self.writing:
            self._moved_at = now
        elif now - self._moved_at > BEGIN_S:
            self._moved_at = now
            keys = [future.key for future in self.writing]
            seen = look_for_tasks(self.client, self.partition.name, keys)
            if any(at.started and not seen.out_of_reach(key) for key, at in seen.tasks.items()):
                return
            future = next(iter(self.writing))
            jobs = self.writing.pop(future)
            future.cancel()
            self._write_here(jobs)

    def _write_here(self, jobs: Sequence[JobFiles]) -> None:
        self.here |= {self._thread.submit(_written, self.dataset, job): job for job in jobs}

    def close(self) -> None:
        """Write nothing more."""
        with suppress(Exception):  # report the first error
            self.client.cancel([*self.writing])
        self._thread.shutdown(cancel_futures=True)
