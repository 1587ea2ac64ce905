"""Stage 4 as the driver sees it: which collector stores which batches."""

from __future__ import annotations

import time
from collections.abc import Iterable

from ..base.storage import Storage
from ..columns.parts import part_name
from . import policies
from .batches import Place
from .casting import Casting
from .failures import storing
from .long_stages import LongStages, StageChanges
from .messages import CollectOrder, ColumnsLost, Receipt
from .names import COLLECT, LIDAR


class Collecting:
    """Hands batches that were cast to collectors, and takes their receipts.

    Parts go to `storage`, where files have the run's `mark`.
    """

    def __init__(self, stages: LongStages, storage: Storage, mark: str, casting: Casting) -> None:
        self._stages, self._storage, self._mark = stages, storage, mark
        self._casting, self._batches = casting, casting.batches
        self._hidden: set[str] = set()  # addresses of LIDAR workers that do not see the storage

    @property
    def notes(self) -> list[str]:
        """Notes for the user."""
        if not self._hidden:
            return []
        return [
            f"{', '.join(sorted(self._hidden))} of partition {LIDAR} cannot see "
            f"{self._storage.url}: the driver wrote their parts"
        ]

    def hand_over(self) -> bool:
        """Assign batches that were cast to collectors."""
        if not (cast := self._batches.at(Place.CAST)):
            return False
        orders: dict[str, list[CollectOrder]] = {}  # {collector: its message}
        there = [*cast, *self._batches.at(Place.COLLECTING)]
        for task, name in policies.handovers(there, self._stages.collectors):
            parts = []
            for batch in task:
                batch.collector, job = name, batch.job
                self._batches.move(batch, Place.COLLECTING, time.monotonic())
                job.trace("handon", COLLECT, batch.scans)
                part = part_name(self._mark, job.number, batch.first, batch.stop)
                parts.append((job.number, batch.span, part))
            order = CollectOrder(task[0].key, task[0].worker, tuple(parts))
            orders.setdefault(name, []).append(order)
        for name, messages in orders.items():
            self._stages.send(name, messages)
        return bool(orders)

    def stored(self, receipts: Iterable[Receipt]) -> list[Receipt]:
        """Return the receipts whose parts are in storage; those that workers hold go there now."""
        return [receipt for receipt in receipts if not receipt.held_at or self._store(receipt)]

    def _store(self, receipt: Receipt) -> bool:
        """Write a part that its worker holds; False if it is lost."""
        self._hidden.add(receipt.held_at)
        data = self._stages.take_held(receipt)
        if data is None:
            for batch in self._batches.within(receipt.job, receipt.first, receipt.stop):
                if batch.place is Place.COLLECTING:
                    self._casting.again(batch, "its part was lost")
            return False
        with storing(self._storage):
            self._storage.write(receipt.name, data)
        return True

    def release(self, receipts: Iterable[Receipt]) -> None:
        """Remove the batches of parts that are committed."""
        waited: dict[str, float] = {}  # {collector: when it was given the first of them}
        for receipt in receipts:
            for batch in self._batches.within(receipt.job, receipt.first, receipt.stop):
                since = min(batch.since, waited.get(batch.collector, batch.since))
                waited[batch.collector] = since
                self._casting.remove(batch)
        for other in self._batches.at(Place.COLLECTING) if waited else ():
            # Those behind them had to wait.
            if other.collector in waited and other.since >= waited[other.collector]:
                self._batches.move(other, Place.COLLECTING, time.monotonic())

    def lost(self, message: ColumnsLost) -> None:
        """Have batches cast again whose columns could not be fetched."""
        # A replaced collector may report a batch that was offered again.
        for batch in self._batches.of_task(message.key):
            if batch.place is Place.COLLECTING:
                self._casting.again(batch, "its columns could not be fetched")

    def look(self, changes: StageChanges) -> None:
        """Take back the batches of a collector that died."""
        for batch in self._batches.at(Place.COLLECTING) if changes.started or changes.died else ():
            name = batch.collector
            if name in changes.died or name in changes.started:
                self._casting.again(batch, f"{name} was replaced", Place.CAST)
                if name in changes.died:
                    self._casting.blame(batch, COLLECT, changes.died[name])
