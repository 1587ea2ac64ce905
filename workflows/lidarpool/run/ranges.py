"""LIDAR workers that write formats of many files, once the survey is done."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

from distributed import Reschedule

from poolpart import Recorder, TaskRecord, fetch_available, own_client

from ..base.errors import LidarpoolError
from ..export.pieces import RangeWriter, Span, Written
from ..pipeline import EXPORT, LIDAR
from ..pipeline.failures import raise_if_failed
from ..pipeline.workers import share
from .cluster import Cluster
from .result import RunResult

LOOK_EVERY_S = 0.01
FETCH_S = 1.0
ENDS_S = 10.0  # for ranges that are being written when the others are stopped


class LidarWorkers:
    """Has the workers of LIDAR write ranges of files."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster, self._tasks = cluster, cluster.tasks(LIDAR)

    def __call__(self, writer: RangeWriter, spans: Sequence[Span]) -> dict[Span, Written]:
        """Write ranges; returns what was written of those whose workers see the folder.

        The range of a worker that dies is written by another. LidarpoolError if one cannot write,
        several die of a range, or there is none for too long.
        """
        partition, running = self._tasks.partition, self._tasks.running
        waiting, most = deque(spans), 2 * partition.slots
        written: dict[Span, Written] = {}
        watch = self._cluster.watch([LIDAR])
        # Workers fetch it from the one that has it: as an argument of the tasks it would make Dask
        # send them all to that worker.
        shared = share(partition, writer, priority=10)
        try:
            while waiting or running:
                while waiting and len(running) < most:
                    span = waiting.popleft()
                    self._tasks.submit(span, _write_range, shared.key, span)
                for future in (shared, *running):
                    raise_if_failed(future, f"Writing {writer.place}")
                done = self._tasks.take_done()
                written |= {span: made for span, made in done if made is not None}
                watch.look(time.monotonic())
                if not done:
                    time.sleep(LOOK_EVERY_S)
        except OSError as error:
            raise LidarpoolError(f"The cluster was lost while it wrote {writer.place}.") from error
        finally:
            if running:
                writer.stop()
                until = time.monotonic() + ENDS_S
                while any(f.status == "pending" for f in running) and time.monotonic() < until:
                    time.sleep(LOOK_EVERY_S)
                running.clear()
        return written

    def recorded(self, result: RunResult) -> RunResult:
        """Return a result with the tasks that wrote ranges."""
        return replace(result, stages=(*result.stages, *self._tasks.book.stages.values()))


@lru_cache(maxsize=1)
def _fetched(key: str) -> RangeWriter:
    """Fetch the writer once for all ranges; it is made again if its worker has died."""
    until = time.monotonic() + FETCH_S
    while not (found := fetch_available(own_client(), [key])):
        if time.monotonic() > until:
            raise Reschedule  # what makes it again needs a slot
        time.sleep(LOOK_EVERY_S)
    writer: RangeWriter = found[key]
    return writer


def _write_range(key: str, span: Span) -> tuple[Written | None, TaskRecord]:
    """Write a range on a worker."""
    recorder = Recorder(EXPORT, LIDAR)
    try:
        made = _fetched(key)(span)
    except OSError as error:
        raise LidarpoolError(
            f"the worker {recorder.done().worker} cannot write there: {error.strerror or error}."
        ) from None
    return made, recorder.done(span[1] - span[0])
