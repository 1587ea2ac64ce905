"""Batches under way: consecutive uncommitted scans, and where they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

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

    first: int
    stop: int
    number: int  # of earlier batches: limits how far the last is ahead of the first
    place: Place = Place.WAITING
    since: float = 0.0  # since when it is in its state
    key: str = ""  # of the casting task; "" while waiting
    worker: str = ""  # address of the GPU worker
    collector: str = ""  # name of the task of stage 4
    deaths: Counter[str] = field(default_factory=Counter)  # {stage: workers that died with it}

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def scans(self) -> range:
        """Numbers of its scans."""
        return range(self.first, self.stop)

    @property
    def name(self) -> str:
        """Its scans, for messages."""
        last = self.stop - 1
        return f"scan {last}" if self.first == last else f"scans {self.first} to {last}"

    def to(self, place: Place, now: float) -> None:
        """Record its new state."""
        self.place, self.since = place, now


class Batches:
    """The batches under way, in the order in which they were taken."""

    def __init__(self) -> None:
        self._batches: dict[int, Batch] = {}  # {first scan: batch}
        self._taken = 0

    def __len__(self) -> int:
        return len(self._batches)

    def __iter__(self) -> Iterator[Batch]:
        return iter(list(self._batches.values()))

    @property
    def span(self) -> int:
        """How many batches the newest is ahead of the oldest."""
        numbers = [batch.number for batch in self._batches.values()]
        return self._taken - min(numbers) if numbers else 0

    def at(self, *places: Place) -> list[Batch]:
        """Batches in some states."""
        return [batch for batch in self._batches.values() if batch.place in places]

    def add(self, first: int, stop: int) -> Batch:
        """Take scans."""
        batch = self._batches[first] = Batch(first, stop, self._taken)
        self._taken += 1
        return batch

    def remove(self, batch: Batch) -> None:
        """Remove a batch, which must be there."""
        del self._batches[batch.first]

    def postpone(self, batch: Batch) -> None:
        """Put a batch behind the others."""
        self._batches[batch.first] = self._batches.pop(batch.first)

    def within(self, first: int, stop: int) -> list[Batch]:
        """Batches whose scans are all among these."""
        return [b for b in self._batches.values() if first <= b.first and b.stop <= stop]

    def split(self, batch: Batch, deaths: Counter[str]) -> None:
        """Divide a batch into smaller ones, which wait, with so many deaths each by stage."""
        self.remove(batch)
        size = -(-len(batch) // PIECES)
        for first in range(batch.first, batch.stop, size):
            stop = min(first + size, batch.stop)
            self._batches[first] = Batch(first, stop, batch.number, deaths=deaths.copy())
