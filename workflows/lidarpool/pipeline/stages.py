"""Stages 1, 3 and 4: the long-running tasks on LIDAR workers.

Each secedes at once: it frees its thread but keeps its slot, so that a worker with one thread and
four LIDAR slots runs all four. A failed pipe ends a stage silently: the driver knows the reason.
"""

from __future__ import annotations

from itertools import chain
from typing import Any

from distributed import get_worker, secede

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

from ..base.tracing import trace
from ..columns.parts import pack
from ..columns.storage import Storage
from ..sensor import Survey
from .cast import CastBatch
from .failures import naming_scans
from .messages import Receipt
from .names import COLLECT, GENERATE, LIDAR, SORT

FETCH_PATIENCE_S = 2.0  # longest wait for a sign of life of a batch's worker


@telling_departure()
def generate(
    fields: dict[str, Any],
    survey: Survey,
    outlet: Pipe,
    first: int = 0,
) -> TaskRecord:
    """Stage 1: describe every scan from `first` on, with the advised number in one item.

    An item is a range of scans: the survey describes them equally on every worker.
    """
    secede()
    recorder = Recorder(GENERATE, LIDAR)
    sent = first
    trace("generate.start", **fields, scans=[])
    try:
        while sent < survey.scan_count:
            stop = min(sent + outlet.advice, survey.scan_count)
            with naming_scans(sent, stop - 1):
                survey.scan(stop - 1)  # raises here if a scan cannot be described
            trace("generate.put", **fields, scans=list(range(sent, stop)))
            outlet.put((sent, stop))
            trace("generate.sent", **fields, scans=list(range(sent, stop)))
            sent = stop
        outlet.close()
    except PipeFailed:
        pass
    except PipeClosed:  # an earlier start of this task has closed it
        sent = survey.scan_count
    return recorder.done(sent - first)


@telling_departure()
def sort_frames(
    fields: dict[str, Any], size: int, following: int, inlet: Pipe, outlet: Pipe
) -> TaskRecord:
    """Stage 3: put the summaries of scans into scan order.

    Parameters
    ----------
    fields
        Identifies this start of the task, for traces and the driver.
    size
        Bytes of a summary.
    following
        The next scan; all before it have been handed out.
    inlet, outlet
        From the driver lists of {first: a scan, data: summaries from there on}, and to it one such.
    """
    secede()
    recorder = Recorder(SORT, LIDAR)
    waiting: dict[int, bytes] = {}  # {first scan: summaries of consecutive scans}
    begin = following
    try:
        trace("sort.start", **fields, scans=[])
        while True:
            for item in chain.from_iterable(inlet.get_all()):
                first, data = item["first"], item["data"]
                trace("sort.get", **fields, scans=_scans(first, data, size))
                if first + len(data) // size > following:
                    skip = max(0, following - first)
                    waiting[first + skip] = data[skip * size :]
            ready, at = [], following
            while (data := waiting.pop(following, None)) is not None:
                ready.append(data)
                following += len(data) // size
            if ready:
                whole = b"".join(ready)
                trace("sort.put", **fields, scans=_scans(at, whole, size))
                outlet.put({"first": at, "data": whole}, unbounded=True)
                trace("sort.sent", **fields, scans=_scans(at, whole, size))
    except (PipeClosed, PipeFailed):
        pass
    return recorder.done(following - begin)


@telling_departure()
def collect(
    fields: dict[str, Any],
    storage: Storage,
    probe: tuple[str, bytes],
    inlet: Pipe,
    outlet: Pipe,
) -> TaskRecord:
    """Stage 4: fetch batches from the workers that cast them, and write each as a part.

    Parameters
    ----------
    fields
        As of `sort_frames`.
    storage, probe
        Place of the parts, and a file there with its content. A worker that does not see that file
        holds its parts in memory, and the driver fetches them.
    inlet
        From the driver: lists of {key, at, first, stop, name}.
    outlet
        To the driver: {receipt: …}, or {lost: key} for a batch that could not be fetched,
        {failed: reason} if the storage fails, {hidden: worker} if it is not seen.
    """
    secede()
    recorder = Recorder(COLLECT, LIDAR)
    scans = 0
    try:
        trace("collect.start", **fields, scans=[])
        seen = storage.sees(*probe)
        if not seen:
            outlet.put({"hidden": str(get_worker().name)})
        while True:
            for item in chain.from_iterable(inlet.get_all()):
                answer = _collected(fields, storage if seen else None, item)
                if "receipt" in answer:
                    scans += item["stop"] - item["first"]
                outlet.put(answer, unbounded=True)  # the driver limits its requests
                trace("collect.sent", **fields, scans=list(range(item["first"], item["stop"])))
    except (PipeClosed, PipeFailed):
        pass
    return recorder.done(scans)


def _collected(
    fields: dict[str, Any], storage: Storage | None, item: dict[str, Any]
) -> dict[str, Any]:
    """Make a part of one batch; returns the message to the driver."""
    first, stop = item["first"], item["stop"]
    scans = list(range(first, stop))
    found = fetch_available(own_client(), [item["key"]], FETCH_PATIENCE_S, at=item["at"])
    batch: CastBatch | None = found.get(item["key"])
    if batch is None:
        return {"lost": item["key"]}
    trace("collect.get", **fields, scans=scans)
    with naming_scans(first, stop - 1):
        data = pack(batch.part)
        cells = batch.part.cells
    trace("collect.part", **fields, scans=scans)
    held_at = ""
    if storage is None:
        held_at = hold_for_driver(item["name"], data)
    else:
        try:
            storage.write(item["name"], data)
        except OSError as error:
            return {"failed": f"{error.strerror or error}"}
        trace("collect.stored", **fields, scans=scans)
    receipt = Receipt(
        first=first,
        stop=stop,
        name=item["name"],
        rows=len(batch.part),
        size=len(data),
        hits=int(batch.summaries["hits"].sum()),
        cells=() if cells is None else tuple(cells.ravel().tolist()),
        summaries=batch.summaries.tobytes(),
        records=(batch.record,),
        held_at=held_at,
    )
    return {"receipt": receipt.wire()}


def _scans(first: int, data: bytes, size: int) -> list[int]:
    return list(range(first, first + len(data) // size))
