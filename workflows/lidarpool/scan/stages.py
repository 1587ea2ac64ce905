"""Stages 1, 3 and 4: the long-running tasks on LIDAR workers.

Each secedes at once: it frees its thread, so that a worker with one thread and four LIDAR
slots runs all four, and keeps its slot. A pipe that fails ends a stage quietly: whoever
failed it knows why.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any

import numpy as np
from distributed import Client, secede

from poolpart import (
    Backoff,
    Pipe,
    PipeClosed,
    PipeFailed,
    Recorder,
    TaskRecord,
    fetch_available,
    own_client,
    telling_departure,
    trace,
)

from ..sensor import Sensor
from ..survey import ScanSpec, Survey
from .failures import naming_scans
from .messages import POINT, Attempt, Batch, Delivery, Frame, FrameRun, Hello, Part
from .pacer import Pacer
from .setup import ray_directions
from .stage_names import COLLECT, GENERATE, LIDAR, SORT

DELIVERY_BYTES = 4 << 20  # of points or frames in one message through the scheduler
GIVE_UP_S = 120.0  # asking for a result; the driver sends what does not arrive again


@telling_departure()
def generate(
    attempt: Attempt, survey: Survey, outlet: Pipe, first: int = 0, pace: float | None = None
) -> TaskRecord:
    """Stage 1: describe every scan from `first` on, as many in one item as is advised.

    With a pace, so many a second, each when its time has come.
    """
    secede()
    recorder = Recorder(GENERATE, LIDAR)
    sent = first
    clock = None if pace is None else Pacer(pace, first)
    trace("generate.start", **attempt.fields, first=first, scans=[])
    try:
        while sent < survey.scan_count:
            stop = min(sent + outlet.advice, survey.scan_count)
            if clock is not None and (stop := min(stop, clock.due)) <= sent:
                clock.wait(sent)
                continue
            with naming_scans(sent, stop - 1):
                item = [survey.scan(index).wire() for index in range(sent, stop)]
            trace("generate.put", **attempt.fields, scans=list(range(sent, stop)))
            outlet.put(item)
            trace("generate.sent", **attempt.fields, scans=list(range(sent, stop)))
            sent = stop
        outlet.close()
    except PipeFailed:
        pass
    except PipeClosed:  # an earlier run of this task got as far as closing it
        sent = survey.scan_count
    return recorder.done(sent - first)


@telling_departure()
def sort_frames(attempt: Attempt, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Stage 3: put frames back into scan order.

    The driver has only so many scans under way, which bounds the frames waiting here.
    """
    secede()
    recorder = Recorder(SORT, LIDAR)
    waiting: dict[int, Frame] = {}  # {scan: frame that came before its turn}
    following = 0  # the scan whose turn it is
    try:
        trace("sort.hello", **attempt.fields, scans=[])
        outlet.put(Delivery(attempt, Hello()).wire())
        for base, results in _arrivals(inlet):
            trace("sort.get", **attempt.fields, scans=_scans_of_frames(results))
            # Everything before `base` has reached the driver: a sorter that was started again
            # with an empty memory must not wait for it.
            following = max(following, base)
            records = []
            for frames, record in results:
                records.append(record)
                waiting.update({frame.scan: frame for frame in frames if frame.scan >= following})
            ready = []
            for stale in [scan for scan in waiting if scan < following]:
                del waiting[stale]
            while following in waiting:
                ready.append(waiting.pop(following))
                following += 1
            with naming_scans(following - len(ready), following - 1):
                runs = list(_frame_runs(ready, records))
            for run in runs:
                scans = [frame.scan for frame in run.frames]
                trace("sort.put", **attempt.fields, scans=scans)
                outlet.put(Delivery(attempt, run).wire())
                trace("sort.sent", **attempt.fields, scans=scans)
    except (PipeClosed, PipeFailed):
        pass
    return recorder.done(following)


@telling_departure()
def collect(
    attempt: Attempt,
    sensor: Sensor,
    keep_every: int,
    precision_m: float,
    inlet: Pipe,
    outlet: Pipe,
) -> TaskRecord:
    """Stage 4: thin out the hits of each scan, turn them into points, gather and deliver."""
    secede()
    recorder = Recorder(COLLECT, LIDAR)
    scans = 0
    try:
        trace("collect.hello", **attempt.fields, scans=[])
        outlet.put(Delivery(attempt, Hello()).wire())
        for _, results in _arrivals(inlet):
            batches: list[Batch] = results
            trace("collect.get", **attempt.fields, scans=_scans_of_batches(batches))
            tables = []
            for spec, hits in chain.from_iterable(map(_hits_by_scan, batches)):
                with naming_scans(spec.scan):
                    points = points_of(sensor, spec, hits[::keep_every], precision_m)
                tables.append((spec.scan, points))
            scans += len(tables)
            for part in _parts(tables):
                trace("collect.part", **attempt.fields, scans=list(part.scans))
                outlet.put(Delivery(attempt, part).wire())
                trace("collect.sent", **attempt.fields, scans=list(part.scans))
    except (PipeClosed, PipeFailed):
        pass
    return recorder.done(scans)


def points_of(sensor: Sensor, spec: ScanSpec, hits: np.ndarray, precision_m: float) -> np.ndarray:
    """Points (POINT) of some hits (HIT) of one scan, rounded to the precision."""
    directions = ray_directions(sensor, spec, hits["ray"])
    position = np.asarray(spec.pose.position) + directions * hits["distance"][:, None]
    points = np.zeros(len(hits), POINT)
    points["cell"] = np.rint(position / precision_m)
    points["scan"], points["ray"] = spec.scan, hits["ray"]
    points["object"], points["ring"] = hits["object"], hits["ray"] % sensor.layers
    return points


def _arrivals(inlet: Pipe) -> Iterator[tuple[int, list[Any]]]:
    """Fetch what a pipe of the driver names: (base, results), until the pipe is closed.

    The items carry keys, not futures: the driver holds the futures until the scans have
    arrived. `base` is the first scan that had not reached the driver when the item was put.
    Results whose worker has died are asked for until Dask has made them again.
    """
    client: Client = own_client()
    pause = Backoff(most_s=0.1)
    missing: dict[str, float] = {}  # {key: when to stop asking}
    while True:
        try:
            items = inlet.get_all(timeout_s=pause.next() if missing else None)
        except TimeoutError:
            items = []
        now = time.monotonic()
        missing.update({key: now + GIVE_UP_S for item in items for key in item["keys"]})
        results = fetch_available(client, missing)
        # One that nobody makes any more was sent twice, and has arrived through another.
        missing = {k: until for k, until in missing.items() if k not in results and until > now}
        if results or not missing:
            pause.reset()
        yield max((item["base"] for item in items), default=0), list(results.values())


def _scans_of_frames(results: Sequence[tuple[Sequence[Frame], TaskRecord]]) -> list[int]:
    return [frame.scan for frames, _ in results for frame in frames]


def _scans_of_batches(batches: Sequence[Batch]) -> list[int]:
    return [spec.scan for batch in batches for spec in batch.scans]


def _hits_by_scan(batch: Batch) -> Iterator[tuple[ScanSpec, np.ndarray]]:
    stops = np.cumsum(batch.hit_counts)
    for spec, stop, count in zip(batch.scans, stops, batch.hit_counts, strict=True):
        yield spec, batch.hits[stop - count : stop]


def _frame_runs(frames: Sequence[Frame], records: Sequence[TaskRecord]) -> Iterator[FrameRun]:
    """Divide frames into messages of bounded size; the records go with the first."""
    run: list[Frame] = []
    size = 0
    carried = tuple(records)
    for frame in frames:
        run.append(frame)
        size += frame.triangles.nbytes + frame.counts.nbytes + frame.samples.nbytes
        if size >= DELIVERY_BYTES:
            yield FrameRun(tuple(run), carried)
            run, size, carried = [], 0, ()
    if run or carried:
        yield FrameRun(tuple(run), carried)


def _parts(tables: Sequence[tuple[int, np.ndarray]]) -> Iterator[Part]:
    """Divide the points of some scans into messages of bounded size."""
    held: list[tuple[int, np.ndarray]] = []
    size = 0
    for scan, points in tables:
        held.append((scan, points))
        size += points.nbytes
        if size >= DELIVERY_BYTES:
            yield _part(held)
            held, size = [], 0
    if held:
        yield _part(held)


def _part(tables: Sequence[tuple[int, np.ndarray]]) -> Part:
    return Part(
        scans=tuple(scan for scan, _ in tables),
        counts=tuple(len(points) for _, points in tables),
        points=np.concatenate([points for _, points in tables]),
    )
