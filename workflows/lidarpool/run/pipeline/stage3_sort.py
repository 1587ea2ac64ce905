"""Stage 3: a long-running task that puts the summaries of scans in order."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain

from distributed import secede

from poolpart import Pipe, PipeClosed, PipeFailed
from poolpart.task_context import translate_leaving_errors

from .stage_messages import StageStart, Summaries
from .stage_names import LIDAR
from .task_records import Recorder, TaskRecord

LINGER_S = 0.02  # time that the sorter waits for further messages


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
