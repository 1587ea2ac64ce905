"""Stages 1, 3 and 4: the long-running tasks on LIDAR workers.

Each secedes at once: it frees its thread but keeps its slot, so that a worker with one thread and
four LIDAR slots runs all four. A failed pipe ends a stage silently: the driver knows the reason.
"""

from __future__ import annotations

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
from .failures import naming_scans, storing
from .messages import CollectOrder, ColumnsLost, Receipt, ScanRange, StageStart, Summaries
from .names import COLLECT, GENERATE, LIDAR, SORT

FETCH_PATIENCE_S = 2.0  # longest wait for a sign of life of a batch's worker


@telling_departure()
def generate(me: StageStart, survey: Survey, outlet: Pipe, first: int) -> TaskRecord:
    """Stage 1: describe every scan from `first` on, with the advised number in one item.

    An item is a `ScanRange`: the survey describes the scans equally on every worker.
    """
    secede()
    recorder = Recorder(GENERATE, LIDAR)
    sent = first
    me.trace("start")
    try:
        while sent < survey.scan_count:
            stop = min(sent + outlet.advice, survey.scan_count)
            with naming_scans(sent, stop - 1):
                survey.scan(stop - 1)  # raises here if a scan cannot be described
            me.trace("put", range(sent, stop))
            outlet.put(ScanRange(sent, stop))
            me.trace("sent", range(sent, stop))
            sent = stop
        outlet.close()
    except PipeFailed:
        pass
    except PipeClosed:  # an earlier start of this task has closed it
        sent = survey.scan_count
    return recorder.done(sent - first)


@telling_departure()
def sort_frames(me: StageStart, following: int, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Stage 3: put the summaries of scans into scan order.

    All before the scan `following` have been handed out. From the driver come lists of `Summaries`,
    and to it goes each of them once those before it went.
    """
    secede()
    recorder = Recorder(SORT, LIDAR)
    waiting: dict[int, Summaries] = {}  # {first scan that is wanted of them: summaries}
    begin = following
    try:
        me.trace("start")
        while True:
            for item in chain.from_iterable(inlet.get_all()):
                me.trace("get", item.scans)
                if item.stop > following:
                    waiting[max(item.first, following)] = item
            ready, at = [], following
            while (item := waiting.pop(following, None)) is not None:
                ready.append(item)
                following = item.stop
            if ready:
                me.trace("put", range(at, following))
                outlet.put_many(ready, unbounded=True)
                me.trace("sent", range(at, following))
    except (PipeClosed, PipeFailed):
        pass
    return recorder.done(following - begin)


@telling_departure()
def collect(
    me: StageStart, storage: Storage, probe: tuple[str, bytes], inlet: Pipe, outlet: Pipe
) -> TaskRecord:
    """Stage 4: fetch batches from the workers that cast them, and write each as a part.

    `probe` is a file in the storage, name and content: a worker that does not see it holds its
    parts in memory, and the driver fetches them. From the driver come lists of `CollectOrder`, to
    it go `Receipt` and `ColumnsLost`.
    """
    secede()
    recorder = Recorder(COLLECT, LIDAR)
    scans = 0
    try:
        me.trace("start")
        seen = storage.sees(*probe)
        while True:
            for order in chain.from_iterable(inlet.get_all()):
                answer = _collected(me, storage if seen else None, order)
                if isinstance(answer, Receipt):
                    scans += order.stop - order.first
                outlet.put(answer, unbounded=True)  # the driver limits its orders
                me.trace("sent", range(order.first, order.stop))
    except (PipeClosed, PipeFailed):
        pass
    return recorder.done(scans)


def _collected(
    me: StageStart, storage: Storage | None, order: CollectOrder
) -> Receipt | ColumnsLost:
    """Make a part of one batch; returns the message to the driver."""
    scans = range(order.first, order.stop)
    found = fetch_available(own_client(), [order.key], FETCH_PATIENCE_S, at=order.worker)
    batch: CastBatch | None = found.get(order.key)
    if batch is None:
        return ColumnsLost(order.key)
    me.trace("get", scans)
    with naming_scans(order.first, order.stop - 1):
        data = pack(batch.part)
        cells = batch.part.cells
    me.trace("part", scans)
    held_at = ""
    if storage is None:
        held_at = hold_for_driver(order.name, data)
    else:
        with storing(storage):
            storage.write(order.name, data)
        me.trace("stored", scans)
    return Receipt(
        first=order.first,
        stop=order.stop,
        name=order.name,
        rows=len(batch.part),
        size=len(data),
        hits=int(batch.summaries["hits"].sum()),
        cells=() if cells is None else tuple(cells.ravel().tolist()),
        summaries=batch.summaries.tobytes(),
        record=batch.record,
        held_at=held_at,
    )
