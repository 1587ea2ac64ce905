"""Scans between stage 1 and their arrival, in the batches in which they travel."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from distributed import Future

from poolpart import Ledger

from .stage_names import COLLECT, INTERSECT, SORT

PIECES = 16  # a batch in which something is wrong is divided into so many

Wire = Sequence[Sequence[float]]  # scans as `ScanSpec.wire` describes them


@dataclass(eq=False)
class Cast:
    """One submission of a batch to stage 2; a batch may have several.

    `worker` is the only one that it may run on, None where Dask chooses.
    """

    batch: Future
    frames: Future
    worker: str | None
    since: float  # time.monotonic() of its submission
    reachable: bool = True  # false while all that have it give no sign of life

    def result(self, stage: str) -> Future:
        """Return what a stage is given of it: the frames have a key of their own."""
        return self.frames if stage == SORT else self.batch


@dataclass(eq=False)
class Item:
    """One batch between stage 1 and its arrival.

    Parameters
    ----------
    wire
        Its scans.
    left
        {stage: scans that have not come out of it}; stages that have nothing left are gone.
    """

    wire: Wire
    left: dict[str, int]
    casts: list[Cast] = field(default_factory=list)
    counted: bool = False  # among the scans that stage 2 has finished
    handed_on: set[str] = field(default_factory=set)  # stages whose pipe it was put into
    puts: Counter[str] = field(default_factory=Counter)  # {stage: how often it was put there}
    losses: Counter[str] = field(default_factory=Counter)  # {stage: deaths while it was there}
    suspect: set[str] = field(default_factory=set)  # stages whose workers it may have killed
    kills: Counter[str] = field(default_factory=Counter)  # {stage: deaths with nothing else there}

    def __post_init__(self) -> None:
        self.scans = [int(numbers[0]) for numbers in self.wire]

    def __repr__(self) -> str:
        return f"<{self.name}, left {self.left}>"

    @property
    def name(self) -> str:
        """Its scans, for people."""
        first, last = self.scans[0], self.scans[-1]
        return f"scan {first}" if first == last else f"scans {first} to {last}"

    def ready(self, stage: str) -> Future | None:
        """Return the result for a stage, of any of the casts; None while there is none."""
        for cast in self.casts:
            future = cast.result(stage)
            if cast.reachable and future.status == "finished":
                return future
        return None

    @property
    def running(self) -> bool:
        """Whether stage 2 has yet to make something of it that is wanted."""
        return INTERSECT in self.suspect or any(self.ready(stage) is None for stage in self.left)

    def waits_in(self, stage: str) -> bool:
        """Whether a stage was given it and has not delivered all of it."""
        return stage in self.handed_on and stage in self.left


class UnderWay:
    """The batches under way, and which scan is in which.

    Parameters
    ----------
    frames, points
        What has arrived from stage 3 and from stage 4.
    """

    def __init__(self, frames: Ledger, points: Ledger) -> None:
        self._ledgers = {SORT: frames, COLLECT: points}
        self._items: dict[Item, None] = {}  # a set that keeps its order
        self._item_of: dict[int, Item] = {}  # {scan: its batch}
        self.condemned: list[str] = []  # why scans cannot be done

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[Item]:
        return iter(list(self._items))

    def __contains__(self, item: Item) -> bool:
        return item in self._items

    def missing(self, scan: int) -> frozenset[str]:
        """Stages from which a scan has not arrived."""
        return frozenset(stage for stage, ledger in self._ledgers.items() if scan not in ledger)

    def add(self, wire: Wire) -> list[Item]:
        """Enter scans; those that want the same stages, one after the other, are one batch.

        Scans that have arrived both ways are left out. After a resume some have their points
        and no frame, or the other way round.
        """
        runs: list[tuple[frozenset[str], list[Sequence[float]]]] = []
        for numbers in wire:
            stages = self.missing(int(numbers[0]))
            if runs and runs[-1][0] == stages:
                runs[-1][1].append(numbers)
            else:
                runs.append((stages, [numbers]))
        items = [Item(run, dict.fromkeys(stages, len(run))) for stages, run in runs if stages]
        for item in items:
            self._items[item] = None
            self._item_of.update(dict.fromkeys(item.scans, item))
        return items

    def arrived(self, stage: str, scan: int) -> None:
        """Note the first arrival of a scan from a stage."""
        item = self._item_of.get(scan)
        if item is None or stage not in item.left:
            return
        item.left[stage] -= 1
        if not item.left[stage]:
            del item.left[stage]

    def give_up(self, stage: str) -> None:
        """Expect nothing from a stage any more."""
        for item in self._items:
            item.left.pop(stage, None)

    def release(self) -> list[Item]:
        """Let go of the batches that have arrived; returns them."""
        done = [item for item in self._items if not item.left]
        for item in done:
            self._forget(item)
        return done

    def split(self, item: Item) -> list[Item]:
        """Divide a batch into smaller ones, as suspect as it was, that are not cast yet."""
        self._forget(item)
        size = -(-len(item.wire) // PIECES)
        pieces = []
        for start in range(0, len(item.wire), size):
            for piece in self.add(item.wire[start : start + size]):
                piece.suspect, piece.counted = set(item.suspect), item.counted
                pieces.append(piece)
        return pieces

    def condemn(self, item: Item, reason: str) -> None:
        """Give a batch up for good."""
        self._forget(item)
        self.condemned.append(reason)

    def clear(self) -> None:
        """Let go of all."""
        self._items.clear()
        self._item_of.clear()

    def _forget(self, item: Item) -> None:
        del self._items[item]
        for scan in item.scans:
            self._item_of.pop(scan, None)
