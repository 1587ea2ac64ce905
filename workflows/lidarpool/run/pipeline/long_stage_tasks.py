"""Stages 1, 3 and 4: the long-running tasks on LIDAR workers.

Each stage secedes at once: it frees its thread but keeps its slot, so that a worker with one thread
and four LIDAR slots runs all four. A failed pipe ends a stage silently: the driver knows the
reason.
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
from lidarsim.survey.survey import Survey
from poolpart import Pipe, PipeClosed, PipeFailed
from poolpart.fetch import fetch_available, hold_bytes
from poolpart.pipe import get_advice
from poolpart.task_context import translate_leaving_errors

from ...columns.parts import pack
from .failures import ScanError, naming_scans, storing
from .rigs import CastBatch
from .stage_messages import (
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
from .stage_names import COLLECT, GENERATE, LIDAR
from .task_records import Recorder, TaskRecord

SEND_EVERY_S = 0.05  # messages that follow each other faster are sent together
LINGER_S = 0.02  # wait of the sorter for more messages
FETCH_PATIENCE_S = 2.0  # longest wait for a sign of life of a batch's worker


def _serve(
    start: StageStart,
    inlet: Pipe,
    process: Callable[[Iterator[Any]], Iterable[int]],
    linger_s: float = 0.0,
) -> TaskRecord:
    """Process the messages of the driver until a pipe is closed.

    Returns the record of the task.

    `process` gets an iterator of messages and yields the number of scans after each step. After the
    first message, `linger_s` seconds are waited for more.
    """
    recorder = Recorder(start.stage, LIDAR)
    scans = 0
    start.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            for count in process(chain.from_iterable(inlet.get_all(linger_s=linger_s))):
                scans += count
    return recorder.finish(scans)


def _send_news(
    start: StageStart,
    outlet: Pipe,
    news: Iterable[Scans | ColumnsLost | Failed],
    max_items: int = 0,
) -> Iterator[int]:
    """Send news to the driver, and yield the number of scans of each sent group.

    News that follow each other quickly are sent together, at most `max_items`. Without a limit, 0,
    the driver limits its orders.
    """
    waiting: list[Scans | ColumnsLost | Failed] = []

    def send() -> int:
        outlet.put_many(waiting, unbounded=not max_items)
        scan_ranges = [item.scans for item in waiting if isinstance(item, Scans)]
        for scans in scan_ranges:
            start.trace("sent", scans)
        waiting.clear()
        return sum(map(len, scan_ranges))

    sent_at = time.monotonic()
    for item in news:
        waiting.append(item)
        if len(waiting) == max_items or time.monotonic() - sent_at > SEND_EVERY_S:
            yield send()
            sent_at = time.monotonic()
    yield send()


@translate_leaving_errors()
def generate(start: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Stage 1: describe the scans of surveys in order.

    The driver advises the scans of an item.

    From the driver come lists of `Description`. An item is a `ScanRange`: the survey describes the
    scans equally on every worker. A survey that cannot be described is reported as `Failed`.
    """
    secede()
    return _serve(
        start,
        inlet,
        lambda descriptions: _send_news(
            start, outlet, _describe_scans(start, descriptions, outlet), outlet.capacity
        ),
    )


def _describe_scans(
    start: StageStart, descriptions: Iterable[Description], outlet: Pipe
) -> Iterator[ScanRange | Failed]:
    for description in descriptions:
        first = description.first
        try:
            with naming_scans(first, first + 1):
                survey: Survey = pickle.loads(description.survey)  # noqa: S301 - of the run's own driver
            while first < description.stop:
                item = ScanRange(
                    description.job, first, min(first + get_advice(outlet), description.stop)
                )
                with naming_scans(item.first, item.stop):
                    survey.scan(item.stop - 1)  # raises here if a scan cannot be described
                start.trace("put", item.scans)
                yield item
                first = item.stop
        except ScanError as error:  # other surveys can be described
            yield Failed(description.job, GENERATE, str(error))


@translate_leaving_errors()
def sort_frames(start: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Stage 3: put the summaries of the scans of each survey into scan order.

    From the driver come lists of `Summaries`. Each is sent back to the driver once all earlier
    scans were sent back, or had been handed out before (`Summaries.framed`). A survey is forgotten
    after its last scan.
    """
    secede()
    orders: dict[int, _ScanOrder] = {}  # {job: its waiting summaries}

    def sort(news: Iterator[Summaries]) -> Iterator[int]:
        ready = []
        for item in news:
            start.trace("get", item.scans)
            order = orders.setdefault(item.job, _ScanOrder())
            ready += order.add(item)
            if order.next_scan >= item.until:
                del orders[item.job]
        if ready:
            scans = [*chain.from_iterable(item.scans for item in ready)]
            start.trace("put", scans)
            outlet.put_many(ready, unbounded=True)
            start.trace("sent", scans)
            yield len(scans)

    # Each answer wakes the driver.
    return _serve(start, inlet, sort, linger_s=LINGER_S)


@dataclass(eq=False)
class _ScanOrder:
    """Summaries of a survey that wait for earlier scans."""

    next_scan: int = 0
    waiting: dict[int, Summaries] = field(default_factory=dict)  # {first scan: summaries}

    def add(self, item: Summaries) -> list[Summaries]:
        """Add summaries, and return the summaries that are next in scan order, if there are any."""
        self.next_scan = max(self.next_scan, item.framed)
        if item.stop > self.next_scan:
            self.waiting[max(item.first, self.next_scan)] = item
        ready = []
        while (summaries := self.waiting.pop(self.next_scan, None)) is not None:
            ready.append(summaries)
            self.next_scan = summaries.stop
        return ready


@translate_leaving_errors()
def collect(
    start: StageStart, storage: Storage, probe: tuple[str, bytes], inlet: Pipe, outlet: Pipe
) -> TaskRecord:
    """Stage 4: fetch batches from the workers that cast the batches, and write each as a part.

    `probe` is a file in the storage, name and content: a worker that does not see this file holds
    its parts in memory, and the driver fetches the parts. From the driver come lists of
    `CollectOrder`; `Receipt`, `ColumnsLost` and `Failed` are sent to the driver.
    """
    secede()
    visible_storage = storage if storage.sees(*probe) else None

    def store(orders: Iterator[CollectOrder]) -> Iterator[int]:
        # The pipe's client: `own_client` makes a message to the scheduler each time.
        news = (_write_parts(start, visible_storage, order, inlet.client) for order in orders)
        return _send_news(start, outlet, chain.from_iterable(news))

    return _serve(start, inlet, store)


def _write_parts(
    start: StageStart, storage: Storage | None, order: CollectOrder, client: Client
) -> Iterator[Receipt | ColumnsLost | Failed]:
    """Write the parts of a casting task, and yield the messages to the driver."""
    results = fetch_available(client, [order.key], FETCH_PATIENCE_S, holder=order.worker)
    if order.key not in results:
        yield ColumnsLost(order.key)
        return
    batches = {(batch.job, batch.part.first): batch for batch in results[order.key]}
    for job, (first, stop), name in order.parts:
        batch: CastBatch = batches[job, first]
        scans = range(first, stop)
        start.trace("get", scans)
        try:
            with naming_scans(first, stop):
                pieces = pack(batch.part)
                size = sum(map(len, pieces))
                receipt = Receipt.from_part(batch.part, job, name, size, batch.record)
            start.trace("part", scans)
            if storage is None:
                yield replace(receipt, held_at=hold_bytes(name, b"".join(pieces)))
                continue
            with storing(storage):
                storage.write(name, pieces)
            start.trace("stored", scans)
            yield receipt
        except ScanError as error:
            yield Failed(job, COLLECT, str(error))
