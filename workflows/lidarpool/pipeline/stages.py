"""Stages 1, 3 and 4: the long-running tasks on LIDAR workers.

Each secedes at once: it frees its thread but keeps its slot, so that a worker with one thread and
four LIDAR slots runs all four. A failed pipe ends a stage silently: the driver knows the reason.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain

from distributed import secede

from poolpart import (
    Pipe,
    PipeClosed,
    PipeFailed,
    Recorder,
    TaskRecord,
    fetch_available,
    hold_for_driver,
    own_client,
    telling_departure,
)

from ..base.storage import Storage
from ..columns.parts import pack
from ..sensor import Survey
from .cast import CastBatch
from .failures import ScanError, naming_scans, storing
from .messages import (
    CollectOrder,
    ColumnsLost,
    Description,
    Failed,
    Receipt,
    ScanRange,
    StageStart,
    Summaries,
)
from .names import COLLECT, GENERATE, LIDAR, SORT

TELL_EVERY_S = 0.02  # messages that follow each other so fast travel together
FETCH_PATIENCE_S = 2.0  # longest wait for a sign of life of a batch's worker


@telling_departure()
def generate(me: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Stage 1: describe the scans of surveys, one after the other, the advised number in one item.

    From the driver come lists of `Description`. An item is a `ScanRange`: the survey describes the
    scans equally on every worker. A survey that cannot be described is reported as `Failed`.
    """
    secede()
    recorder = Recorder(GENERATE, LIDAR)
    scans = 0
    me.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            items: list[ScanRange | Failed] = []
            told = time.monotonic()
            for item in _described(me, chain.from_iterable(inlet.get_all()), outlet):
                items.append(item)
                if len(items) == outlet.capacity or time.monotonic() - told > TELL_EVERY_S:
                    scans += _put(me, outlet, items)
                    items, told = [], time.monotonic()
            scans += _put(me, outlet, items)
    return recorder.done(scans)


def _put(me: StageStart, outlet: Pipe, items: Sequence[ScanRange | Failed]) -> int:
    """Send descriptions to the driver; returns of how many scans."""
    outlet.put_many(items)
    sent = [range(item.first, item.stop) for item in items if isinstance(item, ScanRange)]
    for scans in sent:
        me.trace("sent", scans)
    return sum(map(len, sent))


def _described(
    me: StageStart, wanted: Iterable[Description], outlet: Pipe
) -> Iterator[ScanRange | Failed]:
    for one in wanted:
        sent = one.first
        try:
            with naming_scans(sent):
                survey: Survey = pickle.loads(one.survey)  # noqa: S301 - of the run's own driver
            while sent < survey.scan_count:
                item = ScanRange(one.job, sent, min(sent + outlet.advice, survey.scan_count))
                with naming_scans(item.first, item.stop - 1):
                    survey.scan(item.stop - 1)  # raises here if a scan cannot be described
                me.trace("put", range(item.first, item.stop))
                yield item
                sent = item.stop
        except ScanError as error:  # others can be described
            yield Failed(one.job, GENERATE, str(error))


@telling_departure()
def sort_frames(me: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Stage 3: put the summaries of the scans of each survey into scan order.

    From the driver come lists of `Summaries`, and to it goes each of them once those before it
    went, or had been handed out already, as they say. A survey is forgotten after its last scan.
    """
    secede()
    recorder = Recorder(SORT, LIDAR)
    orders: dict[int, _Order] = {}  # {job: where its survey is}
    count = 0
    me.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            ready = []
            for item in chain.from_iterable(inlet.get_all()):
                me.trace("get", item.scans)
                order = orders.setdefault(item.job, _Order())
                ready += order.take(item)
                if order.following >= item.scan_count:
                    del orders[item.job]
            if ready:
                scans = [*chain.from_iterable(item.scans for item in ready)]
                me.trace("put", scans)
                outlet.put_many(ready, unbounded=True)
                me.trace("sent", scans)
                count += len(scans)
    return recorder.done(count)


@dataclass(eq=False)
class _Order:
    """Where the sorter is in a survey."""

    following: int = 0  # the scan that comes next
    waiting: dict[int, Summaries] = field(default_factory=dict)  # {first scan: summaries}

    def take(self, item: Summaries) -> list[Summaries]:
        """Take summaries; returns those that can go on now."""
        self.following = max(self.following, item.framed)
        if item.stop > self.following:
            self.waiting[max(item.first, self.following)] = item
        ready = []
        while (found := self.waiting.pop(self.following, None)) is not None:
            ready.append(found)
            self.following = found.stop
        return ready


@telling_departure()
def collect(
    me: StageStart, storage: Storage, probe: tuple[str, bytes], inlet: Pipe, outlet: Pipe
) -> TaskRecord:
    """Stage 4: fetch batches from the workers that cast them, and write each as a part.

    `probe` is a file in the storage, name and content: a worker that does not see it holds its
    parts in memory, and the driver fetches them. From the driver come lists of `CollectOrder`, to
    it go `Receipt`, `ColumnsLost` and `Failed`.
    """
    secede()
    recorder = Recorder(COLLECT, LIDAR)
    scans = 0
    with suppress(PipeClosed, PipeFailed):
        me.trace("start")
        there = storage if storage.sees(*probe) else None
        while True:
            answers: list[Receipt | ColumnsLost | Failed] = []
            told = time.monotonic()
            orders = [*chain.from_iterable(inlet.get_all())]
            for answer in chain.from_iterable(_collected(me, there, o) for o in orders):
                answers.append(answer)
                if time.monotonic() - told > TELL_EVERY_S:
                    scans += _send(me, outlet, answers)
                    answers, told = [], time.monotonic()
            scans += _send(me, outlet, answers)
    return recorder.done(scans)


def _send(me: StageStart, outlet: Pipe, answers: Sequence[Receipt | ColumnsLost | Failed]) -> int:
    """Send messages to the driver; returns how many scans are stored."""
    outlet.put_many(answers, unbounded=True)  # the driver limits its orders
    stored = [range(a.first, a.stop) for a in answers if isinstance(a, Receipt)]
    for scans in stored:
        me.trace("sent", scans)
    return sum(map(len, stored))


def _collected(
    me: StageStart, storage: Storage | None, order: CollectOrder
) -> Iterator[Receipt | ColumnsLost | Failed]:
    """Make the parts of a casting task; gives the messages to the driver."""
    found = fetch_available(own_client(), [order.key], FETCH_PATIENCE_S, at=order.worker)
    if order.key not in found:
        yield ColumnsLost(order.key)
        return
    batches: dict[tuple[int, int], CastBatch] = {
        (batch.job, batch.part.first): batch for batch in found[order.key]
    }
    for job, (first, stop), name in order.parts:
        me.trace("get", range(first, stop))
        try:
            yield _stored(me, storage, batches[job, first], name)
        except ScanError as error:
            yield Failed(job, COLLECT, str(error))


def _stored(me: StageStart, storage: Storage | None, batch: CastBatch, name: str) -> Receipt:
    """Make a part of a batch."""
    first, stop = batch.part.first, batch.part.stop
    with naming_scans(first, stop - 1):
        data = pack(batch.part)
        receipt = Receipt.of_part(batch.part, batch.job, name, len(data), batch.record)
    me.trace("part", range(first, stop))
    if storage is None:
        return replace(receipt, held_at=hold_for_driver(name, data))
    with storing(storage):
        storage.write(name, data)
    me.trace("stored", range(first, stop))
    return receipt
