"""What stages 3 and 4 deliver, entered in the ledgers; what has come before is dropped."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from poolpart import Ledger, TaskRecord

from .builder import CloudBuilder
from .handover import Handover
from .messages import Delivery, Frame, FrameRun, Hello, Part
from .stage_names import COLLECT, SORT
from .survey_run import SurveyRun
from .under_way import UnderWay


class Arrivals:
    """Takes deliveries.

    Parameters
    ----------
    run
        The run.
    under_way
        The batches, of which each arrival crosses a scan off.
    handover
        Knows which attempts of the stages were replaced, and is told of new ones.
    frames
        The frames that have arrived.
    cloud
        Takes the points.
    on_frame
        Called with each frame that is new, in scan order.
    on_records
        Called with the records of the tasks that made them, each time that some came.
    """

    def __init__(
        self,
        run: SurveyRun,
        under_way: UnderWay,
        handover: Handover,
        frames: Ledger,
        cloud: CloudBuilder,
        on_frame: Callable[[Frame], None],
        on_records: Callable[[Iterable[TaskRecord]], None],
    ) -> None:
        self._run, self._under_way, self._handover = run, under_way, handover
        self._frames, self._cloud = frames, cloud
        self._on_frame, self._on_records = on_frame, on_records

    def take(self, delivery: Delivery) -> None:
        """Enter one delivery."""
        content = delivery.content
        if self._handover.is_stale(delivery.attempt):
            frames = content.frames if isinstance(content, FrameRun) else ()
            self._run.trace("stale", delivery.attempt.stage, (frame.scan for frame in frames))
        elif isinstance(content, Hello):
            self._handover.greet(delivery.attempt)
        elif isinstance(content, FrameRun):
            self._take_frames(content)
        else:
            self._take_points(content)

    def _take_frames(self, run: FrameRun) -> None:
        for frame in run.frames:
            if self._frames.accept(frame.scan):
                self._under_way.arrived(SORT, frame.scan)
                self._run.trace("frame", SORT, [frame.scan])
                self._on_frame(frame)
            else:
                self._run.trace_duplicates(SORT, [frame.scan])
        if run.records:
            self._on_records(run.records)

    def _take_points(self, part: Part) -> None:
        new = self._cloud.add(part)
        for scan in new:
            self._under_way.arrived(COLLECT, scan)
        self._run.trace("points", COLLECT, new)
        if len(new) < len(part.scans):
            self._run.trace_duplicates(COLLECT, sorted(set(part.scans) - set(new)))
