"""The driver's side of the survey: it feeds the stages and keeps the ledgers.

Everything happens in `step`, called over and over from one thread; nothing in it waits for
long. Scans are under way from when they leave stage 1's pipe until both their frame and
their points have arrived here. Only so many batches are under way at a time: that bounds
every queue, the sorter's buffer and the workers' memory, and it is why no `put` of the
driver ever meets a full pipe.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from distributed import Client

from poolpart import (
    Ledger,
    Partition,
    Pipe,
    PipeFailed,
    TaskRecord,
    await_news,
    fetch_available,
    forget_pipes,
)

from ..errors import LidarpoolError
from ..survey import Survey
from ..task_book import TaskBook
from .arrivals import Arrivals
from .batch_size import wished_scans
from .builder import CloudBuilder
from .caster import Caster
from .crew import Crew
from .failures import raise_if_failed, was_killed
from .handover import Handover
from .long_stages import long_stages
from .messages import Delivery, Frame
from .setup import SurveySetup
from .stage_names import GENERATE, GPU, INTERSECT, LIDAR, SORT
from .stage_tasks import StageTasks
from .survey_run import SurveyRun
from .under_way import UnderWay, Wire

STALL_SECONDS = 20.0  # with nothing moving; then what was handed on is sent again
LAST_WORDS_S = 3.0  # for the stages to end after everything has arrived
DELIVERY_CAPACITY = 16  # messages of at most `stages.DELIVERY_BYTES` on their way to the driver


class SurveyPump:
    """Runs one survey on the partitions of a cluster.

    Parameters
    ----------
    client
        Client of the cluster.
    partitions
        The GPU and LIDAR partitions, by name.
    setup
        Scene, sensor and backend.
    survey
        What to scan.
    on_frame
        Called with each frame, in scan order, in the driver's thread.
    queue_capacity
        Items that stage 1 may be ahead.
    collectors
        Number of tasks of stage 4.
    cloud
        Takes the points; one that has some already is not asked for these again.
    frames_done
        Frames that an earlier run has handed out; this one goes on behind them.
    scans_per_second
        How fast stage 1 describes scans, as a sensor that takes its time; as fast as they are
        taken by default.
    """

    def __init__(
        self,
        client: Client,
        partitions: dict[str, Partition],
        setup: SurveySetup,
        survey: Survey,
        on_frame: Callable[[Frame], None],
        queue_capacity: int = 10,
        collectors: int = 2,
        cloud: CloudBuilder | None = None,
        frames_done: int = 0,
        *,
        scans_per_second: float | None = None,
    ) -> None:
        self.client, self.survey = client, survey
        self.run_id = uuid.uuid4().hex[:8]
        self.cloud = CloudBuilder(survey.scan_count) if cloud is None else cloud
        self.frames = Ledger(survey.scan_count)
        self.generated = Ledger(survey.scan_count)
        self.book = TaskBook()
        self._restore(frames_done)

        self._queue_capacity = queue_capacity
        self._run = run = SurveyRun(self.run_id, client, partitions[GPU], partitions[LIDAR])
        self._under_way = UnderWay(self.frames, self.cloud.ledger)
        self._crew = Crew(run, setup)
        self._caster = Caster(run, self._crew, self._under_way)
        self._handover = Handover(run, self._under_way, self.frames, queue_capacity)
        self._arrivals = Arrivals(
            run, self._under_way, self._handover, self.frames, self.cloud, on_frame, self._learn
        )
        self._scans = Pipe(f"lidarpool-{self.run_id}-scans", queue_capacity, client)
        self._deliveries = Pipe(f"lidarpool-{self.run_id}-deliveries", DELIVERY_CAPACITY, client)
        self._stages = StageTasks(
            client,
            run.lidar,
            run.key,
            long_stages(
                run,
                survey,
                collectors=collectors,
                first=lambda: self.generated.first_missing,
                pace=scans_per_second,
                scans=self._scans,
                inlet=self._handover.inlet,
                deliveries=self._deliveries,
            ),
            on_deaths=lambda names: self._handover.note_deaths([n.split("-")[0] for n in names]),
            where=self._where,
        )
        self.paused = False  # whether no more scans are taken; what is under way arrives
        self._empty: list[str] = []  # pipes in which nothing came while this waited
        self._moved_at = time.monotonic()  # when something was last handed on or delivered
        self._closed_at: float | None = None  # when all had arrived and the pipes were closed

    def _restore(self, frames_done: int) -> None:
        """Enter what an earlier run has delivered; what came both ways is not made again."""
        self.frames.restore(range(frames_done))
        done = min(self.frames.first_missing, self.cloud.ledger.first_missing)
        self.generated.restore(range(done))
        self._resumed = sum(scan in self.cloud.ledger for scan in range(frames_done))

    def start(self) -> None:
        """Make the pipes and start the stages; after this `stop` and `finish` must be called."""
        self._scans.create()
        self._deliveries.create()
        self._handover.start()
        self._crew.start()
        self._stages.start()

    # -- how far it is -----------------------------------------------------------------

    @property
    def complete(self) -> bool:
        """Whether every frame and every point has arrived."""
        return self.frames.complete and self.cloud.ledger.complete

    @property
    def idle(self) -> bool:
        """Whether no scan is under way."""
        return not self._under_way

    @property
    def finished(self) -> bool:
        """Whether, after that, the stages have ended, or a moment has gone by.

        A stage whose worker died in the last moment has nothing left to do, and is not waited
        for.
        """
        if self._closed_at is None:
            return False
        return self._stages.done or time.monotonic() - self._closed_at > LAST_WORDS_S

    @property
    def cast(self) -> int:
        """Scans that stage 2 has finished, or an earlier run both ways."""
        return self._resumed + self._handover.cast

    @property
    def waits_for(self) -> str:
        """Partition whose slots other runs hold, so that the stages cannot start; else empty."""
        return self._stages.partition.name if self._stages.waiting else ""

    @property
    def records(self) -> list[TaskRecord]:
        """Tasks of this run, of many a selection; `book` has the totals."""
        return self.book.records

    @property
    def replayed(self) -> int:
        """Batches that were put into a pipe, or cast, once more."""
        return self._handover.replayed + self._caster.recast

    @property
    def duplicates_dropped(self) -> int:
        """Scans that came more than once: descriptions, frames or points."""
        ledgers = (self.generated, self.frames, self.cloud.ledger)
        return sum(ledger.duplicates for ledger in ledgers)

    @property
    def notes(self) -> list[str]:
        """What a user should know of how it went."""
        return self._stages.notes

    def _where(self, stage: str) -> str:
        """Say for a message how far a stage had come."""
        ledgers = {GENERATE: self.generated, SORT: self.frames}
        if stage not in ledgers:
            return ""
        return f", the last times at scan {ledgers[stage].first_missing}"

    # -- one turn ----------------------------------------------------------------------

    def step(self) -> bool:
        """Do what can be done now; returns whether anything was.

        Raises
        ------
        LidarpoolError
            If a task of the survey has failed, naming stage and scans.
        """
        self._check_stages()
        empty, self._empty = self._empty, []
        moved = self._deliveries.name not in empty and self._take_deliveries()
        if self._closed_at is not None:  # last words only
            return moved
        moved |= self._caster.step()
        self._stages.look(self.frames.delivered + self.cloud.ledger.delivered)
        if self._handover.hand_on():
            moved = True
            self._moved_at = time.monotonic()
        if self._under_way.condemned:
            self._end_condemned()
        elif self._scans.name not in empty:
            moved |= self._take_scans()
        if self.complete:
            self._handover.close()
            self._closed_at = time.monotonic()
        elif self._under_way and time.monotonic() - self._moved_at > STALL_SECONDS:
            self._handover.resend()
            self._moved_at = time.monotonic()
        return moved

    def wait(self, seconds: float) -> None:
        """Wait until there may be something to do, but no longer than so."""
        if self._closed_at is not None:
            time.sleep(min(seconds, 0.001))
            return
        pipes = [self._deliveries.name]
        if self._has_room:
            pipes.append(self._scans.name)
        casts = [cast for item in self._under_way if item.running for cast in item.casts]
        futures = [future for cast in casts for future in (cast.batch, cast.frames)]
        keys = [future.key for future in futures if future.status == "pending"]
        if not await_news(self.client, seconds, pipes, keys):
            self._empty = pipes

    def _check_stages(self) -> None:
        for name, future in self._stages.futures.items():
            if not (future.status == "error" and was_killed(future)):
                raise_if_failed(future, f"stage {name}")

    def _take_scans(self) -> bool:
        """Submit a stage-2 task for each item of stage 1, as far as the credit goes."""
        self._handover.capacity = self._most + self._queue_capacity
        if not self._has_room:
            return False
        items = self._scans.poll()
        for item in items:
            wire = self._new_scans(item)
            for batch in self._under_way.add(wire):
                self._caster.submit(batch)
        return bool(items)

    @property
    def _most(self) -> int:
        """Batches that may be under way."""
        return self._caster.running_most + 2 * self._queue_capacity

    @property
    def _has_room(self) -> bool:
        """Whether more may be submitted now."""
        if self.paused or self._under_way.condemned or len(self._under_way) >= self._most:
            return False
        return self._caster.room > 0

    def _new_scans(self, item: Wire) -> Wire:
        """Leave out what a generator that was run again has described again."""
        new: list[Sequence[float]] = []
        known: list[Sequence[float]] = []
        for numbers in item:
            scan = int(numbers[0])
            (new if self.generated.accept(scan) else known).append(numbers)
        self._run.trace("take", GENERATE, (int(numbers[0]) for numbers in new))
        self._run.trace_duplicates(GENERATE, [int(numbers[0]) for numbers in known])
        return new

    def _end_condemned(self) -> None:
        """Wait for the points of what is under way, then say which scan cannot be done.

        Frames are in order, so that none comes behind one that is missing.
        """
        self._under_way.give_up(SORT)
        self._release()
        if not self._under_way or time.monotonic() - self._moved_at > STALL_SECONDS:
            raise LidarpoolError("\n".join(self._under_way.condemned))

    # -- what arrives ------------------------------------------------------------------

    def _take_deliveries(self) -> bool:
        deliveries = self._deliveries.poll()
        for data in deliveries:
            self._arrivals.take(Delivery.from_wire(data))
        if deliveries:
            self._moved_at = time.monotonic()
            self._release()
        return bool(deliveries)

    def _learn(self, records: Iterable[TaskRecord]) -> None:
        """Enter tasks of stage 2, and tell stage 1 how many scans to put into one item."""
        *_, last = records = list(records)
        self._caster.learn(record for record in records if self.book.add(record))
        self._scans.advise(wished_scans(self.survey, self._crew.slots, last))

    def _release(self) -> None:
        for item in self._under_way.release():
            self._run.trace("release", INTERSECT, item.scans)

    # -- the end -----------------------------------------------------------------------

    @property
    def _pipes(self) -> list[Pipe]:
        return [self._scans, self._deliveries, *self._handover.pipes]

    def stop(self, reason: str) -> None:
        """End every stage at once; `finish` does the rest."""
        casts = [cast for item in self._under_way for cast in item.casts]
        self.client.cancel([future for cast in casts for future in (cast.frames, cast.batch)])
        for pipe in self._pipes:
            with suppress(PipeFailed):  # not made yet, or gone already
                pipe.fail(reason)

    def finish(self) -> None:
        """Wait a moment for the stages to end, and leave nothing on the scheduler."""
        try:
            deadline = (self._closed_at or time.monotonic()) + LAST_WORDS_S
            while not self._stages.done and time.monotonic() < deadline:
                time.sleep(0.01)
            self._take_last_records()
        finally:
            forget_pipes(self.client, [pipe.name for pipe in self._pipes])
            # In one message: a client that leaves right behind a second is missed by the answer.
            self.client.cancel([*self._stages.futures.values(), *self._crew.futures])
            self._stages.give_back()
            self._under_way.clear()

    def _take_last_records(self) -> None:
        """Take the stages' own records; those whose worker cannot be reached are done without."""
        ended = [f for f in self._stages.futures.values() if f.status == "finished"]
        found = fetch_available(self.client, [future.key for future in ended])
        for future in ended:
            if future.key in found:
                self.book.add(found[future.key])
