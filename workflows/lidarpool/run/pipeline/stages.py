"""Stages 1, 3 and 4: the long-running tasks on LIDAR workers.

Each secedes at once: it frees its thread but keeps its slot, so that a worker with one thread and
four LIDAR slots runs all four. A failed pipe ends a stage silently: the driver knows the reason.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

from distributed import Client, secede

from lidarsim.base.storage import Storage
from lidarsim.sensor import Survey
from poolpart import Pipe, PipeClosed, PipeFailed
from poolpart.fetch import fetch_available, hold_for_driver
from poolpart.task_context import telling_departure

from ...columns.parts import pack
from .failures import ScanError, naming_scans, storing
from .messages import (
    CollectOrder,
    ColumnsLost,
    Description,
    Failed,
    Receipt,
    ScanRange,
    Scans,
    StageStart,
    Summaries,
)
from .names import COLLECT, GENERATE, LIDAR
from .placement import Recorder, TaskRecord
from .rigs import CastBatch

TELL_EVERY_S = 0.05  # messages that follow each other so fast travel together
LINGER_S = 0.02  # the sorter waits so long for more
FETCH_PATIENCE_S = 2.0  # longest wait for a sign of life of a batch's worker


def _work(
    me: StageStart, inlet: Pipe, do: Callable[[Iterator[Any]], Iterable[int]], linger_s: float = 0.0
) -> TaskRecord:
    """Do what the driver sends until a pipe is closed; `do` yields how many scans are done.

    Once there is something, it waits `linger_s` for more.
    """
    recorder = Recorder(me.stage, LIDAR)
    scans = 0
    me.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            for count in do(chain.from_iterable(inlet.get_all(linger_s=linger_s))):
                scans += count
    return recorder.done(scans)


def _tell(
    me: StageStart, outlet: Pipe, news: Iterable[Scans | ColumnsLost | Failed], most: int = 0
) -> Iterator[int]:
    """Send news to the driver, those that follow each other quickly together, at most so many.

    Without a limit, the driver limits its orders. Yields of how many scans it has told.
    """
    waiting: list[Scans | ColumnsLost | Failed] = []

    def send() -> int:
        outlet.put_many(waiting, unbounded=not most)
        done = [item.scans for item in waiting if isinstance(item, Scans)]
        for scans in done:
            me.trace("sent", scans)
        waiting.clear()
        return sum(map(len, done))

    told = time.monotonic()
    for item in news:
        waiting.append(item)
        if len(waiting) == most or time.monotonic() - told > TELL_EVERY_S:
            yield send()
            told = time.monotonic()
    yield send()


@telling_departure()
def generate(me: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Stage 1: describe the scans of surveys, one after the other, the advised number in one item.

    From the driver come lists of `Description`. An item is a `ScanRange`: the survey describes the
    scans equally on every worker. A survey that cannot be described is reported as `Failed`.
    """
    secede()
    return _work(
        me, inlet, lambda wanted: _tell(me, outlet, _described(me, wanted, outlet), outlet.capacity)
    )


def _described(
    me: StageStart, wanted: Iterable[Description], outlet: Pipe
) -> Iterator[ScanRange | Failed]:
    for one in wanted:
        sent = one.first
        try:
            with naming_scans(sent, sent + 1):
                survey: Survey = pickle.loads(one.survey)  # noqa: S301 - of the run's own driver
            while sent < one.stop:
                item = ScanRange(one.job, sent, min(sent + outlet.advice, one.stop))
                with naming_scans(item.first, item.stop):
                    survey.scan(item.stop - 1)  # raises here if a scan cannot be described
                me.trace("put", item.scans)
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
    orders: dict[int, _Order] = {}  # {job: where its survey is}

    def sort(news: Iterator[Summaries]) -> Iterator[int]:
        ready = []
        for item in news:
            me.trace("get", item.scans)
            order = orders.setdefault(item.job, _Order())
            ready += order.take(item)
            if order.following >= item.until:
                del orders[item.job]
        if ready:
            scans = [*chain.from_iterable(item.scans for item in ready)]
            me.trace("put", scans)
            outlet.put_many(ready, unbounded=True)
            me.trace("sent", scans)
            yield len(scans)

    # Each answer wakes the driver.
    return _work(me, inlet, sort, linger_s=LINGER_S)


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
    there = storage if storage.sees(*probe) else None

    def store(orders: Iterator[CollectOrder]) -> Iterator[int]:
        # The pipe's client: `own_client` makes a message to the scheduler each time.
        news = (_collected(me, there, order, inlet.client) for order in orders)
        return _tell(me, outlet, chain.from_iterable(news))

    return _work(me, inlet, store)


def _collected(
    me: StageStart, storage: Storage | None, order: CollectOrder, client: Client
) -> Iterator[Receipt | ColumnsLost | Failed]:
    """Make the parts of a casting task; gives the messages to the driver."""
    found = fetch_available(client, [order.key], FETCH_PATIENCE_S, at=order.worker)
    if order.key not in found:
        yield ColumnsLost(order.key)
        return
    batches = {(batch.job, batch.part.first): batch for batch in found[order.key]}
    for job, (first, stop), name in order.parts:
        batch: CastBatch = batches[job, first]
        scans = range(first, stop)
        me.trace("get", scans)
        try:
            with naming_scans(first, stop):
                data = pack(batch.part)
                receipt = Receipt.of_part(batch.part, job, name, len(data), batch.record)
            me.trace("part", scans)
            if storage is None:
                yield replace(receipt, held_at=hold_for_driver(name, data))
                continue
            with storing(storage):
                storage.write(name, data)
            me.trace("stored", scans)
            yield receipt
        except ScanError as error:
            yield Failed(job, COLLECT, str(error))
