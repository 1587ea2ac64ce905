"""The crew of a run: the workers and stages that all of its surveys share."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cloudpickle

from poolpart import TaskRecord, Whereabouts

from ..sensor import Survey
from .batches import Batch, Batches
from .failures import sending
from .long_stages import LongStages, Order, StageChanges
from .messages import (
    CollectOrder,
    Description,
    Failed,
    Message,
    Receipt,
    ScanRange,
    Span,
    Summaries,
)
from .names import GENERATE, SORT
from .policies import slots_wanted
from .rigs import RigPlan
from .workers import CastingWorkers, Outcome

WAIT_S = 0.02  # for news, where there is nothing else to do
CLOSING_S = 0.001  # longest wait while the stages end


class Seat:
    """What the driver of one survey sees of the crew: its own tasks, messages and changes.

    `folder` is that of its parts in the crew's storage, with a slash at its end; "" for all of it.
    """

    def __init__(self, crew: Crew, job: str, folder: str) -> None:
        self._crew, self.job, self._folder = crew, job, folder
        self._workers, self._stages = crew.workers, crew.stages
        self.batches, self.seconds = Batches(), crew.seconds
        self.wants_scans = False  # whether messages of stage 1 are wanted
        self.left = 0  # scans that are not committed
        self.inbox: list[Message] = []
        self.died: dict[str, str] = {}  # {name of a stage: address}, since the driver looked
        self.started: list[str] = []
        self.seen: Whereabouts | None = None  # if there is news of it

    @property
    def run(self) -> str:
        """Id of the run, for traces."""
        return self._stages.run

    @property
    def beside(self) -> Sequence[Batch]:
        """Batches of the other surveys that are under way."""
        return [b for seat in self._crew.seats if seat is not self for b in seat.batches]

    # -- stage 2 ---------------------------------------------------------------------------

    @property
    def slots(self) -> Mapping[str, int]:
        """{address of a worker that may cast: tasks at a time}."""
        return self._workers.slots

    @property
    def slot_count(self) -> int:
        """Tasks that all workers cast at a time; at least 1."""
        return self._workers.slot_count

    def cast(self, spans: Sequence[Span], worker: str) -> str:
        """Offer batches to a worker as one task; returns its key."""
        return self._workers.cast(self.job, spans, worker)

    def outcome(self, key: str, worker: str) -> Outcome:
        """State of a casting task; JobError if it has failed."""
        return self._workers.outcome(self.job, key, worker)

    def forget(self, key: str) -> None:
        """Cancel a casting task, or drop its result."""
        self._workers.forget(key)

    def learn(self, record: TaskRecord) -> None:
        """Record how long a batch took to cast."""
        self._crew.learn(record)

    def words_on_memory(self, worker: str) -> str:
        """Clause for a message about a dead worker, if a nanny ended it for its memory."""
        return self._workers.words_on_memory(worker)

    def whereabouts(self) -> Whereabouts | None:
        """Where workers and casting tasks are; None if there is no news of it."""
        seen, self.seen = self.seen, None
        return seen

    # -- the other stages --------------------------------------------------------------------

    @property
    def collector_count(self) -> int:
        """Tasks of stage 4."""
        return self._stages.collector_count

    @property
    def collectors(self) -> Mapping[str, str]:
        """{name of a running task of stage 4: address of its worker}."""
        return self._stages.collectors

    def changes(self) -> StageChanges:
        """Stages whose workers have died, and that were started, since the last call."""
        changes = StageChanges(self.died, self.started)
        self.died, self.started = {}, []
        return changes

    def describe(self, survey: Survey, first: int) -> None:
        """Have stage 1 describe the scans from `first` on; JobError if it cannot be sent there."""
        with sending():
            packed = cloudpickle.dumps(survey, protocol=5)
        self._crew.described(self.job, survey.scan_count)
        self._stages.send(GENERATE, [Description(packed, first, survey.scan_count, self.job)])

    def receive(self) -> list[Message]:
        """Messages since the last call."""
        messages, self.inbox = self.inbox, []
        return messages

    def send(self, name: str, messages: Sequence[Order]) -> None:
        """Send messages to a stage; they are lost if it is not running."""
        self._stages.send(name, [self._outward(message) for message in messages])

    def advise(self, scans: int) -> None:
        """Tell stage 1 how many scans an item should have."""
        self._stages.advise(scans)

    def take_held(self, receipt: Receipt) -> bytes | None:
        """Bytes of a part from a worker that does not see the storage; None if they are lost."""
        found: bytes | None = self._stages.take_held(
            replace(receipt, name=f"{self._folder}{receipt.name}")
        )
        return found

    def _outward(self, message: Order) -> Order:
        if isinstance(message, CollectOrder):
            parts = tuple((span, f"{self._folder}{name}") for span, name in message.parts)
            return replace(message, parts=parts, job=self.job)
        return replace(message, job=self.job)

    def take(self, message: Message) -> None:
        """Take a message for this survey."""
        if isinstance(message, Receipt):
            message = replace(message, name=message.name.removeprefix(self._folder))
        self.inbox.append(message)


class Crew:
    """The workers of stage 2 and the long stages of a run, for one survey or many.

    Each survey has a `Seat`. All that the crew asks of Dask is asked once for all of them.
    """

    def __init__(self, workers: CastingWorkers, stages: LongStages) -> None:
        self.workers, self.stages = workers, stages
        self.later = 0  # scans of surveys that have no seat yet
        self._learned = [0.0, 0]  # casting time of scans, and their number
        self._seats: dict[str, Seat] = {}
        self.seconds: deque[float] = deque(maxlen=64)  # casting times of batches
        self._running: list[str] = []  # stages that were started
        self._described: dict[str, int] = {}  # {job: scans}, in the order of stage 1, until taken

    @property
    def seats(self) -> list[Seat]:
        """The seats, in the order in which they were taken."""
        return [*self._seats.values()]

    @property
    def probe(self) -> tuple[str, bytes]:
        """Name and content of a file, by which workers find out whether they see the storage."""
        return self.stages.probe

    @property
    def notes(self) -> list[str]:
        """Notes for the user."""
        return [*self.stages.notes, *self.workers.notes]

    def open(self) -> None:
        """Start the stages; after this `stop` and `finish` must be called."""
        self.stages.open()
        self.look(0)

    def seat(self, job: str, plan: RigPlan, folder: str = "") -> Seat:
        """Take a survey on."""
        self.workers.add(job, plan)
        seat = self._seats[job] = Seat(self, job, folder)
        seat.started, seat.seen = [*self._running], self.workers.seen
        return seat

    def learn(self, record: TaskRecord) -> None:
        """Record how long a batch took to cast."""
        self.seconds.append(record.seconds)
        self._learned = [self._learned[0] + record.seconds, self._learned[1] + record.items]

    def leave(self, seat: Seat) -> None:
        """Do nothing more for a survey."""
        for batch in seat.batches:
            self.workers.forget(batch.key)
        self.workers.remove(seat.job)
        self._seats.pop(seat.job, None)
        # The sorter forgets what it has of a survey that has failed.
        self.stages.send(SORT, [Summaries(0, 0, b"", framed=1, scan_count=1, job=seat.job)])

    def described(self, job: str, scan_count: int) -> None:
        """Note that stage 1 was told to describe a survey."""
        self._described.pop(job, None)
        self._described[job] = scan_count

    def look(self, progress: int) -> None:
        """Take messages, and look after workers and stages; `progress` as of `LongStages.look`.

        LidarpoolError if a stage has failed, or workers or slots are missing for too long.
        """
        for message in self.stages.receive():
            if self._is_last_of_stage_1(message):
                self._described.pop(message.job, None)
            if (seat := self._seats.get(message.job)) is not None:  # else of one that has failed
                seat.take(message)
        seen = self.workers.look()
        if seen is not None:
            seconds, scans = self._learned
            left = self.later + sum(seat.left for seat in self.seats)
            self.workers.want(max(1, slots_wanted(left, seconds / scans if scans else None)))
        changes = self.stages.look(progress)
        if GENERATE in changes.started:
            self._described.clear()  # it is told again
        self._running = [*dict.fromkeys([*self._running, *changes.started])]
        for seat in self.seats:
            seat.seen = seen or seat.seen
            seat.died |= changes.died
            seat.started += changes.started

    def wait(self, seconds: float) -> None:
        """Wait until there may be something to do, at most so long."""
        if self.stages.closed:
            self.stages.wait(min(seconds, CLOSING_S), [], scans=False)
        else:
            self.stages.wait(max(seconds, WAIT_S), self.workers.pending, scans=self._wants_scans)

    @property
    def _wants_scans(self) -> bool:
        """Whether the next survey of stage 1 wants scans, or is none any more."""
        # Those of others are behind them in the pipe: a survey gets no more than it has room for.
        for job in self._described:
            return job not in self._seats or self._seats[job].wants_scans
        return False

    def _is_last_of_stage_1(self, message: Message) -> bool:
        if isinstance(message, ScanRange):
            return message.stop == self._described.get(message.job)
        return isinstance(message, Failed)

    # -- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """Let all stages end: everything is committed."""
        self.workers.want(0)
        self.stages.close()

    @property
    def closed(self) -> bool:
        """Whether the stages were told to end."""
        return self.stages.closed

    @property
    def ended(self) -> bool:
        """True once all stages have exited after `close`, or the shutdown timeout has elapsed."""
        return self.stages.ended

    def stop(self, reason: str) -> None:
        """End all stages at once; `finish` does the rest."""
        for seat in self.seats:
            for batch in seat.batches:
                self.workers.forget(batch.key)
        self.stages.stop(reason)

    def finish(self) -> list[TaskRecord]:
        """Wait a moment for the stages to end, and clean up scheduler and storage.

        Returns the records of the stages whose workers can be reached.
        """
        try:
            return self.stages.finish(self.workers.futures)
        finally:
            self.workers.release()
