"""LIDAR workers that write: jobs into a data set, and ranges of formats of many files."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

from distributed import Reschedule

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import TEMPORARY
from lidarsim.sweeps.sweeps import Sweeps
from poolpart.fetch import fetch_available
from poolpart.task_context import own_client

from ..base.software import plugin_versions
from ..columns.parts import StoredCloud
from ..datasets.dataset import DataSet, Listing
from ..datasets.job_table import JobRow
from ..export.pieces import PieceRange, RangeWriter
from ..export.pieces import WrittenRange as Range
from .cluster.cluster import Cluster
from .cluster.tasks import Tasks
from .pipeline.casting_workers import share
from .pipeline.failures import JobError, raise_if_failed, was_killed
from .pipeline.names import EXPORT, LIDAR
from .pipeline.placement import Recorder, TaskRecord
from .run_result import RunResult
from .store.run_store import RunStore

WRITING = 2  # tasks that wait to be done, for each free slot of LIDAR
# jobs that one task writes, and their points
TOGETHER = 32
TOGETHER_POINTS = 1_000_000
GATHER_S = 0.25  # that a job waits for others to be written with
BEGIN_S = 10.0  # for any job to begin to be written; then the driver writes one


class JobFiles(NamedTuple):
    """What the files of a job are made of; `row` lacks what is counted of the points."""

    row: JobRow
    cloud: StoredCloud
    sweeps: Sweeps
    made_of: Sequence[Sequence[str]]


JobOutcome = JobRow | LidarError


def write_jobs(
    dataset: DataSet, probes: tuple[Any, Any], jobs: Sequence[JobFiles]
) -> tuple[list[JobOutcome] | None, TaskRecord]:
    """Write the files of jobs on a LIDAR worker; a row of each, or why it cannot be made.

    None in place of the rows if the worker does not see the data set, or the parts.
    """
    recorder = Recorder(EXPORT, LIDAR)
    if not all(place.sees(*probe) for place, *probe in probes):
        return None, recorder.finish()
    written = [_written(dataset, job) for job in jobs]
    return written, recorder.finish(sum(int(job.sweeps.scans[-1]) for job in jobs))


def _written(dataset: DataSet, job: JobFiles) -> JobOutcome:
    """Write a job; JobError if that fails, LidarError if it is because of the place."""
    listing = Listing.of(dataset.place)
    try:
        return dataset.write_job(*job, listing=listing)
    except Exception as error:
        why = error if isinstance(error, OSError) else error.__cause__
        told = str(error) if isinstance(error, LidarError) else repr(error)
        if isinstance(why, OSError):  # a full disk fails all jobs
            name = "" if isinstance(error, LidarError) else f"job {job.row.name}: "
            return LidarError(f"{name}{told}")
        with suppress(OSError):
            listing.prune(listing.files)
        return JobError(told)


class JobWriter:
    """Has LIDAR workers write jobs into a data set; what they cannot see is written here.

    `of_parts` is a file among the parts of the `store`, name and content: who does not see it, or
    another in the data set, writes nothing.
    """

    def __init__(
        self,
        tasks: Tasks[list[JobFiles]],
        dataset: DataSet,
        store: RunStore,
        of_parts: tuple[str, bytes],
    ) -> None:
        self.tasks = tasks
        place = dataset.place
        mark = store.db.meta["mark"]
        self.dataset = replace(dataset, made_with=store.made_with)
        # What a killed run leaves of it is removed as that of any killed writer.
        probe = (f"{TEMPORARY}dataset-{mark[:8]}", mark.encode())
        self._probes = (place, *probe), (store.storage, *of_parts)
        with explained(f"{place} cannot be written"):
            place.prepare()
            place.write(*probe)
        self._waiting = deque[JobFiles]()
        self._due_at = 0.0  # when those that wait are to be written
        self._here: dict[Future[JobOutcome], JobFiles] = {}
        self._thread = ThreadPoolExecutor(1, "write")
        self._moved_at = time.monotonic()
        self.hidden = False  # whether a worker did not see the data set

    @property
    def jobs(self) -> Iterator[JobRow]:
        """Jobs that wait or are being written."""
        yield from (job.row for jobs in self.tasks.running.values() for job in jobs)
        yield from (job.row for job in (*self._here.values(), *self._waiting))

    def add(self, files: JobFiles) -> None:
        """Have a job written soon."""
        if not self._waiting:
            self._due_at = time.monotonic() + GATHER_S
        self._waiting.append(files)

    def step(self, slots: int, *, more: bool) -> list[tuple[JobFiles, JobOutcome]]:
        """Submit what there is room for; returns the rows of jobs, or why they were not written.

        Jobs wait a moment for others if there are `more` to come. Errors of single jobs are
        JobErrors; others are of the place, or of a worker's software.
        """
        due = not more or len(self._waiting) >= TOGETHER or time.monotonic() >= self._due_at
        while due and self._waiting and len(self.tasks.running) < WRITING * slots:
            jobs = self._next()
            arguments = self.dataset, self._probes, jobs
            self.tasks.submit(jobs, write_jobs, *arguments, priority=5)
        ended: list[tuple[JobFiles, JobOutcome]] = []
        for jobs, rows in self.tasks.take_done():
            if rows is None:
                self.hidden = True
                self._write_here(jobs)
            else:
                ended += zip(jobs, rows, strict=True)
        for jobs, future in self.tasks.take_failed():
            if was_killed(future):
                self._write_here(jobs)
                continue
            try:
                raise_if_failed(future, "writing it")
            except LidarError as error:
                ended += [(job, error) for job in jobs]
        for result in [one for one in self._here if one.done()]:
            ended.append((self._here.pop(result), result.result()))
        self._relieve(bool(ended))
        return ended

    def _next(self) -> list[JobFiles]:
        """Take the jobs of the next task."""
        jobs = [self._waiting.popleft()]
        points = len(jobs[0].cloud)
        while self._waiting and len(jobs) < TOGETHER:
            points += len(self._waiting[0].cloud)
            if points > TOGETHER_POINTS:
                break
            jobs.append(self._waiting.popleft())
        return jobs

    def _relieve(self, moved: bool) -> None:
        """Write jobs here if none has begun for long: all slots are held, or have gone."""
        now = time.monotonic()
        if moved or self._here or not self.tasks.running:
            self._moved_at = now
        elif now - self._moved_at > BEGIN_S:
            self._moved_at = now
            seen = self.tasks.look()
            if any(at.started and not seen.out_of_reach(key) for key, at in seen.tasks.items()):
                return
            future, jobs = self.tasks.running.popitem()
            future.cancel()
            self._write_here(jobs)

    def _write_here(self, jobs: Sequence[JobFiles]) -> None:
        self._here |= {self._thread.submit(_written, self.dataset, job): job for job in jobs}

    def close(self) -> None:
        """Write nothing more."""
        with suppress(Exception):  # report the first error
            self.tasks.cancel()
        self._thread.shutdown(cancel_futures=True)
        place, name, _ = self._probes[0]
        with suppress(OSError):
            place.remove([name])


LOOK_EVERY_S = 0.01
FETCH_S = 1.0
ENDS_S = 10.0  # for ranges that are being written when the others are stopped


class LidarWorkers:
    """Has the workers of LIDAR write ranges of files."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._tasks = cluster.tasks(LIDAR)

    def __call__(self, writer: RangeWriter, spans: Sequence[PieceRange]) -> dict[PieceRange, Range]:
        """Write ranges; returns what was written of those whose workers see the folder.

        The range of a worker that dies is written by another. LidarError if one cannot write,
        several die of a range, or there is none for too long.
        """
        partition = self._tasks.partition
        running = self._tasks.running
        self._tasks.plugins = plugin_versions(writer.plugins)
        waiting = deque(spans)
        most = 2 * partition.slots
        written: dict[PieceRange, Range] = {}
        watch = self._cluster.watch([LIDAR])
        # Workers fetch it from the one that has it: as an argument of the tasks it would make Dask
        # send them all to that worker.
        shared = share(partition, writer, priority=10)
        try:
            while waiting or running:
                while waiting and len(running) < most:
                    span = waiting.popleft()
                    self._tasks.submit(span, _write_range, shared.key, span)
                for future in (shared, *running):
                    raise_if_failed(future, f"Writing {writer.place}")
                done = self._tasks.take_done()
                written |= {span: made for span, made in done if made is not None}
                watch.look()
                if not done:
                    time.sleep(LOOK_EVERY_S)
        except OSError as error:
            raise LidarError(f"The cluster was lost while it wrote {writer.place}.") from error
        finally:
            if running:
                writer.stop()
                until = time.monotonic() + ENDS_S
                while any(f.status == "pending" for f in running) and time.monotonic() < until:
                    time.sleep(LOOK_EVERY_S)
                running.clear()
        return written

    def recorded(self, result: RunResult) -> RunResult:
        """Return a result with the tasks that wrote ranges."""
        return replace(result, stages=(*result.stages, *self._tasks.book.stages.values()))


@lru_cache(maxsize=1)
def _fetched(key: str) -> RangeWriter:
    """Fetch the writer once for all ranges; it is made again if its worker has died.

    As an argument of the tasks, Dask would run them only on workers that hold it.
    """
    until = time.monotonic() + FETCH_S
    while not (found := fetch_available(own_client(), [key])):
        if time.monotonic() > until:
            raise Reschedule  # what makes it again needs a slot
        time.sleep(LOOK_EVERY_S)
    writer: RangeWriter = found[key]
    return writer


def _write_range(key: str, span: PieceRange) -> tuple[Range | None, TaskRecord]:
    """Write a range on a worker."""
    recorder = Recorder(EXPORT, LIDAR)
    with explained(f"the worker {recorder.finish().worker} cannot write there"):
        made = _fetched(key)(span)
    return made, recorder.finish(span[1] - span[0])
