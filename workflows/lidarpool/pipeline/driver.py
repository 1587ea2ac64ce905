"""The driver's side of the survey: it offers batches, commits parts and hands out frames.

Everything happens in `step`, called repeatedly from one thread; nothing in it waits for long. There
is one rule of recovery: uncommitted batches are offered again, and frames that were not handed out
are sorted again, whatever was lost. What arrives twice does no harm: a second receipt of a scan is
ignored, and its part is the same file with the same bytes. The number of batches under way, and the
distance of the last to the first, are limited: that bounds every queue, and the memory of sorter
and workers.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import chain

import numpy as np

from poolpart import TaskRecord, Whereabouts

from ..base.errors import LidarpoolError
from ..base.storage import Storage
from ..base.tracing import trace
from ..columns.cloud import Cloud
from ..columns.parts import part_name, probe_name
from ..sensor import Survey
from . import policies
from .batches import Batch, Batches, Place
from .database import RunDatabase
from .failures import storing
from .long_stages import LongStages
from .messages import (
    CollectOrder,
    ColumnsLost,
    Frame,
    Receipt,
    ScanRange,
    Summaries,
    samples_of_scan,
    summary_type,
)
from .names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR, SORT
from .policies import Loss, Verdict
from .task_book import TaskBook
from .workers import CastingWorkers, Outcome

STALL_S = 60.0  # without news from the sorter; then it gets its summaries again
WAIT_S = 0.02  # for news, where there is nothing else to do
CLOSING_S = 0.001  # longest wait while the stages end


class SurveyDriver:
    """Runs one survey on the partitions of a cluster.

    `workers` are stage 2 and `stages` the others: all that it asks of Dask, so that tests can play
    the cluster. Scans in `db` are not cast again, and `storage` is where parts go. `read` reads the
    points of a committed scan. `on_frame` is called with each frame, in scan order, in the driver's
    thread, and `on_parts` with parts that were committed. So many scans `fit` into the memory of a
    batch.
    """

    def __init__(
        self,
        workers: CastingWorkers,
        stages: LongStages,
        survey: Survey,
        db: RunDatabase,
        storage: Storage,
        read: Callable[[int], Cloud],
        on_frame: Callable[[Frame], None],
        on_parts: Callable[[list[Receipt]], None],
        fit: int,
    ) -> None:
        self.survey = survey
        self._fit = fit
        self._workers, self._stages = workers, stages
        self._db, self._storage = db, storage
        self._read, self._on_frame, self._on_parts = read, on_frame, on_parts
        self._mark = db.meta["mark"]
        self._probe = (probe_name(self._mark, stages.run), secrets.token_bytes(16))
        self._summary = summary_type(samples_of_scan(survey.scan_count))
        self.book = TaskBook()
        self.batches = Batches()
        self.generated = 0  # scans taken from stage 1, from the first on
        self.cast = 0  # scans that stage 2 has finished
        self.offered_again = 0
        self._seconds: deque[float] = deque(maxlen=64)  # casting times of batches
        self._learned = [0.0, 0]  # casting time of scans, and their number
        self._condemned: list[str] = []  # why scans cannot be done
        self._hidden: set[str] = set()  # addresses of LIDAR workers that do not see the storage
        self._sorted_at = time.monotonic()  # when the last frames came
        self._closed = False  # all is committed, and the stages are ending

    # -- beginning and state ---------------------------------------------------------------

    def start(self) -> None:
        """Make the pipes and start the stages; after this `stop` and `finish` must be called."""
        with storing(self._storage):
            self._storage.prepare()
            self._storage.write(*self._probe)
        self._stages.open(self._probe)
        self._workers.look()
        self._look_after_stages()

    @property
    def finished(self) -> bool:
        """True once all stages have exited, or the shutdown timeout has elapsed."""
        return self._closed and self._stages.ended

    @property
    def waits_for(self) -> str:
        """Partition whose slots other runs hold, so that the stages cannot start; else empty."""
        return LIDAR if self._stages.waiting else ""

    @property
    def notes(self) -> list[str]:
        """Notes on the survey for the user."""
        notes = [*self._stages.notes, *self._workers.notes]
        if self._hidden:
            notes.append(
                f"{', '.join(sorted(self._hidden))} of partition {LIDAR} cannot see "
                f"{self._storage.url}: the driver wrote their parts"
            )
        return notes

    # -- one step --------------------------------------------------------------------------

    def step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do.

        LidarpoolError if a task of the survey has failed, naming stage and scans.
        """
        moved = self._receive()
        if self._closed:  # only receive last messages
            return moved
        moved |= self._check_casts()
        if (seen := self._workers.look()) is not None:
            self._leave_workers(seen)
            self._want_slots()
        self._look_after_stages()
        moved |= self._hand_over()
        moved |= self._offer()
        if self._condemned and not self.batches:
            raise LidarpoolError("\n".join(self._condemned))
        if self._db.complete:
            self._workers.want(0)
            self._stages.close()
            self._closed = True
        return moved

    def wait(self, seconds: float) -> None:
        """Wait until there may be something to do, at most so long."""
        room = policies.room(len(self.batches), self.batches.span, self._most)
        # The pipe of stage 1 is closed after the last scan, which would end each wait.
        wanted = room > 0 and self.generated < self.survey.scan_count
        self._stages.wait(
            min(seconds, CLOSING_S) if self._closed else max(seconds, WAIT_S),
            self._workers.pending,
            scans=wanted and not self._condemned and not self._closed,
        )

    def _receive(self) -> bool:
        messages = self._stages.receive()
        self._commit([m for m in messages if isinstance(m, Receipt) and self._is_stored(m)])
        for message in messages:
            match message:
                case ScanRange():
                    self._take_scans(message)
                case Summaries():
                    self._take_frames(message)
                case ColumnsLost():
                    # A replaced collector may report a batch that was offered again.
                    for batch in self.batches.at(Place.COLLECTING):
                        if batch.key == message.key:
                            self._again(batch, "its columns could not be fetched")
        return bool(messages)

    @property
    def _most(self) -> int:
        slots, collectors = self._workers.slot_count, self._stages.collector_count
        return policies.most_under_way(slots, collectors, self._per_task)

    @property
    def _per_task(self) -> int:
        largest = max(map(len, self.batches), default=1)
        return policies.batches_per_task(self._seconds, largest, self._fit)

    def _trace(self, event: str, stage: str, scans: Iterable[int], **more: str) -> None:
        trace(f"driver.{event}", run=self._stages.run, stage=stage, scans=list(scans), **more)

    # -- stage 1: taking scans ---------------------------------------------------------------

    def _take_scans(self, scans: ScanRange) -> None:
        first = max(scans.first, self.generated)  # a restarted generator repeats some
        if first < scans.stop:
            self._trace("take", GENERATE, range(first, scans.stop))
            self.generated = scans.stop
            for run in self._db.missing(first, scans.stop):
                self.batches.add(*run)

    # -- stage 2: casting --------------------------------------------------------------------

    def _offer(self) -> bool:
        """Offer waiting batches to workers that have room."""
        slots, most = self._workers.slots, self._most
        chosen = policies.offers([*self.batches], slots, most, self._per_task)
        for task, worker in chosen:
            key = self._workers.cast([(batch.first, batch.stop) for batch in task], worker)
            for batch in task:
                batch.key, batch.worker, batch.collector = key, worker, ""
                batch.to(Place.CASTING, time.monotonic())
                self._trace("submit", INTERSECT, batch.scans)
        return bool(chosen)

    def _check_casts(self) -> bool:
        moved = False
        for batch in self.batches.at(Place.CASTING):
            outcome = self._workers.outcome(batch.key)
            if outcome is Outcome.DONE:
                batch.to(Place.CAST, time.monotonic())
                self.cast += len(batch)
                moved = True
            elif outcome is Outcome.NO_RIG:
                self._workers.drop(batch.worker)
                self._again(batch, "its worker has no scene any more")
            elif outcome is Outcome.KILLED:
                self._lose(batch, Loss.DIED)
        return moved

    def _leave_workers(self, seen: Whereabouts) -> None:
        """Offer batches again whose workers died, are silent, late, or take no tasks."""
        prepared, late_s = len(self._workers.slots), policies.late_after_s(self._seconds)
        for batch in self.batches:
            if reason := policies.loss(batch, seen, prepared, time.monotonic(), late_s):
                self._lose(batch, reason)

    def _lose(self, batch: Batch, reason: Loss) -> None:
        self._again(batch, reason.value)
        if reason is Loss.DIED:
            self._blame(batch, INTERSECT, batch.worker)

    def _again(self, batch: Batch, reason: str, place: Place = Place.WAITING) -> None:
        """Return a batch to be cast again, or only to be collected again."""
        if place is Place.WAITING:
            self._forget(batch)
        batch.to(place, time.monotonic())
        self.offered_again += 1
        self._trace("replay", INTERSECT, batch.scans, reason=reason)

    def _remove(self, batch: Batch) -> None:
        self._forget(batch)
        self.batches.remove(batch)

    def _forget(self, batch: Batch) -> None:
        """Drop a batch's casting task, unless others of the same task need it."""
        key, batch.key = batch.key, ""
        if all(other.key != key for other in self.batches):
            self._workers.forget(key)

    # -- poison batches ----------------------------------------------------------------------

    def _blame(self, batch: Batch, stage: str, worker: str) -> None:
        """Count the death of a worker against its batches, see `policies.verdict`."""
        batch.deaths[stage] += 1
        judged = policies.verdict(batch.deaths[stage], len(batch))
        if judged is Verdict.SPLIT:
            self._forget(batch)
            self.batches.split(batch, Counter({stage: policies.SUSPECT_DEATHS}))
        elif judged is Verdict.POISON:
            self._remove(batch)
            partition = GPU if stage == INTERSECT else LIDAR
            self._condemned.append(
                f"{batch.name} kills the worker that runs stage {stage}: "
                f"{policies.KILLS_MOST} workers died, one after the other, with no other scan in "
                "that stage"
                f"{self._workers.words_on_memory(worker)}. Look into the logs of the "
                f"{partition} workers."
            )

    # -- stage 4: collecting -----------------------------------------------------------------

    def _hand_over(self) -> bool:
        """Assign batches that were cast to collectors."""
        orders: dict[str, list[CollectOrder]] = {}  # {collector: its message}
        for task, name in policies.handovers([*self.batches], self._stages.collectors):
            parts = []
            for batch in task:
                batch.collector = name
                batch.to(Place.COLLECTING, time.monotonic())
                self._trace("handon", COLLECT, batch.scans)
                part = part_name(self._mark, batch.first, batch.stop)
                parts.append(((batch.first, batch.stop), part))
            order = CollectOrder(task[0].key, task[0].worker, tuple(parts))
            orders.setdefault(name, []).append(order)
        for name, messages in orders.items():
            self._stages.send(name, messages)
        return bool(orders)

    def _is_stored(self, receipt: Receipt) -> bool:
        """Whether a part is in storage; one that its worker holds is written now."""
        if not receipt.held_at:
            return True
        self._hidden.add(receipt.held_at)
        data = self._stages.take_held(receipt)
        if data is None:
            for batch in self.batches.within(receipt.first, receipt.stop):
                if batch.place is Place.COLLECTING:
                    self._again(batch, "its part was lost")
            return False
        with storing(self._storage):
            self._storage.write(receipt.name, data)
        return True

    def _commit(self, receipts: list[Receipt]) -> None:
        new = self._db.commit(receipts)
        for receipt in new:
            self._trace("points", COLLECT, range(receipt.first, receipt.stop))
            if receipt.record is not None:
                self._learn(receipt.record)
            for batch in self.batches.within(receipt.first, receipt.stop):
                self._remove(batch)
                for other in self.batches.at(Place.COLLECTING):  # those behind it had to wait
                    if other.collector == batch.collector and other.since >= batch.since:
                        other.since = time.monotonic()
        if new:
            self._send_summaries(new)
            self._on_parts(new)

    def _want_slots(self) -> None:
        """Say how many slots the remaining scans are worth."""
        seconds, scans = self._learned
        left = self.survey.scan_count - self._db.scans_done
        self._workers.want(policies.slots_wanted(left, seconds / scans if scans else None))

    def _learn(self, record: TaskRecord) -> None:
        """Record a task of stage 2, and advise stage 1 on the scans in one item."""
        self.book.add(record)
        self._seconds.append(record.seconds)
        self._learned = [self._learned[0] + record.seconds, self._learned[1] + record.items]
        count, slots = self.survey.scan_count, self._workers.slot_count
        self._stages.advise(
            policies.scans_per_batch(record.seconds, record.items, self._fit, count, slots)
        )

    # -- stage 3: frames in order --------------------------------------------------------------

    def _look_after_stages(self) -> None:
        """Take back the batches of a collector that died; a new sorter gets all that it needs."""
        done, framed = self._db.scans_done, self._db.frames
        changes = self._stages.look(done + framed, self.generated, framed)
        for batch in self.batches.at(Place.COLLECTING):
            name = batch.collector
            if name in changes.died or name in changes.started:
                self._again(batch, f"{name} was replaced", Place.CAST)
                if name in changes.died:
                    self._blame(batch, COLLECT, changes.died[name])
        if SORT in changes.started or time.monotonic() - self._sorted_at > STALL_S:
            self._sorted_at = time.monotonic()
            self._send_summaries(self._db.unframed())

    def _send_summaries(self, parts: list[Receipt]) -> None:
        """Send parts to the sorter; an absent one gets them when it is started."""
        if parts:
            messages = [Summaries(part.first, part.stop, part.summaries) for part in parts]
            self._trace("handon", SORT, chain.from_iterable(m.scans for m in messages))
            self._stages.send(SORT, messages)

    def _take_frames(self, ordered: Summaries) -> None:
        """Hand out frames; some may have been handed out before, by an earlier sorter or run."""
        self._sorted_at = time.monotonic()
        summaries = np.frombuffer(ordered.data, self._summary)
        for scan, summary in zip(ordered.scans, summaries, strict=True):
            if scan == self._db.frames:
                self._hand_out(scan, summary)

    def _hand_out(self, scan: int, summary: np.void) -> None:
        samples, spec = summary["samples"], self.survey.scan(scan)
        frame = Frame(
            scan,
            self.survey.carried[spec.sensor].name,
            self.survey.pose(scan),
            spec.ray_count,
            int(summary["hits"]),
            int(summary["points"]),
            samples[~np.isnan(samples[:, 0])],
            self._read,
        )
        self._trace("frame", SORT, [scan])
        self._on_frame(frame)
        # Only now: after an error of the caller the frame is handed out again.
        self._db.frames = scan + 1
        part = self._db.part_of(scan)
        if scan + 1 == part.stop:
            self._db.forget_summaries(part)
        self._trace("release", SORT, [scan])

    # -- the end -----------------------------------------------------------------------------

    def stop(self, reason: str) -> None:
        """End all stages at once; `finish` does the rest."""
        for batch in self.batches:
            self._workers.forget(batch.key)
        self._stages.stop(reason)

    def finish(self) -> None:
        """Wait a moment for the stages to end, and clean up scheduler and storage."""
        try:
            for record in self._stages.finish(self._workers.futures):
                self.book.add(record)
        finally:
            self._workers.release()
            with suppress(OSError):
                self._storage.remove([self._probe[0]])
