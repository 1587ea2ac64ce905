"""One job under way: how far it is, and its frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from poolpart import TaskRecord

from ..base.tracing import trace
from ..columns.cloud import Cloud
from ..sensor import Survey
from .database import JobParts
from .messages import (
    Description,
    Frame,
    Receipt,
    Span,
    Summaries,
    samples_of_scan,
    summary_type,
)
from .names import GENERATE, SORT


@dataclass(eq=False)
class JobState:
    """A job under way: how far it is.

    `parts` has what is committed of it. `packed` is its survey, pickled; jobs of one `scene` can be
    cast in one task. So many scans `fit` into the memory of a task; `in_all` are those of the whole
    run. The others are as of `RunDriver.begin`.
    """

    run: str  # id, for traces
    number: int
    survey: Survey
    parts: JobParts
    packed: bytes
    scene: str
    fit: int
    in_all: int
    on_frame: Callable[[Frame], None] | None
    read: Callable[[int], Cloud] | None
    on_parts: Callable[[list[Receipt]], None] | None
    generated: int = 0  # scans taken from stage 1, from the first on
    cast: int = 0  # scans that stage 2 has finished
    offered_again: int = 0  # batches
    seconds: float = 0.0  # casting time of committed batches
    condemned: list[str] = field(default_factory=list)  # why scans cannot be done
    sorted_at: float = field(default_factory=time.monotonic)  # when the last frames came

    def __post_init__(self) -> None:
        if not self.left:  # stage 1 need not describe what is committed
            self.generated = self.survey.scan_count

    @property
    def complete(self) -> bool:
        """Whether all is committed, and was handed out if there are frames."""
        return self.parts.complete

    def trace(self, event: str, stage: str, scans: Iterable[int], **more: str) -> None:
        """Report that the driver has reached a point with some scans."""
        more |= {"run": self.run, "stage": stage}
        trace(f"driver.{event}", job=self.number, scans=list(scans), **more)

    # -- stage 1 ---------------------------------------------------------------------------

    @property
    def left(self) -> int:
        """Scans that are not committed."""
        return self.survey.scan_count - self.parts.scans_done

    @property
    def is_described(self) -> bool:
        """Whether stage 1 has nothing to do for it any more."""
        return self.generated >= self.survey.scan_count

    def batches_to_come(self, scans: int) -> int:
        """How many batches of so many scans, if they fit, stage 1 has to describe yet."""
        return -(-(self.survey.scan_count - self.generated) // min(scans, self.fit))

    @property
    def description(self) -> Description:
        """What stage 1 has to describe yet."""
        return Description(self.number, self.packed, self.generated, self.survey.scan_count)

    def take(self, first: int, stop: int) -> list[Span]:
        """Take scans from stage 1; returns batches of those that are not committed."""
        first = max(first, self.generated)  # a restarted generator repeats some
        if first < stop:
            self.trace("take", GENERATE, range(first, stop))
        self.generated = max(stop, self.generated)
        return [
            (begin, min(begin + self.fit, end))  # the size was advised for another job perhaps
            for at, end in self.parts.missing(first, stop)
            for begin in range(at, end, self.fit)
        ]

    # -- stage 2 ---------------------------------------------------------------------------

    def count_cast(self, scans: int) -> None:
        """Count scans that stage 2 has finished."""
        self.cast += scans

    def count_again(self) -> None:
        """Count a batch that is offered again."""
        self.offered_again += 1

    def learn(self, record: TaskRecord) -> None:
        """Count the casting time of a committed batch."""
        self.seconds += record.seconds

    def condemn(self, reason: str) -> None:
        """Give scans up; the job fails when its other batches have ended."""
        self.condemned.append(reason)

    # -- stage 3 ---------------------------------------------------------------------------

    def summaries(self, parts: Sequence[Receipt]) -> list[Summaries]:
        """Return the messages for the sorter about some parts."""
        framed, count = self.parts.frames, self.survey.scan_count
        return [Summaries(self.number, p.first, p.stop, p.summaries, framed, count) for p in parts]

    def wait_for_sorter(self) -> None:
        """Note that the sorter has news to tell of."""
        self.sorted_at = time.monotonic()

    def hand_out(self, ordered: Summaries) -> int:
        """Hand out frames; returns how many, since some may have been handed out before."""
        self.sorted_at, framed = time.monotonic(), self.parts.frames
        kind = summary_type(samples_of_scan(self.survey.scan_count))
        for scan, summary in zip(ordered.scans, np.frombuffer(ordered.data, kind), strict=True):
            if scan == self.parts.frames:
                self._hand_out(scan, summary)
        return self.parts.frames - framed

    def _hand_out(self, scan: int, summary: np.void) -> None:
        assert self.on_frame is not None and self.read is not None, "it has frames"
        samples, spec = summary["samples"], self.survey.scan(scan)
        frame = Frame(
            scan,
            self.survey.carried[spec.sensor].name,
            self.survey.pose(scan),
            spec.ray_count,
            int(summary["hits"]),
            int(summary["points"]),
            samples[~np.isnan(samples[:, 0])],
            self.read,
        )
        self.trace("frame", SORT, [scan])
        self.on_frame(frame)
        # Only now: after an error of the caller the frame is handed out again.
        self.parts.count_frame(scan)
        self.trace("release", SORT, [scan])
