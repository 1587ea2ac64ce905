"""The driver's side of the survey: it feeds the stages, keeps the ledger, sends again.

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
from dataclasses import dataclass, field
from typing import Any

from distributed import Client, Future

from poolpart import (
    Ledger,
    Partition,
    Pipe,
    PipeFailed,
    TaskRecord,
    fetch_available,
    forget_pipes,
    trace,
)

from ..errors import LidarpoolError
from ..survey import Survey
from .builder import CloudBuilder
from .casting import frames_of, intersect
from .messages import Attempt, Delivery, Frame, FrameRun, Hello, Part
from .setup import SurveySetup
from .stage_names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR, SORT
from .stage_tasks import Command, StageTasks, was_killed
from .stages import collect, generate, sort_frames

BATCH_SECONDS = 0.05  # casting time that makes a batch worth its overhead
BATCH_RAYS = 1_000_000  # bounds a batch's memory, at 16 bytes a hit and 24 a direction
STALL_SECONDS = 20.0  # with nothing moving; then what was handed on is sent again
LOOK_FOR_WORKERS_S = 1.0
LAST_WORDS_S = 3.0  # for the stages to end after everything has arrived
DELIVERY_CAPACITY = 16  # messages of at most `stages.DELIVERY_BYTES` on their way to the driver


@dataclass(eq=False)
class _UnderWay:
    """One batch between stage 1 and its arrival."""

    scans: list[int]
    batch: Future
    frames: Future
    handed_on: set[str] = field(default_factory=set)  # stages whose pipe it was put into
    waiting_for: set[str] = field(default_factory=lambda: {SORT, COLLECT})


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
        Where the points go, with those that an earlier run has delivered.
    frames_done
        Frames that an earlier run has delivered: those of scans 0 to frames_done - 1.
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
    ) -> None:
        self.client, self.partitions, self.survey = client, partitions, survey
        self.on_frame = on_frame
        self.run_id = uuid.uuid4().hex[:8]
        self.cloud = CloudBuilder(survey.scan_count) if cloud is None else cloud
        self.frames = Ledger(survey.scan_count)
        self.generated = Ledger(survey.scan_count)
        self.frames.restore(range(frames_done))
        self._resumed = Ledger(survey.scan_count)  # scans that an earlier run has done both ways
        self._resumed.restore(s for s in range(frames_done) if s in self.cloud.ledger)
        self.generated.restore(s for s in range(frames_done) if s in self._resumed)
        self.cast = self._resumed.delivered  # scans that stage 2 has finished
        self.replayed = 0  # batches that were put into a pipe once more
        self.records: list[TaskRecord] = []

        slots = max(1, partitions[GPU].slots)
        self._running_most = 2 * slots + 2
        self._under_way_most = self._running_most + 2 * queue_capacity
        rays_per_scan = max(1, survey.ray_count // survey.scan_count)
        self._batch_most = max(
            1, min(BATCH_RAYS // rays_per_scan, survey.scan_count // (16 * slots))
        )
        self._under_way: list[_UnderWay] = []
        self._recorded: set[TaskRecord] = set()
        self._greeted: set[str] = set()  # consumers that have started, once or more
        self._collectors = collectors
        self._moved_at = time.monotonic()  # when something was last handed on or delivered
        self._closed_at: float | None = None  # when all had arrived and the pipes were closed

        def pipe(name: str, capacity: int) -> Pipe:
            return Pipe(f"lidarpool-{self.run_id}-{name}", capacity, client)

        # With room for what is under way, and for all of it once more: puts never wait.
        room = 2 * (self._under_way_most + queue_capacity)
        self._scans = pipe("scans", queue_capacity)
        self._inlets = {stage: pipe(stage, room) for stage in (SORT, COLLECT)}
        self._deliveries = pipe("deliveries", DELIVERY_CAPACITY)
        self._pipes = (self._scans, self._deliveries, *self._inlets.values())
        self._arguments = setup.__reduce__()[1]
        self._setup: Future | None = None
        self._prepared: dict[str, Future] = {}  # {address of a GPU worker: task that readies it}
        self._stages = StageTasks(client, partitions[LIDAR], self._key, self._commands())

    def start(self) -> None:
        """Make the pipes and start the stages; after this `stop` and `finish` must be called."""
        for pipe in self._pipes:
            pipe.create()
        gpu = self.partitions[GPU]
        self._setup = gpu.submit(_make_setup, *self._arguments, key=self._key("scene"))
        self._stages.start()
        self._prepare_workers()

    def _key(self, name: str, number: int | None = None) -> str:
        return f"{name}-{self.run_id}" + ("" if number is None else f"-{number}")

    def _commands(self) -> dict[str, Command]:
        survey, out = self.survey, self._deliveries
        cloud = (survey.sensor, survey.keep_every, survey.precision_m)

        def attempt(name: str, number: int) -> Attempt:
            return Attempt(self.run_id, name, number)

        def generator(number: int) -> tuple[Callable[..., Any], tuple[Any, ...]]:
            first = self.generated.first_missing
            return generate, (attempt(GENERATE, number), survey, self._scans, first)

        def sorter(number: int) -> tuple[Callable[..., Any], tuple[Any, ...]]:
            return sort_frames, (attempt(SORT, number), self._inlets[SORT], out)

        def collector(which: int) -> Command:
            name = f"{COLLECT}-{which}"
            return lambda number: (
                collect,
                (attempt(name, number), *cloud, self._inlets[COLLECT], out),
            )

        commands: dict[str, Command] = {GENERATE: generator, SORT: sorter}
        commands |= {f"{COLLECT}-{number}": collector(number) for number in range(self._collectors)}
        return commands

    def _prepare_workers(self) -> None:
        """Have each GPU worker that is new fetch the scene and build its ray caster.

        Dask runs a task where its inputs are, unless the wait there is longer than it takes to
        move them. Scans are so short that it would leave all of them to the one worker that
        has the scene, and a worker that was restarted would never get one.
        """
        self._looked_for_workers = time.monotonic()
        here = {worker.address for worker in self.partitions[GPU].workers}
        for address in here - self._prepared.keys():
            self._prepared[address] = self.partitions[GPU].submit(
                _prepare,
                self._setup,
                key=self._key("prepare", len(self._prepared)),
                priority=10,
                worker=address,
            )

    # -- one turn ----------------------------------------------------------------------

    @property
    def complete(self) -> bool:
        """Whether every frame and every point has arrived."""
        return self.frames.complete and self.cloud.ledger.complete

    @property
    def finished(self) -> bool:
        """Whether, after that, the stages have ended, or a moment has gone by.

        A stage whose worker died in the last moment has nothing left to do, and is not waited
        for.
        """
        if self._closed_at is None:
            return False
        return self._stages.done or time.monotonic() - self._closed_at > LAST_WORDS_S

    def step(self) -> bool:
        """Do what can be done now; returns whether anything was.

        Raises
        ------
        LidarpoolError
            If a task of the survey has failed, naming stage and scans.
        """
        self._check_tasks()
        moved = self._take_deliveries()
        if self._closed_at is not None:  # last words only
            return moved
        if time.monotonic() - self._looked_for_workers > LOOK_FOR_WORKERS_S:
            self._prepare_workers()
        self._stages.look(self.frames.delivered + self.cloud.ledger.delivered)
        moved |= self._hand_on()
        moved |= self._take_scans()
        if self.complete:
            for inlet in self._inlets.values():
                inlet.close()
            self._closed_at = time.monotonic()
        elif self._under_way and time.monotonic() - self._moved_at > STALL_SECONDS:
            for stage, inlet in self._inlets.items():
                if not inlet.depth:  # else it is not lost, but waits for a reader
                    self._send_again(stage)
            self._moved_at = time.monotonic()
        return moved

    def _check_tasks(self) -> None:
        for name, future in self._stages.futures.items():
            if not (future.status == "error" and was_killed(future)):
                _raise_if_failed(future, f"stage {name}")
        for future in (self._setup, *self._prepared.values()):
            if future is not None:
                _raise_if_failed(future, "preparing the scene on the GPU workers")
        for item in self._under_way:
            for future in (item.batch, item.frames):
                _raise_if_failed(
                    future, f"stage {INTERSECT}, scans {item.scans[0]} to {item.scans[-1]}"
                )

    def _take_scans(self) -> bool:
        """Submit a stage-2 task for each item of stage 1, as far as the credit goes."""
        running = sum(not item.handed_on for item in self._under_way)
        if running >= self._running_most or len(self._under_way) >= self._under_way_most:
            return False
        items = self._scans.poll()
        for item in items:
            # A generator that was run again describes scans again.
            wire, known = [], []
            for numbers in item:
                scan = int(numbers[0])
                if scan in self._resumed:
                    continue  # it is described all the same: the generator knows only a start
                if self.generated.accept(scan):
                    wire.append(numbers)
                else:
                    known.append(scan)
            self._trace("take", GENERATE, [int(numbers[0]) for numbers in wire])
            self._trace_duplicates(GENERATE, known)
            if wire:
                self._submit(wire)
        return bool(items)

    def _submit(self, wire: Sequence[Sequence[float]]) -> None:
        gpu, first = self.partitions[GPU], int(wire[0][0])
        key = self._key(INTERSECT, first)
        batch = gpu.submit(intersect, self._setup, wire, self.run_id, key=key)
        frames = gpu.submit(frames_of, batch, key=self._key("frames", first), priority=1)
        scans = [int(numbers[0]) for numbers in wire]
        self._trace("submit", INTERSECT, scans)
        self._under_way.append(_UnderWay(scans, batch, frames))

    def _hand_on(self) -> bool:
        """Put what stage 2 has finished into the pipes of stages 3 and 4."""
        moved = False
        for stage, inlet in self._inlets.items():
            ready = [
                item
                for item in self._under_way
                if stage not in item.handed_on and _result_of(item, stage).status == "finished"
            ]
            if ready:
                self._put(stage, inlet, ready)
                moved = True
                if stage == COLLECT:
                    self.cast += sum(len(item.scans) for item in ready)
        return moved

    def _put(self, stage: str, inlet: Pipe, items: Sequence[_UnderWay]) -> None:
        keys = [_result_of(item, stage).key for item in items]
        inlet.put({"base": self.frames.first_missing, "keys": keys}, timeout_s=STALL_SECONDS)
        for item in items:
            item.handed_on.add(stage)
            self._trace("handon", stage, item.scans)
        self._moved_at = time.monotonic()

    def _trace(self, event: str, stage: str, scans: Sequence[int]) -> None:
        trace(f"driver.{event}", run=self.run_id, stage=stage, scans=list(scans))

    def _trace_duplicates(self, stage: str, scans: Sequence[int]) -> None:
        if scans:
            self._trace("duplicate", stage, scans)

    # -- what arrives ------------------------------------------------------------------

    def _take_deliveries(self) -> bool:
        deliveries = self._deliveries.poll()
        for data in deliveries:
            delivery = Delivery.from_wire(data)
            content = delivery.content
            if isinstance(content, Hello):
                self._greet(delivery.attempt)
            elif isinstance(content, FrameRun):
                self._take_frames(content)
            else:
                self._take_points(content)
        if deliveries:
            self._moved_at = time.monotonic()
            self._release_arrived()
        return bool(deliveries)

    def _take_frames(self, run: FrameRun) -> None:
        self._record(run.records)
        for frame in run.frames:
            if self.frames.accept(frame.scan):
                self._trace("frame", SORT, [frame.scan])
                self.on_frame(frame)
            else:
                self._trace_duplicates(SORT, [frame.scan])
        if run.records:
            last = run.records[-1]
            per_scan = max(last.seconds, 1e-6) / last.items
            wished = min(int(BATCH_SECONDS / per_scan), 2 * last.items, self._batch_most)
            self._scans.advise(max(1, wished))

    def _take_points(self, part: Part) -> None:
        new = self.cloud.add(part)
        self._trace("points", COLLECT, new)
        if len(new) < len(part.scans):
            self._trace_duplicates(COLLECT, sorted(set(part.scans) - set(new)))

    def _record(self, records: Iterable[TaskRecord]) -> None:
        """Keep records that are new: a batch that was fetched twice brings its own twice."""
        for record in records:
            if record not in self._recorded:
                self._recorded.add(record)
                self.records.append(record)

    def _release_arrived(self) -> None:
        still = []
        for item in self._under_way:
            if SORT in item.waiting_for and all(scan in self.frames for scan in item.scans):
                item.waiting_for.discard(SORT)
            if COLLECT in item.waiting_for and all(s in self.cloud.ledger for s in item.scans):
                item.waiting_for.discard(COLLECT)
            if item.waiting_for:
                still.append(item)
            else:
                self._trace("release", "", item.scans)
        self._under_way = still

    # -- sending again -----------------------------------------------------------------

    def _greet(self, attempt: Attempt) -> None:
        """Note that a consumer has started; the second time means that it had died meanwhile."""
        if attempt.name in self._greeted:
            self._send_again(attempt.stage)
        self._greeted.add(attempt.name)

    def _send_again(self, stage: str) -> None:
        lost = [i for i in self._under_way if stage in i.handed_on and stage in i.waiting_for]
        lost = [item for item in lost if _result_of(item, stage).status == "finished"]
        if lost:
            self.replayed += len(lost)
            self._trace("replay", stage, [scan for item in lost for scan in item.scans])
            self._put(stage, self._inlets[stage], lost)

    # -- the end -----------------------------------------------------------------------

    @property
    def duplicates_dropped(self) -> int:
        """Scans that came more than once: descriptions, frames or points."""
        ledgers = (self.generated, self.frames, self.cloud.ledger)
        return sum(ledger.duplicates for ledger in ledgers)

    def stop(self, reason: str) -> None:
        """End every stage at once; `finish` does the rest."""
        self.client.cancel([f for item in self._under_way for f in (item.frames, item.batch)])
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
            kept = [*self._stages.futures.values(), *self._prepared.values(), self._setup]
            self.client.cancel([future for future in kept if future is not None])
            self._under_way.clear()

    def _take_last_records(self) -> None:
        """Take the stages' own records; those whose worker cannot be reached are done without."""
        ended = [f for f in self._stages.futures.values() if f.status == "finished"]
        found = fetch_available(self.client, [future.key for future in ended])
        self._record(found[future.key] for future in ended if future.key in found)


def _make_setup(*arguments: Any) -> SurveySetup:
    return SurveySetup(*arguments)


def _prepare(setup: SurveySetup) -> None:
    setup.prepare()


def _result_of(item: _UnderWay, stage: str) -> Future:
    return item.frames if stage == SORT else item.batch


def _raise_if_failed(future: Future, what: str) -> None:
    if future.status == "error":
        error = future.exception(timeout=10)
        raise LidarpoolError(f"{what} failed: {error}")
    if future.status == "cancelled":  # "lost" passes: a worker died and the task runs again
        raise LidarpoolError(f"{what} was cancelled from outside this run.")
