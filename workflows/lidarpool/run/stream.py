"""Streams of sweeps that a campaign delivers without writing files.

A stream replaces stages 1 and 4 of the pipeline. It passes the scans of the next sweeps to a
`Dispatcher`, which offers them to workers and offers them again if workers die. The stream then
fetches the columns from the workers that cast the scans.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from distributed import Client

from lidarfiles.clouds.boxes import Boxes
from lidarfiles.clouds.job_reader import PointColumns
from lidarfiles.clouds.kitti import kitti_intensity
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.datasets.sweep_data import is_compensated, sweep_of_job
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.campaign.campaign_sections import DatasetFormat
from lidarscenario.empty_cloud import empty_cloud_reason
from lidarscenario.job import Job
from lidarsim.casting.scene_caster import check_backend_here
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.part_columns import PartColumns
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import AXES, SCAN
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError, message_of
from lidarsim.simulator.memory import MB, scans_that_fit
from lidarsim.sweeps.sweeps import Sweeps
from poolpart import Partition, PoolError
from poolpart.fetch import fetch_available

from .cluster.checks import check_workers, find_workers
from .cluster.cluster import open_client
from .cluster.watch import WaitTimer, Watch
from .job_source import JobProducer
from .options import RunOptions
from .pipeline.casting_workers import CastingWorkers
from .pipeline.committed_results import CommittedResults
from .pipeline.dispatch import Dispatcher
from .pipeline.failures import JobError
from .pipeline.pipeline_job import PipelineJob
from .pipeline.stage_messages import CollectOrder, ColumnsLost, Receipt
from .pipeline.stage_names import GPU
from .progress import Screen

PAUSE_S = 0.005  # polling interval while the next sweep is being cast
_READER = "reader"  # name of the stream, which is the only collector of its dispatcher

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SweepStream:
    """Sweeps of a campaign's jobs, which are cast while they are being read.

    Each iteration casts all sweeps again, with the same result. When an iteration ends, its tasks
    are canceled, and the workers that it has started are stopped. A pickled copy connects to the
    scheduler of the client. In a task on that cluster, it uses the client of the task's worker.
    """

    campaign: CampaignSpec
    numbers: Sequence[int]  # numbers of the jobs
    ahead: int  # maximum number of sweeps that are being cast or are ready to be read
    options: RunOptions

    def __getstate__(self) -> dict[str, Any]:
        options = self.options
        if (client := options.client) is not None:
            address = getattr(client.scheduler, "address", "")
            options = replace(options, client=None, scheduler=address)
        return self.__dict__ | {"options": options}

    def of_jobs(self, numbers: Sequence[int]) -> SweepStream:
        """Return a stream of only the given jobs."""
        return replace(self, numbers=numbers)

    def __iter__(self) -> Generator[Sweep]:
        options = self.options
        screen = Screen()
        if options.starts_workers:
            check_backend_here(options.backend)
        waiting = WaitTimer(options.startup_timeout_s, screen.report)
        with open_client(options, {GPU: 1}, waiting, screen) as client:
            try:
                with closing(_Casting(self, client, waiting)) as casting:
                    yield from casting.sweeps()
            except Exception as error:  # Dask raises various errors if the cluster is lost
                if client.status == "running" and not isinstance(error, (PoolError, OSError)):
                    raise
                raise LidarError(f"The stream lost its cluster: {message_of(error)}") from error

    def torch(self, transform: Callable[[Sweep], Any] | None = None) -> Any:
        """Return a `torch.utils.data.IterableDataset` of the sweeps, ordered by job.

        The DataLoader must have ``num_workers=0``, because the cluster already prepares sweeps in
        advance. If torch.distributed is initialized when the loader starts, each rank receives the
        same number of jobs.

        Parameters
        ----------
        transform
            Function that converts a sweep to an item, as for `SavedSweeps.torch`.

        Raises
        ------
        LidarError
            If torch is not installed, or if the method is called in a worker of a DataLoader.
        """
        if find_spec("torch") is None:
            raise LidarError(f"`torch` requires PyTorch. Run {install_command('torch')}.")
        from lidarfiles.datasets.torch_sweeps import TorchStream

        return TorchStream(self, transform)


@dataclass(eq=False)
class _StreamedSweeps:
    """Sweeps of a job that are being cast, and the columns that have already been fetched."""

    job: Job
    keep: DatasetFormat  # data set format of the campaign, which determines the points
    casting: PipelineJob
    columns: dict[int, PartColumns] = field(default_factory=dict)  # {first scan: batch}
    sweeps_begun: int = 0  # number of sweeps that have been passed to the dispatcher
    points_read: int = 0

    def pop(self, number: int) -> Sweep | None:
        """Remove and return a sweep, or return None if not all of its scans have been cast."""
        job = self.job
        survey = job.survey
        sweeps = job.sweeps
        scan, stop = sweeps.scans[number : number + 2].tolist()
        parts = []
        while scan < stop:
            if (part := self.columns.get(scan)) is None:
                return None
            parts.append(part)
            scan = part.stop
        for part in parts:
            del self.columns[part.first]
        origin = job.scene.origin if survey.coordinates == "world" else np.zeros(3)
        # The table has the same columns as a `StoredCloud`.
        stored = [c for c in survey.stored_columns if c not in AXES and c.name != WAVEFORM]
        table = (SCAN, *stored)
        cloud = Cloud.concatenate([part.cloud(table, survey.precision_m, origin) for part in parts])
        self.points_read += len(cloud)
        if self.keep.compensated_actors:
            cloud = sweeps.with_actors_at_start(number, cloud)
        compensated = is_compensated(self.keep.export_spec, sweeps.coordinates)
        points = _points_in_sensor(sweeps, number, cloud, compensated=compensated)
        if self.keep.format == "kitti":  # files in this format have a different intensity
            points[1]["intensity"] = kitti_intensity(cloud)
        if survey.actor_visibility:
            sweeps = sweeps.with_actor_rays(part.actor_rays for part in parts)
        boxes = Boxes.from_points(sweeps, number, cloud) if sweeps.actors else None
        boxes = boxes and boxes.to_sensor_frame(sweeps.pose, number)
        row = JobRow(job.number, job.name, job.split, job.values)
        return sweep_of_job(row, sweeps, number, points, boxes, compensated=compensated)


def _points_in_sensor(
    sweeps: Sweeps, number: int, cloud: Cloud, *, compensated: bool
) -> PointColumns:
    """Return the points of a sweep in the sensor frame, with all of their columns."""
    if compensated:
        positions = sweeps.compensate_motion(number, cloud)
        columns = sweeps.columns_compensated(number, cloud)
    else:
        positions = sweeps.in_sensor(number, cloud.positions)
        columns = sweeps.columns_in_sensor(number, cloud)
    return positions.astype(np.float32), {name: np.array(columns[name]) for name in columns}


class _Casting:
    """Single iteration over a stream, during which the stream's sweeps are cast."""

    def __init__(self, stream: SweepStream, client: Client, waiting: WaitTimer) -> None:
        self._stream = stream
        self._client = client
        options = stream.options
        workers = find_workers(client, {GPU: 1}, options.backend, waiting=waiting)
        self._workers = workers.casting
        self._backend = workers.backend
        partition = Partition(GPU, client)
        run = uuid.uuid4().hex[:8]
        self._casting = CastingWorkers(partition, run, workers.backend, workers.software)
        self._dispatcher = Dispatcher(self._casting, collector_count=1, mark="")
        self._watch = Watch(client, [GPU], (), options.worker_timeout_s)
        columns = stream.campaign.keep.export_spec.added
        self._maker = JobProducer(stream.campaign, stream.numbers, columns)
        self._jobs: dict[int, _StreamedSweeps] = {}  # {job number: sweeps}
        self._next: _StreamedSweeps | None = None  # job with sweeps that have not been begun yet
        self._in_flight = deque[tuple[_StreamedSweeps, int]]()  # sweeps that are being cast
        self._warned = False  # True after a warning about a job without points

    def sweeps(self) -> Generator[Sweep]:
        """Yield the sweeps in order."""
        while not (self._maker.ended and self._next is None and not self._in_flight):
            self._step()
            streamed, number = self._in_flight[0] if self._in_flight else (None, 0)
            if streamed is None or (sweep := streamed.pop(number)) is None:
                time.sleep(PAUSE_S)
                continue
            self._in_flight.popleft()
            if number + 1 == len(streamed.job.sweeps):
                self._end(streamed)
                self._warn_if_empty(streamed)
            yield sweep

    def close(self) -> None:
        """Stop casting, and release the workers."""
        self._maker.close()
        for streamed in [*self._jobs.values()]:
            self._end(streamed)
        if self._client.status == "running":
            self._client.cancel(self._casting.futures)
            self._casting.release()

    def _step(self) -> None:
        """Begin, cast and fetch sweeps as far as this is possible without waiting."""
        self._begin_sweeps()
        self._dispatcher.check()
        if (locations := self._casting.refresh()) is not None:
            scan_count = sum(map(len, self._dispatcher.batches.values()))
            self._casting.request_slots(self._dispatcher.slots_wanted(scan_count))
            self._dispatcher.reclaim_lost(locations)
        for job, error in [*self._dispatcher.failed.items()]:
            failed = self._jobs[job.number]
            self._end(failed)
            self._in_flight = deque(coming for coming in self._in_flight if coming[0] is not failed)
            self._next = None if self._next is failed else self._next
            self._warn_of_failure(failed.job.name, error)
        orders = self._dispatcher.assign({_READER: ""})
        self._fetch(orders.get(_READER, ()))
        self._dispatcher.offer()
        self._watch.check()

    def _begin_sweeps(self) -> None:
        """Begin more sweeps until `ahead` sweeps are in flight."""
        while len(self._in_flight) < self._stream.ahead and (self._next or self._begin_job()):
            if (streamed := self._next) is not None:  # None if the job has failed
                number = streamed.sweeps_begun
                sweeps = streamed.job.sweeps
                self._dispatcher.add_scans(
                    streamed.casting, *sweeps.scans[number : number + 2].tolist()
                )
                self._in_flight.append((streamed, number))
                streamed.sweeps_begun += 1
                if streamed.sweeps_begun == len(sweeps):
                    self._next = None

    def _begin_job(self) -> bool:
        """Begin the next job unless it fails, and return False if no job is ready."""
        if (entry := self._maker.pop()) is None:
            return False
        if isinstance(entry, JobRow):
            self._warn_of_failure(entry.name, entry.error)
            return True
        job = entry
        options = self._stream.options
        try:
            check_workers(job, options, self._backend, self._workers)
            _, scene_name = self._casting.register_job(job.number, job.scene, job.survey)
        except JobError as error:
            self._warn_of_failure(job.name, error)
            return True
        limit = options.batch_mb * MB
        on_device = self._backend == "cuda"
        scan_count = job.survey.scan_count
        casting = PipelineJob(
            committed=CommittedResults(job.number, range(scan_count)),  # remains empty
            run=self._casting.run,
            scene_name=scene_name,
            scans_per_task=scans_that_fit(job.scene, job.survey, limit, on_device=on_device),
            scans_of_run=scan_count,
        )
        self._next = _StreamedSweeps(job, self._stream.campaign.keep, casting)
        self._jobs[job.number] = self._next
        return True

    def _fetch(self, orders: Sequence[CollectOrder]) -> None:
        """Fetch the columns of finished casting tasks from their workers."""
        for order in orders:
            results = fetch_available(self._client, [order.key], holder=order.worker)
            if order.key not in results:
                self._dispatcher.recast_columns(ColumnsLost(order.key))
                continue
            batches = {(batch.job, batch.part.first): batch for batch in results[order.key]}
            receipts = []
            for job, (first, _), name in order.parts:
                streamed = self._jobs[job]
                batch = batches[job, first]
                streamed.columns[first] = batch.part
                receipt = Receipt.from_part(batch.part, job, name, 0, batch.record)
                receipts.append((streamed.casting, receipt))
            self._dispatcher.release(receipts)

    def _end(self, streamed: _StreamedSweeps) -> None:
        del self._jobs[streamed.job.number]
        self._dispatcher.drop(streamed.casting)
        self._casting.remove(streamed.job.number)

    def _warn_if_empty(self, streamed: _StreamedSweeps) -> None:
        """Warn about the first job without points, casting rays locally to find the reason."""
        if streamed.points_read or self._warned:
            return
        self._warned = True
        job = streamed.job
        logger.warning(
            "Job %s of the stream has no points: %s. Further jobs without points are not reported.",
            job.name,
            empty_cloud_reason(job.scene, job.survey),
        )

    def _warn_of_failure(self, name: str, error: object) -> None:
        logger.warning("Job %s of the stream was skipped: %s", name, error)
