"""Batches under way: consecutive uncommitted scans of a job, and where they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

from .jobs import JobState
from .messages import Span

PIECES = 16  # a failing batch is divided into so many


class Place(Enum):
    """State of a batch."""

    WAITING = "waiting"  # to be offered to a GPU worker
    CASTING = "casting"  # offered to one
    CAST = "cast"  # its columns are on that worker
    COLLECTING = "collecting"  # assigned to a collector


@dataclass(eq=False)
class Batch:
    """Consecutive scans on their way to a part."""

    job: JobState
    first: int
    stop: int
    number: int  # of earlier batches: limits how far the last of a job is ahead of its first
    order: int = 0  # of waiting batches
    place: Place = Place.WAITING
    since: float = 0.0  # since when it is in its state
    key: str = ""  # of the casting task; "" while waiting
    worker: str = ""  # address of the GPU worker
    collector: str = ""  # name of the task of stage 4
    deaths: Counter[str] = field(default_factory=Counter)  # {stage: workers that died with it}
    divided: bool = False  # not to be cast with batches of other jobs
    share: float = field(
        init=False
    )  # how much it takes of the memory that a worker has for a casting task

    def __post_init__(self) -> None:
        self.share = len(self) / self.job.fit

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def span(self) -> Span:
        """The first scan and the end."""
        return self.first, self.stop

    @property
    def scans(self) -> range:
        """Numbers of its scans."""
        return range(self.first, self.stop)

    @property
    def name(self) -> str:
        """Its scans, for messages."""
        last = self.stop - 1
        return f"scan {last}" if self.first == last else f"scans {self.first} to {last}"


class Batches:
    """The batches of all jobs under way: by place, by job and by casting task."""

    def __init__(self) -> None:
        self._at: dict[Place, dict[Batch, None]] = {place: {} for place in Place}
        self._of: dict[int, dict[int, Batch]] = {}  # {job: {first scan: batch}}
        self._tasks: dict[str, dict[Batch, None]] = {}  # {key: its batches that are left}
        self._taken = self._ordered = 0

    def __len__(self) -> int:
        return sum(map(len, self._at.values()))

    def __iter__(self) -> Iterator[Batch]:
        return iter([batch for at in self._at.values() for batch in at])

    # -- reading ---------------------------------------------------------------------------

    def at(self, *places: Place) -> list[Batch]:
        """Batches in some states."""
        return [batch for place in places for batch in self._at[place]]

    def of(self, job: JobState) -> list[Batch]:
        """Batches of a job."""
        return [*self._of.get(job.number, {}).values()]

    def of_task(self, key: str) -> list[Batch]:
        """Batches of a casting task that are still under way."""
        return [*self._tasks.get(key, ())]

    @property
    def waiting(self) -> list[Batch]:
        """Batches that wait to be cast, in order."""
        return sorted(self._at[Place.WAITING], key=lambda batch: (batch.order, batch.first))

    @property
    def casting(self) -> dict[str, str]:
        """{key of a casting task that has not ended, as far as known: address of its worker}."""
        return {batch.key: batch.worker for batch in self._at[Place.CASTING]}

    def span(self, job: JobState) -> int:
        """How many batches the newest of all is ahead of the oldest of a job."""
        numbers = [batch.number for batch in self.of(job)]
        return self._taken - min(numbers) if numbers else 0

    def within(self, job: int, first: int, stop: int) -> list[Batch]:
        """Batches of a job whose scans are all among these."""
        there = self._of.get(job, {})
        found = there.get(first)
        if found is not None and found.stop == stop:
            return [found]
        return [b for b in there.values() if first <= b.first and b.stop <= stop]

    # -- changing --------------------------------------------------------------------------

    def add(self, job: JobState, first: int, stop: int) -> Batch:
        """Take scans."""
        batch = Batch(job, first, stop, self._taken, self._ordered)
        self._taken += 1
        self._ordered += 1
        return self._enter(batch)

    def move(self, batch: Batch, place: Place, now: float) -> None:
        """Record a batch's new state."""
        del self._at[batch.place][batch]
        batch.place, batch.since = place, now
        self._at[place][batch] = None

    def offered(self, batch: Batch, key: str, worker: str, now: float) -> None:
        """Record that a batch is being cast by a worker."""
        batch.key, batch.worker, batch.collector = key, worker, ""
        self._tasks.setdefault(key, {})[batch] = None
        self.move(batch, Place.CASTING, now)

    def forget_task(self, batch: Batch) -> str:
        """Let a batch have no casting task; returns its key if no other batch needs it, else ""."""
        key, batch.key = batch.key, ""
        left = self._tasks.get(key)
        if left is None:
            return ""
        del left[batch]
        if left:
            return ""
        del self._tasks[key]
        return key

    def remove(self, batch: Batch) -> None:
        """Remove a batch, which must be there and have no casting task."""
        del self._at[batch.place][batch]
        there = self._of[batch.job.number]
        del there[batch.first]
        if not there:
            del self._of[batch.job.number]

    def postpone(self, batch: Batch) -> None:
        """Put a batch behind the others."""
        batch.order = self._ordered
        self._ordered += 1

    def split(self, batch: Batch, deaths: Counter[str]) -> None:
        """Divide a batch into smaller ones, which wait, with so many deaths each by stage."""
        self.remove(batch)
        size = -(-len(batch) // PIECES)
        for first in range(batch.first, batch.stop, size):
            stop = min(first + size, batch.stop)
            piece = Batch(batch.job, first, stop, batch.number, batch.order, deaths=deaths.copy())
            self._enter(piece)

    def _enter(self, batch: Batch) -> Batch:
        self._at[batch.place][batch] = None
        self._of.setdefault(batch.job.number, {})[batch.first] = batch
        return batch
