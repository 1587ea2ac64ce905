"""The driver's side of one survey: it offers batches, commits parts and hands out frames.

Everything happens in `step`, called repeatedly from one thread; nothing in it waits for long. There
is one rule of recovery: uncommitted batches are offered again, and frames that were not handed out
are sorted again, whatever was lost. What arrives twice does no harm: a second receipt of a scan is
ignored, and its part is the same file with the same bytes. The number of batches under way, and the
distance of the last to the first, are limited: that bounds every queue, and the memory of sorter
and workers.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import chain

import numpy as np

from poolpart import TaskRecord, Whereabouts

from ..base.storage import Storage
from ..base.tracing import trace
from ..columns.cloud import Cloud
from ..columns.parts import part_name
from ..sensor import Survey
from . import policies
from .batches import Batch, Place
from .crew import Seat
from .database import RunDatabase
from .failures import JobError, storing
from .messages import (
    CollectOrder,
    ColumnsLost,
    Failed,
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
from .workers import Outcome

STALL_S = 60.0  # without news from the sorter; then it gets its summaries again


class SurveyDriver:
    """Runs one survey on the partitions of a cluster.

    `seat` is its place among the crew, workers and stages: all that it asks of Dask, so that tests
    can play the cluster. Scans in `db` are not cast again, and `storage` is where parts go. `read`
    reads the points of a committed scan. `on_frame` is called with each frame, in scan order, in
    the driver's thread, and `on_parts` with parts that were committed. So many scans `fit` into the
    memory of a batch; `in_all` are those of the whole run, where it has several surveys.
    """

    def __init__(
        self,
        seat: Seat,
        survey: Survey,
        db: RunDatabase,
        storage: Storage,
        read: Callable[[int], Cloud],
        on_frame: Callable[[Frame], None],
        on_parts: Callable[[list[Receipt]], None],
        fit: int,
        in_all: int = 0,
    ) -> None:
        self.survey, self.seat, self.batches = survey, seat, seat.batches
        self._fit, self._in_all = fit, max(in_all, survey.scan_count)
        self._db, self._storage = db, storage
        self._read, self._on_frame, self._on_parts = read, on_frame, on_parts
        seat.left = survey.scan_count - db.scans_done
        self._mark = db.meta["mark"]
        self._summary = summary_type(samples_of_scan(survey.scan_count))
        self.book = TaskBook()
        self.generated = 0  # scans taken from stage 1, from the first on
        self.cast = 0  # scans that stage 2 has finished
        self.offered_again = 0
        self._seconds = seat.seconds  # casting times of batches
        self._condemned: list[str] = []  # why scans cannot be done
        self._first_deaths: list[Batch] = []  # tried alone, each with a worker that died
        self._hidden: set[str] = set()  # addresses of LIDAR workers that do not see the storage
        self._sorted_at = time.monotonic()  # when the last frames came
        with storing(storage):
            storage.prepare()

    # -- beginning and state ---------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """True once all is committed and was handed out."""
        return self._db.complete

    @property
    def progress(self) -> int:
        """A number that grows when something is committed or handed out."""
        return self._db.scans_done + self._db.frames

    @property
    def notes(self) -> list[str]:
        """Notes on the survey for the user."""
        if not self._hidden:
            return []
        return [
            f"{', '.join(sorted(self._hidden))} of partition {LIDAR} cannot see "
            f"{self._storage.url}: the driver wrote their parts"
        ]

    # -- one step --------------------------------------------------------------------------

    def step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do.

        JobError if a stage has failed with its scans, naming them, or they kill workers.
        """
        moved = self._receive()
        moved |= self._check_casts()
        if (seen := self.seat.whereabouts()) is not None:
            self._leave_workers(seen)
        self._look_after_stages()
        moved |= self._hand_over()
        moved |= self._offer()
        if self._condemned and not self.batches:
            raise JobError("\n".join(self._condemned))
        self.seat.left = self.survey.scan_count - self._db.scans_done
        room = policies.room(len(self.batches), self.batches.span, self._most)
        left = self.generated < self.survey.scan_count
        self.seat.wants_scans = room > 0 and left and not self._condemned
        return moved

    def _receive(self) -> bool:
        messages = self.seat.receive()
        self._commit([m for m in messages if isinstance(m, Receipt) and self._is_stored(m)])
        for message in messages:
            match message:
                case Failed():
                    raise JobError(message.reason)
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
        slots, collectors = self.seat.slot_count, self.seat.collector_count
        return policies.most_under_way(slots, collectors, self._per_task)

    @property
    def _per_task(self) -> int:
        largest = max(map(len, self.batches), default=1)
        return policies.batches_per_task(self._seconds, largest, self._fit)

    def _trace(self, event: str, stage: str, scans: Iterable[int], **more: str) -> None:
        trace(f"driver.{event}", run=self.seat.run, stage=stage, scans=list(scans), **more)

    # -- stage 1: taking scans ---------------------------------------------------------------

    def _take_scans(self, scans: ScanRange) -> None:
        first = max(scans.first, self.generated)  # a restarted generator repeats some
        if first < scans.stop:
            self._trace("take", GENERATE, range(first, scans.stop))
            self.generated = scans.stop
            for at, stop in self._db.missing(first, scans.stop):
                for begin in range(at, stop, self._fit):  # advised for another survey perhaps
                    self.batches.add(begin, min(begin + self._fit, stop))

    # -- stage 2: casting --------------------------------------------------------------------

    def _offer(self) -> bool:
        """Offer waiting batches to workers that have room."""
        if not self.batches.at(Place.WAITING):
            return False
        slots, most, beside = self.seat.slots, self._most, self.seat.beside
        chosen = policies.offers([*self.batches], slots, most, self._per_task, beside)
        for task, worker in chosen:
            key = self.seat.cast([(batch.first, batch.stop) for batch in task], worker)
            for batch in task:
                batch.key, batch.worker, batch.collector = key, worker, ""
                batch.to(Place.CASTING, time.monotonic())
                self._trace("submit", INTERSECT, batch.scans)
        return bool(chosen)

    def _check_casts(self) -> bool:
        moved = False
        for batch in self.batches.at(Place.CASTING):
            outcome = self.seat.outcome(batch.key, batch.worker)
            if outcome is Outcome.DONE:
                batch.to(Place.CAST, time.monotonic())
                self.cast += len(batch)
                moved = True
            elif outcome is Outcome.NO_RIG:
                self._again(batch, "its worker has no scene any more")
            elif outcome is Outcome.KILLED:
                self._lose(batch, Loss.DIED)
        return moved

    def _leave_workers(self, seen: Whereabouts) -> None:
        """Offer batches again whose workers died, are silent, late, or take no tasks."""
        prepared, late_s = len(self.seat.slots), policies.late_after_s(self._seconds)
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
            self.seat.forget(key)

    # -- poison batches ----------------------------------------------------------------------

    def _blame(self, batch: Batch, stage: str, worker: str) -> None:
        """Count the death of a worker against its batches, see `policies.verdict`."""
        batch.deaths[stage] += 1
        if stage == INTERSECT and not self.cast and policies.was_alone(batch, stage):
            self._blame_scene(batch, worker)
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
                f"{self.seat.words_on_memory(worker)}. Look into the logs of the "
                f"{partition} workers."
            )

    def _blame_scene(self, batch: Batch, worker: str) -> None:
        """Count a death with a batch alone, before any was cast: it may be the scene that kills.

        The next to be tried is another batch. JobError once several have killed.
        """
        others = [o for o in self._first_deaths if o.stop <= batch.first or batch.stop <= o.first]
        self._first_deaths = [*others, batch]
        self.batches.postpone(batch)
        if len(self._first_deaths) >= policies.KILLS_MOST:
            names = ", ".join(one.name for one in self._first_deaths)
            raise JobError(
                f"GPU workers die whatever they cast first: {len(self._first_deaths)} died, one "
                f"after the other, with nothing but {names}"
                f"{self.seat.words_on_memory(worker)}. The scene may need more memory than they "
                "have: look into their logs, or try another backend."
            )

    # -- stage 4: collecting -----------------------------------------------------------------

    def _hand_over(self) -> bool:
        """Assign batches that were cast to collectors."""
        if not self.batches.at(Place.CAST):
            return False
        orders: dict[str, list[CollectOrder]] = {}  # {collector: its message}
        batches, beside = [*self.batches], self.seat.beside
        for task, name in policies.handovers(batches, self.seat.collectors, beside):
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
            self.seat.send(name, messages)
        return bool(orders)

    def _is_stored(self, receipt: Receipt) -> bool:
        """Whether a part is in storage; one that its worker holds is written now."""
        if not receipt.held_at:
            return True
        self._hidden.add(receipt.held_at)
        data = self.seat.take_held(receipt)
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

    def _learn(self, record: TaskRecord) -> None:
        """Record a task of stage 2, and advise stage 1 on the scans in one item."""
        self.book.add(record)
        self.seat.learn(record)
        slots = self.seat.slot_count
        self.seat.advise(
            policies.scans_per_batch(record.seconds, record.items, self._fit, self._in_all, slots)
        )

    # -- stage 3: frames in order --------------------------------------------------------------

    def _look_after_stages(self) -> None:
        """Take back the batches of a collector that died; new stages get all that they need."""
        changes = self.seat.changes()
        for batch in self.batches.at(Place.COLLECTING):
            name = batch.collector
            if name in changes.died or name in changes.started:
                self._again(batch, f"{name} was replaced", Place.CAST)
                if name in changes.died:
                    self._blame(batch, COLLECT, changes.died[name])
        if GENERATE in changes.started and self.generated < self.survey.scan_count:
            self.seat.describe(self.survey, self.generated)
        if SORT in changes.started or time.monotonic() - self._sorted_at > STALL_S:
            self._sorted_at = time.monotonic()
            self._send_summaries(self._db.unframed())

    def _send_summaries(self, parts: list[Receipt]) -> None:
        """Send parts to the sorter; an absent one gets them when it is started."""
        if parts:
            framed, count = self._db.frames, self.survey.scan_count
            messages = [Summaries(p.first, p.stop, p.summaries, framed, count) for p in parts]
            self._trace("handon", SORT, chain.from_iterable(m.scans for m in messages))
            self.seat.send(SORT, messages)

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
