"""Sweeps of a campaign as they are cast: from the workers to the reader, without files.

A stream plays stages 1 and 4 itself: it gives the scans of the next sweeps to a `Dispatcher`, which
has them cast, again if workers die, and it fetches the columns from the workers that cast them.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from queue import SimpleQueue
from threading import Event, Thread
from typing import Any

import numpy as np
from distributed import Client

from poolpart import Partition, PoolError, fetch_available

from ..base.errors import LidarpoolError
from ..columns.cloud import Cloud
from ..columns.parts import PartColumns
from ..columns.table import AXES, SCAN
from ..columns.waveforms import WAVEFORM
from ..datasets.job_table import JobRow
from ..datasets.sweep_data import Sweep
from ..export.boxes import Boxes
from ..export.format_table import DATA_SETS
from ..export.formats import Format
from ..export.sweeps import Sweeps
from ..pipeline.casting_workers import CastingWorkers
from ..pipeline.database import JobParts
from ..pipeline.dispatch import Dispatcher
from ..pipeline.driver import send_job
from ..pipeline.failures import JobError
from ..pipeline.job_state import JobState
from ..pipeline.messages import CollectOrder, ColumnsLost, Receipt
from ..pipeline.names import GPU
from ..scenario.build import Job
from ..scenario.campaign import CampaignSpec
from ..simulator.memory import MB, scans_that_fit
from ..simulator.scene_caster import check_backend_here
from .checks import check_workers, find_workers
from .cluster import CLUSTER_LOST, client_of, lost_error
from .job_source import JobMaker
from .options import RunOptions
from .progress import Screen
from .watch import Waiting, Watch

LONGEST_PAUSE_S = 0.02  # while nothing moves

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SweepStream:
    """The sweeps of some jobs of a campaign, which are cast while they are read.

    Each iteration casts all again, with the same result. It ends its tasks, and the workers that it
    has started, when it is over, closed or left by ``break``.
    """

    campaign: CampaignSpec
    numbers: Sequence[int]  # of the jobs
    ahead: int  # most sweeps that are being cast, or wait to be read
    options: RunOptions

    def __repr__(self) -> str:
        return f"<stream of {len(self.numbers):,} jobs, {self.ahead} sweeps ahead>"

    def __iter__(self) -> Generator[Sweep]:
        options, screen = self.options, Screen()
        if options.own:
            check_backend_here(options.backend)
        waiting = Waiting(options.wait_s, screen.tell)
        with (
            client_of(options, {GPU: 1}, waiting, screen) as client,
            closing(_Casting(self, client, waiting)) as casting,
        ):
            yield from iter(casting.take, None)

    def of_rank(self, rank: int, ranks: int) -> SweepStream:
        """Return the stream of one of so many ranks, which all get the same number of jobs."""
        count = len(self.numbers)
        return replace(self, numbers=self.numbers[rank : count - count % ranks : ranks])

    def torch(self, transform: Callable[[Sweep], Any] | None = None) -> Any:
        """Return a `torch.utils.data.IterableDataset` of the sweeps, in the order of jobs.

        Its DataLoader needs ``num_workers=0``: the cluster works ahead, not processes of PyTorch.
        Ranks of torch.distributed, if that is initialised when the loader begins, share the jobs;
        with as many sweeps in each job they have the same number of sweeps.

        Parameters
        ----------
        transform
            Makes an item of a sweep; by default a dict of tensors, as of `SavedSweeps.torch`.

        Raises
        ------
        LidarpoolError
            If torch is not installed; in a worker of a DataLoader.
        """
        if find_spec("torch") is None:
            raise LidarpoolError("This needs PyTorch: pip install torch.")
        from ..datasets.torch_sweeps import TorchStream

        return TorchStream(self, transform)


@dataclass(eq=False)
class _Streamed:
    """A job whose sweeps are cast."""

    job: Job
    sweeps: Sweeps
    state: JobState
    begun: int = 0  # sweeps that were given to the dispatcher
    parts: dict[int, PartColumns] = field(default_factory=dict)  # {first scan: what was cast}

    def sweep(self, number: int) -> Sweep | None:
        """Take a sweep; None if not all of it was cast."""
        at, stop = self.sweeps.scans[number : number + 2].tolist()
        parts = []
        while at < stop:
            if (part := self.parts.get(at)) is None:
                return None
            parts.append(part)
            at = part.stop
        for part in parts:
            del self.parts[part.first]
        job, survey, sweeps = self.job, self.job.survey, self.sweeps
        rest = [c for c in survey.stored_columns if c not in AXES and c.name != WAVEFORM]
        origin = job.scene.origin if survey.coordinates == "world" else np.zeros(3)
        # As from parts in storage.
        table = (SCAN, *rest)
        cloud = Cloud.joined([part.cloud(table, survey.precision_m, origin) for part in parts])
        places = sweeps.in_sensor(number, cloud.positions).astype(np.float32)
        columns = {column.name: np.array(cloud[column.name]) for column in table}
        boxes = Boxes.of(sweeps, number, cloud) if sweeps.actors else None
        row = JobRow(job.number, job.name, job.split, job.values)
        return Sweep.of(row, sweeps, number, (places, columns), boxes)


class _Collector:
    """Plays stage 4 for a dispatcher: keeps the orders until the columns are fetched."""

    collectors: Mapping[str, str] = {"reader": ""}
    collector_count = 1

    def __init__(self) -> None:
        self.orders: list[CollectOrder] = []

    def send(self, name: str, messages: Sequence[CollectOrder]) -> None:
        """Take orders."""
        self.orders += messages

    def advise(self, scans: int) -> None:
        """Ignore the advice: a batch is a sweep, or as much of one as fits into memory."""

    def store_held(self, receipt: Receipt) -> bool:
        """Return whether a part is there."""
        return True


class _Casting:
    """Casts the sweeps of a stream in a thread; `take` gives them in order."""

    def __init__(self, stream: SweepStream, client: Client, waiting: Waiting) -> None:
        self._stream, self._client, options = stream, client, stream.options
        self._address: str = getattr(client.scheduler, "address", "")
        _, self._casting, self._backend, software = find_workers(
            client, {GPU: 1}, options.backend, waiting=waiting
        )
        partition, run = Partition(GPU, client), uuid.uuid4().hex[:8]
        self._workers = CastingWorkers(partition, run, self._backend, software)
        self._collector = _Collector()
        self._dispatcher = Dispatcher(self._workers, self._collector, "")
        self._watch = Watch(client, [GPU], (), options.patience_s)
        keep = stream.campaign.keep
        columns = Format(DATA_SETS[keep.format], keep.layout).needs
        self._maker = JobMaker(stream.campaign, stream.numbers, columns)
        self._jobs: dict[int, _Streamed] = {}  # those that are cast
        self._next: _Streamed | None = None  # the job whose sweeps are cast next
        self._coming: deque[tuple[_Streamed, int]] = deque()  # sweeps that are being cast
        # With those that are being cast at most `ahead`; in the end None, or an error.
        self._ready: SimpleQueue[Sweep | BaseException | None] = SimpleQueue()
        self._stopped = Event()
        self._thread = Thread(target=self._work, name="stream", daemon=True)
        self._thread.start()

    def take(self) -> Sweep | None:
        """Wait for the next sweep; None after the last. Errors of the thread are raised."""
        found = self._ready.get()
        if isinstance(found, BaseException):
            raise found
        return found

    def close(self) -> None:
        """Cast nothing more."""
        self._stopped.set()
        self._thread.join()

    def _work(self) -> None:
        last: BaseException | None = None
        try:
            pause_s = 0.0
            while not self._stopped.is_set() and not self._ended:
                pause_s = 0.0 if self._step() else min(max(0.001, 2 * pause_s), LONGEST_PAUSE_S)
                time.sleep(pause_s)
        except BaseException as error:
            last = self._explained(error)
        try:
            self._finish()
        except Exception as error:
            last = last or self._explained(error)
        self._ready.put(last)

    def _explained(self, error: BaseException) -> BaseException:
        """Return what a user can make of an error of the cluster."""
        told: BaseException = error
        if self._client.status != "running" or isinstance(error, CLUSTER_LOST):
            told = lost_error(self._address)
        elif isinstance(error, PoolError):
            told = LidarpoolError(str(error))
        if told is not error:
            told.__cause__ = error
        return told

    def _finish(self) -> None:
        self._maker.close()
        for one in [*self._jobs.values()]:
            self._end(one)
        if self._client.status == "running":
            self._client.cancel(self._workers.futures)
            self._workers.release()

    @property
    def _ended(self) -> bool:
        return self._maker.ended and self._next is None and not self._coming

    # -- one step ----------------------------------------------------------------------------

    def _step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do."""
        moved = self._begin_sweeps()
        moved |= self._dispatcher.check()
        if (seen := self._workers.look()) is not None:
            left = sum(len(batch) for batch in self._dispatcher.batches.values())
            self._workers.want(self._dispatcher.slots_wanted(left))
            self._dispatcher.leave_workers(seen)
        for state, error in [*self._dispatcher.failed.items()]:
            self._fail(self._jobs[state.number], error)
            moved = True
        self._dispatcher.hand_over()
        moved |= self._fetch()
        moved |= self._dispatcher.offer()
        moved |= self._hand_out()
        self._watch.look()
        return moved

    def _begin_sweeps(self) -> bool:
        """Have further sweeps cast, as far as the reader may be behind."""
        moved = False
        while len(self._coming) + self._ready.qsize() < self._stream.ahead:
            if self._next is None and not self._begin_job():
                break
            moved = True
            if (streamed := self._next) is None:  # a job that failed
                continue
            number, streamed.begun = streamed.begun, streamed.begun + 1
            self._dispatcher.take(streamed.state, *streamed.sweeps.scans[number:][:2].tolist())
            self._coming.append((streamed, number))
            if streamed.begun == len(streamed.sweeps):
                self._next = None
        return moved

    def _begin_job(self) -> bool:
        """Take the next job, which may fail; returns whether there is one now."""
        if (made := self._maker.take()) is None:
            return False
        if isinstance(made, JobRow):
            self._leave_out(made.name, made.error)
            return True
        job, sweeps = made.job, made.sweeps
        assert sweeps is not None, "of a campaign"
        survey, options = job.survey, self._stream.options
        try:
            check_workers(job, options, self._backend, self._casting)
            packed, scene = send_job(self._workers, job.number, job.scene, survey)
        except JobError as error:
            self._leave_out(job.name, error)
            return True
        on_device = self._backend == "cuda"
        fit = scans_that_fit(job.scene, survey, options.batch_mb * MB, on_device=on_device)
        count = survey.scan_count
        parts = JobParts(job.number, count, lambda receipt: b"")  # none is kept
        state = JobState(
            self._workers.run, job.number, survey, parts, packed, scene, fit, count,
            None, None, None,
        )  # fmt: skip
        self._next = self._jobs[job.number] = _Streamed(job, sweeps, state)
        return True

    def _fetch(self) -> bool:
        """Fetch the columns of casting tasks from their workers."""
        orders, self._collector.orders = self._collector.orders, []
        for order in orders:
            found = fetch_available(self._client, [order.key], at=order.worker)
            if order.key not in found:
                self._dispatcher.lost(ColumnsLost(order.key))
                continue
            batches = {(one.job, one.part.first): one for one in found[order.key]}
            receipts = []
            for job, (first, _), name in order.parts:
                streamed, batch = self._jobs[job], batches[job, first]
                streamed.parts[first] = batch.part
                receipt = Receipt.of_part(batch.part, job, name, 0, batch.record)
                receipts.append((streamed.state, receipt))
            self._dispatcher.release(receipts)
        return bool(orders)

    def _hand_out(self) -> bool:
        """Give the reader the sweeps that were cast, in order."""
        moved = False
        while self._coming:
            streamed, number = self._coming[0]
            if (sweep := streamed.sweep(number)) is None:
                break
            self._coming.popleft()
            self._ready.put(sweep)
            moved = True
            if number + 1 == len(streamed.sweeps):
                self._end(streamed)
        return moved

    def _end(self, streamed: _Streamed) -> None:
        del self._jobs[streamed.job.number]
        self._dispatcher.drop(streamed.state)
        self._workers.remove(streamed.job.number)

    def _fail(self, streamed: _Streamed, error: JobError) -> None:
        """Leave out what was not read of a job."""
        self._end(streamed)
        self._coming = deque(one for one in self._coming if one[0] is not streamed)
        self._next = None if self._next is streamed else self._next
        self._leave_out(streamed.job.name, error)

    def _leave_out(self, name: str, error: object) -> None:
        logger.warning("Job %s is left out of the stream: %s", name, error)
