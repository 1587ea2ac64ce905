"""LIDAR workers that write formats of many files, once the survey is done."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

from distributed import Client, Future, Reschedule

from poolpart import Partition, Recorder, TaskRecord, fetch_available, own_client

from ..base.errors import LidarpoolError
from ..base.software import call_alike, software
from ..export.pieces import RangeWriter, Span, Written
from ..pipeline import EXPORT, LIDAR
from ..pipeline.failures import raise_if_failed
from ..pipeline.task_book import TaskBook
from ..pipeline.workers import share
from .result import RunResult
from .watch import Watch

LOOK_EVERY_S = 0.01
FETCH_S = 1.0
ENDS_S = 10.0  # for ranges that are being written when the others are stopped


class LidarWorkers:
    """Has the workers of LIDAR write ranges of files; `patience_s` and `tell` as of `Watch`."""

    def __init__(
        self, client: Client, partition: Partition, patience_s: float, tell: Callable[[str], None]
    ) -> None:
        self._client, self._partition = client, partition
        self._patience_s, self._tell = patience_s, tell
        self._book, self._sources = TaskBook(), software()["lidarpool"]

    def __call__(self, writer: RangeWriter, spans: Sequence[Span]) -> dict[Span, Written]:
        """Write ranges; returns what was written of those whose workers see the folder.

        The range of a worker that dies is written by another. LidarpoolError if one cannot write,
        several die of a range, or there is none for too long.
        """
        waiting, most = deque(spans), 2 * self._partition.slots
        running: dict[Future, Span] = {}
        written: dict[Span, Written] = {}
        watch = Watch(self._client, [LIDAR], patience_s=self._patience_s, tell=self._tell)
        # Workers fetch it from the one that has it: as an argument of the tasks it would make Dask
        # send them all to that worker.
        shared = share(self._partition, writer, priority=10)
        try:
            while waiting or running:
                while waiting and len(running) < most:
                    span = waiting.popleft()
                    future = self._partition.submit(
                        call_alike, self._sources, _write_range, shared.key, span
                    )
                    running[future] = span
                for future in (shared, *running):
                    raise_if_failed(future, f"Writing {writer.place}")
                ended = {future.key: future for future in running if future.status == "finished"}
                for key, (made, record) in fetch_available(self._client, [*ended]).items():
                    span = running.pop(ended[key])
                    self._book.add(record)
                    if made is not None:
                        written[span] = made
                watch.look(time.monotonic())
                if not ended:
                    time.sleep(LOOK_EVERY_S)
        except OSError as error:
            raise LidarpoolError(f"The cluster was lost while it wrote {writer.place}.") from error
        finally:
            if running:
                writer.stop()
                until = time.monotonic() + ENDS_S
                while any(f.status == "pending" for f in running) and time.monotonic() < until:
                    time.sleep(LOOK_EVERY_S)
        return written

    def recorded(self, result: RunResult) -> RunResult:
        """Return a result with the tasks that wrote ranges."""
        return replace(result, stages=(*result.stages, *self._book.stages.values()))


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
