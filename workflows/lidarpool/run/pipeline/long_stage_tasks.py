"""Long-running tasks on LIDAR workers, which implement stages 1, 3 and 4.

Each stage processes messages from the driver until a pipe is closed. A failed pipe also ends a
stage silently, because the driver knows the reason. Each stage secedes from the thread pool of its
worker but keeps its slot, so that a worker with one thread and four LIDAR slots can run four of
them.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain

from distributed import Client, secede

from lidarfiles.parts.parts import pack
from lidarsim.io.storage import Storage
from lidarsim.survey.survey import Survey
from poolpart import Pipe, PipeClosed, PipeFailed
from poolpart.fetch import fetch_available, hold_bytes
from poolpart.pipe import get_advice
from poolpart.task_context import translate_leaving_errors

from .failures import ScanError, convert_storage_errors, naming_scans
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

SEND_EVERY_S = 0.05  # minimum interval between sending messages, which are sent together
LINGER_S = 0.02  # time that the sorter waits for further messages
FETCH_PATIENCE_S = 2.0  # time limit for a response from the worker that holds a batch

News = Scans | ColumnsLost | Failed  # message to the driver


@translate_leaving_errors()
def generate(start: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Describe the scans of all surveys in order (stage 1).

    The driver sends lists of `Description`, and receives `ScanRange` messages with the advised
    number of scans. The scans themselves are not sent, because workers can derive them from the
    survey. If a scan cannot be described, the driver receives `Failed`.
    """
    secede()
    recorder = Recorder(start.stage, LIDAR)
    sender = _Sender(start, outlet, max_items=outlet.capacity)
    start.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            descriptions = chain.from_iterable(inlet.get_all())
            sender.send(_describe_scans(start, descriptions, outlet))
    return recorder.finish(sender.scan_count)


def _describe_scans(
    start: StageStart, descriptions: Iterable[Description], outlet: Pipe
) -> Iterator[ScanRange | Failed]:
    for description in descriptions:
        first = description.first
        try:
            with naming_scans(first, first + 1):
                survey: Survey = pickle.loads(description.survey)  # noqa: S301 - from the run's driver
            while first < description.stop:
                item = ScanRange(
                    description.job, first, min(first + get_advice(outlet), description.stop)
                )
                with naming_scans(item.first, item.stop):
                    survey.scan(item.stop - 1)  # raises an error if the scan cannot be described
                start.trace("put", item.scans)
                yield item
                first = item.stop
        except ScanError as error:  # must not affect other surveys
            yield Failed(description.job, GENERATE, str(error))


@translate_leaving_errors()
def sort_frames(start: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Sort the summaries of each survey in scan order (stage 3).

    The driver sends lists of `Summaries`. Each of them is returned when all earlier scans have been
    returned, or had already been delivered (`Summaries.framed`). The state of a survey is discarded
    after its last scan.
    """
    secede()
    recorder = Recorder(start.stage, LIDAR)
    orders: dict[int, _ScanOrder] = {}  # {job: waiting summaries}
    scan_count = 0
    start.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            ready: list[Summaries] = []
            # Wait for further messages, because each response wakes the driver.
            for item in chain.from_iterable(inlet.get_all(linger_s=LINGER_S)):
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
                scan_count += len(scans)
    return recorder.finish(scan_count)


@dataclass(eq=False)
class _ScanOrder:
    """Buffer for the summaries of a survey that wait for earlier scans."""

    next_scan: int = 0
    waiting: dict[int, Summaries] = field(default_factory=dict)  # {first scan: summaries}

    def add(self, item: Summaries) -> list[Summaries]:
        """Add summaries, and return all summaries that are next in scan order."""
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
    """Fetch batches from the workers that cast them, and write each batch as a part (stage 4).

    The driver sends lists of `CollectOrder`, and receives `Receipt`, `ColumnsLost` and `Failed`
    messages. The name and content of a file in the storage are given as `probe`. If the worker
    cannot access this file, it keeps its parts in memory, from where the driver fetches them.
    """
    secede()
    visible_storage = storage if storage.has_content(*probe) else None
    recorder = Recorder(start.stage, LIDAR)
    sender = _Sender(start, outlet)  # needs no limit, because the driver limits its orders
    start.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            orders = chain.from_iterable(inlet.get_all())
            # `own_client` would send a message to the scheduler each time.
            news = (_write_parts(start, visible_storage, order, inlet.client) for order in orders)
            sender.send(chain.from_iterable(news))
    return recorder.finish(sender.scan_count)


def _write_parts(
    start: StageStart, storage: Storage | None, order: CollectOrder, client: Client
) -> Iterator[News]:
    """Write the parts of a casting task, and yield messages for the driver."""
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
            with convert_storage_errors(storage):
                storage.write(name, pieces)
            start.trace("stored", scans)
            yield receipt
        except ScanError as error:
            yield Failed(job, COLLECT, str(error))


class _Sender:
    """Sender that combines messages to the driver if they follow each other quickly.

    At most `max_items` messages are sent at a time. Without a limit (0), the capacity of the pipe
    is ignored.
    """

    def __init__(self, start: StageStart, outlet: Pipe, max_items: int = 0) -> None:
        self._start = start
        self._outlet = outlet
        self._max_items = max_items
        self.scan_count = 0  # number of scans that have been sent

    def send(self, news: Iterable[News]) -> None:
        """Send messages as an iterable produces them."""
        waiting: list[News] = []
        sent_at = time.monotonic()
        for item in news:
            waiting.append(item)
            if len(waiting) == self._max_items or time.monotonic() - sent_at > SEND_EVERY_S:
                self._put(waiting)
                waiting = []
                sent_at = time.monotonic()
        self._put(waiting)

    def _put(self, news: list[News]) -> None:
        self._outlet.put_many(news, unbounded=not self._max_items)
        for item in news:
            if isinstance(item, Scans):
                self._start.trace("sent", item.scans)
                self.scan_count += len(item.scans)
