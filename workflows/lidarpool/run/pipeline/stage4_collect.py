"""Stage 4: long-running tasks that fetch the columns of batches and write them as parts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain

from distributed import Client, secede

from lidarfiles.parts.parts import pack
from lidarsim.io.storage import Storage
from poolpart import Pipe, PipeClosed, PipeFailed
from poolpart.fetch import fetch_available, hold_bytes
from poolpart.task_context import translate_leaving_errors

from .failures import ScanError, convert_storage_errors, naming_scans
from .message_sender import MessageSender, News
from .stage2_intersect import CastBatch
from .stage_messages import CollectOrder, ColumnsLost, Failed, Receipt, StageStart
from .stage_names import COLLECT, LIDAR
from .task_records import Recorder, TaskRecord

FETCH_PATIENCE_S = 2.0  # time limit for a response from the worker that holds a batch


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
    sender = MessageSender(start, outlet)  # needs no limit, because the driver limits its orders
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
