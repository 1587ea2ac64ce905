"""Let LIDAR workers write the jobs of a data set, and the files of multi-file formats."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from distributed import Reschedule

from lidarfiles.clouds.multi_file_format import PieceRange, RangeWriter
from lidarfiles.clouds.multi_file_format import WrittenRange as Range
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.identity.versions import plugin_versions
from lidarfiles.parts.parts import StoredCloud
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import TEMPORARY, Storage
from lidarsim.sweeps.sweeps import Sweeps
from poolpart.fetch import fetch_available
from poolpart.task_context import own_client

from .cluster.cluster import Cluster
from .cluster.tasks import TaskGroup
from .pipeline.casting_workers import submit_value
from .pipeline.failures import JobError, raise_if_failed, was_killed
from .pipeline.stage_names import EXPORT, LIDAR
from .pipeline.task_records import Recorder, TaskRecord
from .run_result import RunResult
from .store.run_store import RunStore

if TYPE_CHECKING:
    from lidarfiles.datasets.dataset import DataSet

TASKS_PER_SLOT = 2  # submitted tasks per free slot of LIDAR
MAX_JOBS_PER_TASK = 32
MAX_POINTS_PER_TASK = 1_000_000  # maximum total number of points in the jobs of a task
GATHER_S = 0.25  # time that a job waits for further jobs to share its task
MAX_STALL_S = 10.0  # time without progress after which the driver writes jobs itself


class WriteRequest(NamedTuple):
    """Request to write a job's files, with the arguments of `DataSet.write_job`."""

    row: JobRow  # table row without point counts
    cloud: StoredCloud
    sweeps: Sweeps
    input_files: Sequence[Sequence[str]]


JobOutcome = JobRow | LidarError


Probe = tuple[Storage, str, bytes]  # storage, and the name and content of a file in this storage


def write_jobs(
    dataset: DataSet, probes: Sequence[Probe], jobs: Sequence[WriteRequest]
) -> tuple[list[JobOutcome] | None, TaskRecord]:
    """Write the files of jobs on a LIDAR worker.

    Parameters
    ----------
    dataset
        Data set that the jobs are written to.
    probes
        Files in the data set and in the parts folder, which show whether the worker can access
        these locations.
    jobs
        Jobs to write.

    Returns
    -------
    The table row or the error of each job, and the record of the task, which counts scans. The rows
    are None if the worker cannot access both locations.
    """
    recorder = Recorder(EXPORT, LIDAR)
    if not all(storage.has_content(name, content) for storage, name, content in probes):
        return None, recorder.finish()
    outcomes = [_write_job(dataset, job) for job in jobs]
    scan_count = sum(int(job.sweeps.scans[-1]) for job in jobs)  # entry -1 is the number of scans
    return outcomes, recorder.finish(scan_count)


def _write_job(dataset: DataSet, job: WriteRequest) -> JobOutcome:
    """Write the files of a job, and return its table row.

    If this fails, return a LidarError for a storage error, or a JobError for any other error.
    """
    from lidarfiles.datasets.dataset import (
        Listing,  # imported late, because surveys write no data set
    )

    listing = Listing.from_storage(dataset.storage)
    try:
        return dataset.write_job(*job, listing=listing)
    except Exception as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        message = str(error) if isinstance(error, LidarError) else repr(error)
        if isinstance(cause, OSError):  # for example a full disk, which affects all jobs
            name = "" if isinstance(error, LidarError) else f"job {job.row.name}: "
            return LidarError(f"{name}{message}")
        with suppress(OSError):
            listing.prune(listing.files)
        return JobError(message)


class DataSetWriter:
    """Writer that lets LIDAR workers write jobs to a data set.

    Workers that cannot access the parts or the data set write no jobs. The driver writes their jobs
    instead.

    Parameters
    ----------
    tasks
        Tasks of the LIDAR partition.
    dataset
        Data set to write to.
    store
        Store of the run.
    parts_probe
        Name and content of a file in the parts folder, with which workers check their access.
    """

    def __init__(
        self,
        tasks: TaskGroup[list[WriteRequest]],
        dataset: DataSet,
        store: RunStore,
        parts_probe: tuple[str, bytes],
    ) -> None:
        self.tasks = tasks
        storage = dataset.storage
        mark = store.db.meta["mark"]
        self.dataset = replace(dataset, made_with=store.made_with)
        # Later writers remove temporary files, so the file of a killed run does not remain.
        self._probe_name = f"{TEMPORARY}dataset-{mark[:8]}"
        dataset_probe = storage, self._probe_name, mark.encode()
        self._probes: Sequence[Probe] = (dataset_probe, (store.storage, *parts_probe))
        with explain_os_errors(f"{storage} cannot be written"):
            storage.prepare()
            storage.write(self._probe_name, mark.encode())
        self._waiting = deque[WriteRequest]()
        self._due_at = 0.0  # monotonic time at which the waiting jobs are written
        self._driver_writes: dict[Future[JobOutcome], WriteRequest] = {}
        self._thread = ThreadPoolExecutor(1, "write")
        self._moved_at = time.monotonic()
        self.hidden = False  # True if a worker could not access the data set or the parts

    @property
    def jobs(self) -> Iterator[JobRow]:
        """Table rows of the jobs that wait to be written or are being written."""
        yield from (job.row for jobs in self.tasks.running.values() for job in jobs)
        yield from (job.row for job in (*self._driver_writes.values(), *self._waiting))

    def queue_job(self, files: WriteRequest) -> None:
        """Queue a job for writing."""
        if not self._waiting:
            self._due_at = time.monotonic() + GATHER_S
        self._waiting.append(files)

    def step(self, slots: int, *, more_to_come: bool) -> list[tuple[WriteRequest, JobOutcome]]:
        """Submit waiting jobs to free slots, and return the jobs that have ended.

        Parameters
        ----------
        slots
            Number of free slots.
        more_to_come
            Whether further jobs will be added. If so, jobs wait a moment to share a task.

        Returns
        -------
        Ended jobs with their table rows or errors. A JobError affects a single job. Other errors
        are caused by the storage or by the software of a worker.
        """
        due = (
            not more_to_come
            or len(self._waiting) >= MAX_JOBS_PER_TASK
            or time.monotonic() >= self._due_at
        )
        while due and self._waiting and len(self.tasks.running) < TASKS_PER_SLOT * slots:
            jobs = self._next()
            arguments = self.dataset, self._probes, jobs
            self.tasks.submit(jobs, write_jobs, *arguments, priority=5)
        ended: list[tuple[WriteRequest, JobOutcome]] = []
        for jobs, outcomes in self.tasks.pop_finished():
            if outcomes is None:
                self.hidden = True
                self._write_here(jobs)
            else:
                ended += zip(jobs, outcomes, strict=True)
        for jobs, future in self.tasks.pop_failed():
            if was_killed(future):
                self._write_here(jobs)
                continue
            try:
                raise_if_failed(future, "writing it")
            except LidarError as error:
                ended += [(job, error) for job in jobs]
        for write in [write for write in self._driver_writes if write.done()]:
            ended.append((self._driver_writes.pop(write), write.result()))
        self._write_stalled_jobs(bool(ended))
        return ended

    def _next(self) -> list[WriteRequest]:
        """Remove and return the jobs of the next task."""
        jobs = [self._waiting.popleft()]
        points = len(jobs[0].cloud)
        while self._waiting and len(jobs) < MAX_JOBS_PER_TASK:
            points += len(self._waiting[0].cloud)
            if points > MAX_POINTS_PER_TASK:
                break
            jobs.append(self._waiting.popleft())
        return jobs

    def _write_stalled_jobs(self, moved: bool) -> None:
        """Let the driver write jobs if no task has started for a long time.

        This happens if all slots of LIDAR are in use by other runs or have left.
        """
        now_s = time.monotonic()
        if moved or self._driver_writes or not self.tasks.running:
            self._moved_at = now_s
        elif now_s - self._moved_at > MAX_STALL_S:
            self._moved_at = now_s
            locations = self.tasks.locate()
            if any(
                location.started and not locations.is_unreachable(key)
                for key, location in locations.tasks.items()
            ):
                return
            future, jobs = self.tasks.running.popitem()
            future.cancel()
            self._write_here(jobs)

    def _write_here(self, jobs: Sequence[WriteRequest]) -> None:
        self._driver_writes |= {
            self._thread.submit(_write_job, self.dataset, job): job for job in jobs
        }

    def close(self) -> None:
        """Cancel all writing."""
        with suppress(Exception):  # the first error is reported instead
            self.tasks.cancel()
        self._thread.shutdown(cancel_futures=True)
        with suppress(OSError):
            self.dataset.storage.remove([self._probe_name])


LOOK_EVERY_S = 0.01
FETCH_S = 1.0
ENDS_S = 10.0  # time limit for ranges that are still being written when the writer is stopped


class LidarWorkers:
    """LIDAR workers that write ranges of files."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._tasks = cluster.tasks(LIDAR)

    def __call__(self, writer: RangeWriter, spans: Sequence[PieceRange]) -> dict[PieceRange, Range]:
        """Write ranges of files on workers.

        If a worker dies, its range is written by another worker.

        Returns
        -------
        Results of the ranges, except for those whose workers cannot access the folder.

        Raises
        ------
        LidarError
            If a worker cannot write, if several workers die while writing the same range, or if
            LIDAR has no workers for too long.
        """
        partition = self._tasks.partition
        running = self._tasks.running
        self._tasks.plugins = plugin_versions(writer.plugins)
        waiting = deque(spans)
        max_tasks = 2 * partition.slots
        written: dict[PieceRange, Range] = {}
        watch = self._cluster.watch([LIDAR])
        # Workers fetch the writer from the worker that holds it. If it were an argument of the
        # tasks, Dask would send all tasks to that worker.
        shared = submit_value(partition, writer, priority=10)
        try:
            while waiting or running:
                while waiting and len(running) < max_tasks:
                    span = waiting.popleft()
                    self._tasks.submit(span, _write_range, shared.key, span)
                for future in (shared, *running):
                    raise_if_failed(future, f"Writing {writer.storage}")
                finished = self._tasks.pop_finished()
                written |= {
                    span: written_range
                    for span, written_range in finished
                    if written_range is not None
                }
                watch.check()
                if not finished:
                    time.sleep(LOOK_EVERY_S)
        except OSError as error:
            raise LidarError(f"The cluster was lost while writing {writer.storage}.") from error
        finally:
            if running:
                writer.stop()
                deadline = time.monotonic() + ENDS_S
                while any(f.status == "pending" for f in running) and time.monotonic() < deadline:
                    time.sleep(LOOK_EVERY_S)
                running.clear()
        return written

    def with_range_tasks(self, result: RunResult) -> RunResult:
        """Return a copy of a result that includes the tasks that wrote ranges of files."""
        return replace(result, stages=(*result.stages, *self._tasks.book.stages.values()))


@lru_cache(maxsize=1)
def _fetch_writer(key: str) -> RangeWriter:
    """Fetch the writer, which this process caches for all ranges.

    Dask recreates the writer if the worker that holds it has died.
    """
    deadline = time.monotonic() + FETCH_S
    while not (results := fetch_available(own_client(), [key])):
        if time.monotonic() > deadline:
            raise Reschedule  # the task that recreates the writer requires a slot
        time.sleep(LOOK_EVERY_S)
    writer: RangeWriter = results[key]
    return writer


def _write_range(key: str, span: PieceRange) -> tuple[Range | None, TaskRecord]:
    """Write a range on a worker, and return its result with the record of the task."""
    recorder = Recorder(EXPORT, LIDAR)
    with explain_os_errors(f"The worker {recorder.finish().worker} cannot write the output"):
        written_range = _fetch_writer(key)(span)
    return written_range, recorder.finish(span[1] - span[0])
