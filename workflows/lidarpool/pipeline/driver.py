"""The driver's side of the survey: it offers batches, commits parts and hands out frames.

Everything happens in `step`, called repeatedly from one thread; nothing in it waits for long. There
is one rule of recovery: uncommitted batches are offered again, and frames that were not handed out
are sorted again, whatever was lost. The number of batches under way, and the distance of the last
to the first, are limited: that bounds every queue, and the memory of sorter and workers.
"""

from __future__ import annotations

import secrets
import statistics
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from distributed import Client

from poolpart import (
    Partition,
    Pipe,
    PipeFailed,
    TaskRecord,
    fetch_available,
    forget_pipes,
    take_held,
    take_news,
)

from ..base.errors import LidarpoolError
from ..base.task_book import TaskBook
from ..base.tracing import trace
from ..columns.cloud import Cloud
from ..columns.parts import part_name, probe_name
from ..columns.storage import Storage
from .batches import Batch, Batches, Place
from .cast import intersect
from .database import RunDatabase
from .failures import raise_if_failed, rig_is_missing, was_killed, words_on_memory
from .long_stages import LongStages, Work
from .messages import Frame, Receipt, samples_of_scan, summary_type
from .names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR, SORT
from .rigs import RigPlan
from .stages import collect, generate, sort_frames
from .workers import CastingWorkers

BATCH_SECONDS = 0.2  # casting time that makes a batch worth its overhead
BATCH_RAYS = 1_000_000  # bounds a batch's memory
BATCHES_LEAST = 16  # batches for each slot, so that none idles for long at the end
AHEAD = 2  # batches offered to a worker for each of its slots, so that it need not wait
COLLECTING = 3  # batches that a collector is given at a time
SPAN = 8  # batches that the newest may be ahead of the oldest, for each that may be under way
SUSPECT_DEATHS = 2  # workers that may die with a batch before it is tried alone
KILLS_MOST = 3  # workers that a single scan may kill, alone
LATE_S = 60.0  # a batch is late when it takes so long at one place, and
LATE_FACTOR = 20.0  # so much longer than others
STALL_S = 60.0  # without news from the sorter; then it gets its summaries again
LAST_WORDS_S = 3.0  # for the stages to end after everything was committed
PUT_S = 30.0  # for a pipe that is never full


class SurveyDriver:
    """Runs one survey on the partitions of a cluster.

    Parameters
    ----------
    client
        Client of the cluster.
    partitions
        The GPU and LIDAR partitions, by name.
    plan
        Scene, survey and backend.
    software
        That of the workers that may cast, see `base.software`.
    db
        Committed parts; their scans are not cast again.
    storage
        Where parts go.
    read
        Reads the points of a committed scan.
    on_frame
        Called with each frame, in scan order, in the driver's thread.
    on_parts
        Called with parts that were committed.
    queue_capacity
        Items that stage 1 may be ahead.
    collectors
        Number of tasks of stage 4.
    patience_s
        How long to wait for workers that are gone, seconds.
    """

    def __init__(
        self,
        client: Client,
        partitions: dict[str, Partition],
        plan: RigPlan,
        software: Mapping[str, str],
        db: RunDatabase,
        storage: Storage,
        read: Callable[[int], Cloud],
        on_frame: Callable[[Frame], None],
        on_parts: Callable[[list[Receipt]], None],
        *,
        queue_capacity: int,
        collectors: int,
        patience_s: float,
    ) -> None:
        self.client, self.survey, self.run_id = client, plan.survey, uuid.uuid4().hex[:8]
        self._gpu, self._lidar = partitions[GPU], partitions[LIDAR]
        self._db, self._storage = db, storage
        self._read, self._on_frame, self._on_parts = read, on_frame, on_parts
        self._collectors = collectors
        self.book = TaskBook()
        self.batches = Batches()
        self.workers = CastingWorkers(client, self._gpu, self.run_id, plan, software)
        self.generated = 0  # scans taken from stage 1, from the first on
        self.cast = 0  # scans that stage 2 has finished
        self.offered_again = 0
        self._seconds: deque[float] = deque(maxlen=64)  # casting times of batches
        self._condemned: list[str] = []  # why scans cannot be done
        self._mark = db.meta["mark"]
        self._probe = (probe_name(self._mark, self.run_id), secrets.token_bytes(16))
        self._hidden: list[str] = []  # names of LIDAR workers that do not see the storage
        self._summary = summary_type(samples_of_scan(self.survey.scan_count))
        self._sorted_at = time.monotonic()  # when the last frames came
        self._scans = self._pipe("scans", queue_capacity)
        self._receipts = self._pipe("receipts", 64)
        self._frames = self._pipe("frames", 64)
        self._inlets: dict[str, Pipe] = {}  # {name of a stage 3 or 4: its pipe}
        commands: dict[str, Callable[[int], Work]] = {
            GENERATE: self._generate,
            SORT: self._sort,
        }
        for number in range(collectors):
            commands[f"{COLLECT}-{number}"] = self._collector(f"{COLLECT}-{number}")
        self.stages = LongStages(
            client,
            self._lidar,
            self.run_id,
            software["lidarpool"],
            commands,
            self._stage_died,
            patience_s,
        )
        self._inbox: dict[str, list[Any]] = {}  # {name of a pipe: items taken from it}
        self._closed_at: float | None = None  # when all was committed and the pipes were closed

    # -- the long stages -------------------------------------------------------------------

    def _pipe(self, name: str, capacity: int) -> Pipe:
        return Pipe(f"lidarpool-{self.run_id}-{name}", capacity, self.client)

    def _fields(self, stage: str, number: int) -> dict[str, Any]:
        return {"run": self.run_id, "stage": stage, "attempt": number}

    def _generate(self, number: int) -> Work:
        fields = self._fields(GENERATE, number)
        return generate, (fields, self.survey, self._scans, self.generated)

    def _sort(self, number: int) -> Work:
        """Start a sorter with its own pipe, which has all summaries not handed out yet."""
        self._sorted_at = time.monotonic()
        inlet = self._new_inlet(SORT, number)
        self._have_sorted(self._db.unframed())
        fields = self._fields(SORT, number)
        size = self._summary.itemsize
        return sort_frames, (fields, size, self._db.frames, inlet, self._frames)

    def _collector(self, name: str) -> Callable[[int], Work]:
        def command(number: int) -> Work:
            inlet = self._new_inlet(name, number)
            fields = self._fields(COLLECT, number)
            return collect, (
                fields,
                self._storage,
                self._probe,
                inlet,
                self._receipts,
            )

        return command

    def _new_inlet(self, name: str, number: int) -> Pipe:
        """Make the pipe for one start of a stage; delete that of an earlier start."""
        if (earlier := self._inlets.pop(name, None)) is not None:
            forget_pipes(self.client, [earlier.name])
        pipe = self._inlets[name] = self._pipe(f"{name}-{number}", 1_000_000).create()
        return pipe

    def _have_sorted(self, parts: list[Receipt]) -> None:
        """Send parts to the sorter; an absent one gets them when it is started."""
        if SORT in self._inlets and parts:
            items = [{"first": part.first, "data": part.summaries} for part in parts]
            self._trace("handon", SORT, [s for p in parts for s in range(p.first, p.stop)])
            self._put(self._inlets[SORT], items)

    def _put(self, pipe: Pipe, item: list[dict[str, Any]]) -> None:
        """Put into a pipe whose length is bounded by the batches under way."""
        with suppress(PipeFailed):  # its stage is being replaced, and gets all of it then
            pipe.put(item, timeout_s=PUT_S, unbounded=True)

    def _stage_died(self, name: str) -> None:
        """Take back a collector's batches; a sorter gets everything when it is started."""
        for batch in self.batches.at(Place.COLLECTING):
            if batch.collector == name:
                alone = len(self.batches.at(Place.COLLECTING)) == 1
                batch.to(Place.CAST, time.monotonic())
                self._count_again(batch, f"the worker of {name} died")
                self._note_death(batch, COLLECT, alone)

    # -- state -----------------------------------------------------------------------------

    def start(self) -> None:
        """Make the pipes and start the stages; after this `stop` and `finish` must be called."""
        try:
            self._storage.prepare()
            self._storage.write(*self._probe)
        except OSError as error:
            raise self._unwritable(error.strerror or str(error)) from error
        for pipe in (self._scans, self._receipts, self._frames):
            pipe.create()
        self.workers.look()
        self.stages.start()

    @property
    def complete(self) -> bool:
        """Whether every scan is committed and was handed out."""
        count = self.survey.scan_count
        return self._db.scans_done == count and self._db.frames == count

    @property
    def finished(self) -> bool:
        """True once all stages have exited, or the shutdown timeout has elapsed."""
        if self._closed_at is None:
            return False
        return self.stages.done or time.monotonic() - self._closed_at > LAST_WORDS_S

    @property
    def waits_for(self) -> str:
        """Partition whose slots other runs hold, so that the stages cannot start; else empty."""
        return self._lidar.name if self.stages.waiting else ""

    @property
    def notes(self) -> list[str]:
        """Notes on the survey for the user."""
        notes = [*self.stages.notes, *self.workers.notes]
        if self._hidden:
            notes.append(
                f"{', '.join(sorted(set(self._hidden)))} of partition {LIDAR} cannot see "
                f"{self._storage.url}: the driver wrote their parts"
            )
        return notes

    # -- one step --------------------------------------------------------------------------

    def step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do.

        Raises
        ------
        LidarpoolError
            If a task of the survey has failed, naming stage and scans.
        """
        moved = self._take_receipts() | self._take_frames()
        if self._closed_at is not None:  # only receive last messages
            return moved
        moved |= self._see_to_casts()
        self._look()
        moved |= self._take_scans()
        moved |= self._hand_on()
        moved |= self._offer()
        if self._condemned and not self.batches:
            raise LidarpoolError("\n".join(self._condemned))
        if self.complete:
            for pipe in self._inlets.values():
                pipe.close()
            self._closed_at = time.monotonic()
        return moved

    def wait(self, seconds: float) -> None:
        """Wait until there may be something to do, at most so long.

        The same request takes all items: each request costs driver and scheduler a millisecond.
        """
        pipes = [self._receipts.name, self._frames.name]
        if self._room > 0 and self._closed_at is None:
            pipes.append(self._scans.name)
        casting = self.batches.at(Place.CASTING)
        keys = [b.future.key for b in casting if b.future and b.future.status == "pending"]
        if self._closed_at is not None:
            seconds = min(seconds, 0.001)
        news = take_news(self.client, seconds, pipes, [*keys, *self.workers.preparing])
        for name, items in news.items():
            self._inbox.setdefault(name, []).extend(items)

    def _trace(self, event: str, stage: str, scans: Sequence[int], **more: Any) -> None:
        trace(f"driver.{event}", run=self.run_id, stage=stage, scans=list(scans), **more)

    def _look(self) -> None:
        """Check workers and stages from time to time."""
        if self.workers.due:
            casting = self.batches.at(Place.CASTING)
            self.workers.look([batch.future.key for batch in casting if batch.future])
            self._leave_lost_workers()
            self._leave_late()
        else:
            self.workers.check()
        self.stages.look(self._db.scans_done + self._db.frames)
        if time.monotonic() - self._sorted_at > STALL_S:
            self._sorted_at = time.monotonic()
            self._have_sorted(self._db.unframed())

    # -- stage 1: taking scans ---------------------------------------------------------------

    @property
    def _most(self) -> int:
        """Batches that may be under way."""
        collecting = COLLECTING * self._collectors
        return AHEAD * self.workers.slot_count + collecting + 2

    @property
    def _room(self) -> int:
        """Batches that may be taken now."""
        if self._condemned or self.batches.span >= SPAN * self._most:
            return 0
        return self._most - len(self.batches)

    def _take_scans(self) -> bool:
        items = self._inbox.pop(self._scans.name, [])
        for first, stop in items:
            new = max(first, self.generated)  # a restarted generator repeats some
            if new >= stop:
                continue
            self._trace("take", GENERATE, range(new, stop))
            self.generated = stop
            for run in self._db.missing(new, stop):
                self.batches.add(*run)
        return bool(items)

    # -- stage 2: casting --------------------------------------------------------------------

    def _offer(self) -> bool:
        """Offer waiting batches to workers that have room."""
        waiting = self.batches.at(Place.WAITING)
        if not waiting or not self.workers.slots:
            return False
        load = dict.fromkeys(self.workers.slots, 0)
        alone: set[str] = set()  # workers with a suspect batch
        for batch in self.batches.at(Place.CASTING):
            if batch.worker in load:
                load[batch.worker] += 1
                if INTERSECT in batch.suspects:
                    alone.add(batch.worker)
        cast = len(self.batches.at(Place.CAST, Place.COLLECTING))
        moved = False
        for batch in waiting:
            suspect = INTERSECT in batch.suspects
            rooms = {
                address: load[address] / (1 if suspect else AHEAD * slots)
                for address, slots in self.workers.slots.items()
                if address not in alone
            }
            address = min(rooms, key=lambda a: (rooms[a], a), default="")
            if not address or rooms[address] >= 1:
                if suspect:  # the others must not occupy all workers
                    break
                continue
            if cast + sum(load.values()) >= self._most:
                break
            self._cast(batch, address)
            load[address] += 1
            if suspect:
                alone.add(address)
            moved = True
        return moved

    def _cast(self, batch: Batch, address: str) -> None:
        batch.tries += 1
        batch.worker, batch.collector = address, ""
        batch.future = self._gpu.submit(
            intersect,
            self.workers.handle,
            batch.first,
            batch.stop,
            self.run_id,
            key=f"{INTERSECT}-{self.run_id}-{batch.first}-{batch.stop}.{batch.tries}",
            workers=address,
        )
        batch.to(Place.CASTING, time.monotonic())
        self._trace("submit", INTERSECT, batch.scans)

    def _see_to_casts(self) -> bool:
        moved = False
        for batch in self.batches.at(Place.CASTING):
            future = batch.future
            assert future is not None
            if future.status == "finished":
                batch.to(Place.CAST, time.monotonic())
                self.cast += batch.stop - batch.first
                moved = True
            elif future.status == "error" and rig_is_missing(future):
                self.workers.drop(batch.worker)
                self._again(batch, "its worker has no scene any more")
            elif future.status == "error" and was_killed(future):
                self._lost(batch, died=True)
            elif future.status not in ("pending", "lost"):
                raise_if_failed(future, f"stage {INTERSECT}, {batch.name}")
        return moved

    def _leave_lost_workers(self) -> None:
        """Offer batches again whose workers have gone, are silent, or will not start them."""
        seen = self.workers.seen
        for batch in self.batches.at(Place.CASTING, Place.CAST):
            if batch.worker not in seen.members:
                self._lost(batch, died=batch.place is Place.CASTING)
            elif batch.worker in seen.silent:
                if self.workers.slots:
                    self._lost(batch, died=False)
            elif batch.worker not in seen.free and batch.place is Place.CASTING:
                task = seen.tasks.get(batch.future.key) if batch.future else None
                # "no-worker": not even sent there, as the worker was paused before.
                if task and task.state in ("no-worker", "processing") and not task.started:
                    self._again(batch, "its worker takes no tasks")

    def _lost(self, batch: Batch, died: bool) -> None:
        alone = not any(
            other.worker == batch.worker
            for other in self.batches.at(Place.CASTING)
            if other is not batch
        )
        self._again(batch, "its worker died" if died else "its worker is gone or silent")
        if died:
            self._note_death(batch, INTERSECT, alone)

    def _leave_late(self) -> None:
        """Offer batches again that take far longer than others."""
        now = time.monotonic()
        usual = statistics.median(self._seconds) if self._seconds else 0.0
        late = max(LATE_S, LATE_FACTOR * usual)
        for batch in self.batches.at(Place.CASTING, Place.COLLECTING):
            others = len(self.workers.slots) > 1 or batch.place is Place.COLLECTING
            if now - batch.since > late and others and self._seconds:
                self._again(batch, "it is late")

    def _again(self, batch: Batch, reason: str) -> None:
        """Return a batch to be cast again."""
        if batch.future is not None:
            batch.future.cancel()
            batch.future = None
        batch.to(Place.WAITING, time.monotonic())
        self._count_again(batch, reason)

    def _count_again(self, batch: Batch, reason: str) -> None:
        self.offered_again += 1
        self._trace("replay", INTERSECT, batch.scans, reason=reason)

    # -- poison batches ----------------------------------------------------------------------

    def _note_death(self, batch: Batch, stage: str, alone: bool) -> None:
        """Count the death of a worker against its batches.

        A batch with two deaths is tried alone. An innocent batch succeeds; one whose worker dies
        again is divided, down to single scans. A scan is the cause if several workers in a row
        die with it alone.
        """
        batch.deaths[stage] += 1
        if stage not in batch.suspects:
            if batch.deaths[stage] >= SUSPECT_DEATHS:
                batch.suspects.add(stage)
            return
        if not alone:
            return
        if batch.stop - batch.first > 1:
            for piece in self.batches.split(batch):
                piece.to(Place.WAITING, time.monotonic())
            return
        batch.kills[stage] += 1
        if batch.kills[stage] >= KILLS_MOST:
            self.batches.remove(batch)
            where = self._gpu if stage == INTERSECT else self._lidar
            self._condemned.append(
                f"{batch.name} kills the worker that runs stage {stage}: {KILLS_MOST} workers "
                "died, one after the other, with no other scan in that stage"
                f"{words_on_memory(self.client, [batch.worker])}. Look into the logs of the "
                f"{where.name} workers."
            )

    # -- stage 4: collecting -----------------------------------------------------------------

    def _hand_on(self) -> bool:
        """Assign batches that were cast to collectors."""
        ready = self.batches.at(Place.CAST)
        if not ready:
            return False
        names = [n for n in self._inlets if n != SORT and self.stages.worker_of(n)]
        load = dict.fromkeys(names, 0)
        busy = self.batches.at(Place.COLLECTING)
        for batch in busy:
            if batch.collector in load:
                load[batch.collector] += 1
        if any(COLLECT in batch.suspects for batch in busy):
            return False
        suspects = [batch for batch in ready if COLLECT in batch.suspects]
        if suspects:
            ready = suspects[:1]
            if busy:
                return False
        told: dict[str, list[dict[str, Any]]] = {}  # {collector: its message}
        for batch in ready:
            room = [name for name in names if load[name] < COLLECTING]
            if not room:
                break
            near = [n for n in room if _host(self.stages.worker_of(n)) == _host(batch.worker)]
            name = min(near or room, key=lambda n: (load[n], n))
            load[name] += 1
            told.setdefault(name, []).append(self._collect(batch, name))
        for name, items in told.items():
            self._put(self._inlets[name], items)
        return bool(told)

    def _collect(self, batch: Batch, name: str) -> dict[str, Any]:
        """Assign a batch to a collector; returns the message to it."""
        assert batch.future is not None
        batch.collector = name
        batch.to(Place.COLLECTING, time.monotonic())
        self._trace("handon", COLLECT, batch.scans)
        return {
            "key": batch.future.key,
            "at": batch.worker,
            "first": batch.first,
            "stop": batch.stop,
            "name": part_name(self._mark, batch.first, batch.stop),
        }

    def _take_receipts(self) -> bool:
        answers = self._inbox.pop(self._receipts.name, [])
        receipts: list[Receipt] = []
        for answer in answers:
            if "failed" in answer:
                raise self._unwritable(answer["failed"])
            if "hidden" in answer:
                self._hidden.append(answer["hidden"])
                continue
            if "lost" in answer:
                # A replaced collector may report a batch that was offered again.
                for batch in self.batches.at(Place.COLLECTING):
                    if batch.future is not None and batch.future.key == answer["lost"]:
                        self._again(batch, "its columns could not be fetched")
                continue
            receipt = Receipt.from_wire(answer["receipt"])
            if receipt.held_at and not self._fetch_held(receipt):
                continue
            receipts.append(receipt)
        if receipts:
            self._commit(receipts)
        return bool(answers)

    def _fetch_held(self, receipt: Receipt) -> bool:
        """Write a part from a worker that does not see the storage."""
        data = take_held(self.client, receipt.held_at, receipt.name)
        if data is None:
            for batch in self.batches.within(receipt.first, receipt.stop):
                if batch.place is Place.COLLECTING:
                    self._again(batch, "its part was lost")
            return False
        try:
            self._storage.write(receipt.name, data)
        except OSError as error:
            raise self._unwritable(error.strerror or str(error)) from error
        return True

    def _unwritable(self, reason: str) -> LidarpoolError:
        return LidarpoolError(
            f"The points cannot be kept in {self._storage.url} ({reason}): make room there, or "
            "give another place with --parts."
        )

    def _commit(self, receipts: list[Receipt]) -> None:
        new = self._db.commit(receipts)
        for receipt in new:
            self._trace("points", COLLECT, range(receipt.first, receipt.stop))
            self._learn(receipt.records)
            for batch in self.batches.within(receipt.first, receipt.stop):
                self.batches.remove(batch)
        if new:
            self._have_sorted(new)
            self._on_parts(new)

    def _learn(self, records: Sequence[TaskRecord]) -> None:
        """Record tasks of stage 2, and advise stage 1 on the scans in one item."""
        for record in records:
            self.book.add(record)
            if record.stage == INTERSECT:
                self._seconds.append(record.seconds)
                self._scans.advise(self._wished_scans(record))

    def _wished_scans(self, last: TaskRecord) -> int:
        """Choose how many scans an item should have: at most twice as many as the last."""
        rays_per_scan = max(1, self.survey.ray_count // self.survey.scan_count)
        slots = self.workers.slot_count
        most = min(BATCH_RAYS // rays_per_scan, self.survey.scan_count // (BATCHES_LEAST * slots))
        per_scan = max(last.seconds, 1e-6) / last.items
        return max(1, min(int(BATCH_SECONDS / per_scan), 2 * last.items, most))

    # -- stage 3: frames in order --------------------------------------------------------------

    def _take_frames(self) -> bool:
        items = self._inbox.pop(self._frames.name, [])
        for item in items:
            summaries = np.frombuffer(item["data"], self._summary)
            scans = range(item["first"], item["first"] + len(summaries))
            self._sorted_at = time.monotonic()
            for scan, summary in zip(scans, summaries, strict=True):
                if scan == self._db.frames:
                    self._hand_out(scan, summary)
        return bool(items)

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

    @property
    def _pipes(self) -> list[Pipe]:
        return [self._scans, self._receipts, self._frames, *self._inlets.values()]

    def stop(self, reason: str) -> None:
        """End all stages at once; `finish` does the rest."""
        self.client.cancel([batch.future for batch in self.batches if batch.future is not None])
        for pipe in self._pipes:
            with suppress(PipeFailed):  # not made yet, or gone already
                pipe.fail(reason)

    def finish(self) -> None:
        """Wait a moment for the stages to end, and clean up the scheduler."""
        try:
            deadline = (self._closed_at or time.monotonic()) + LAST_WORDS_S
            while not self.stages.done and time.monotonic() < deadline:
                time.sleep(0.01)
            self._take_last_records()
        finally:
            forget_pipes(self.client, [pipe.name for pipe in self._pipes])
            self.stages.forget_lock()
            # In one message: the answer to a second one could miss a client that leaves.
            self.client.cancel([*self.stages.futures.values(), *self.workers.futures])
            self.workers.release()
            self.batches.clear()
            with suppress(OSError):
                self._storage.remove([self._probe[0]])

    def _take_last_records(self) -> None:
        """Collect the stages' records; those of unreachable workers are left out."""
        ended = [f for f in self.stages.futures.values() if f.status == "finished"]
        found = fetch_available(self.client, [future.key for future in ended])
        for future in ended:
            if future.key in found:
                self.book.add(found[future.key])


def _host(address: str) -> str:
    """Host of a worker's address."""
    return address.rpartition("/")[2].rpartition(":")[0]
