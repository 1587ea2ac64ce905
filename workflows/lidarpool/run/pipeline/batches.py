"""A job under way: how far it is, its frames and its batches."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.sensor import Survey

from ...base.tracing import trace
from ..store.database import JobParts
from .messages import Receipt, ScanFrame, Summaries, samples_of_scan, summary_type
from .names import SORT


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
    on_frame: Callable[[ScanFrame], None] | None
    read: Callable[[int], Cloud] | None
    on_parts: Callable[[list[Receipt]], None] | None
    generated: int = 0  # one past the last scan that was taken from stage 1
    cast: int = 0  # scans that stage 2 has finished
    offered_again: int = 0  # batches
    seconds: float = 0.0  # casting time of committed batches
    condemned: list[str] = field(default_factory=list)  # why scans cannot be done
    sorted_at: float = field(default_factory=time.monotonic)  # when the last frames came

    @property
    def left(self) -> int:
        """Scans that are not committed."""
        return len(self.parts.scans) - self.parts.scans_done

    def trace(self, event: str, stage: str, scans: Iterable[int], **more: str) -> None:
        """Report that the driver has reached a point with some scans."""
        more |= {"run": self.run, "stage": stage}
        trace(f"driver.{event}", job=self.number, scans=list(scans), **more)

    def hand_out(self, ordered: Summaries) -> int:
        """Hand out frames; returns how many, since some may have been handed out before."""
        self.sorted_at, framed, survey = time.monotonic(), self.parts.frames, self.survey
        kind = summary_type(samples_of_scan(survey.scan_count))
        for scan, summary in zip(ordered.scans, np.frombuffer(ordered.data, kind), strict=True):
            if scan != self.parts.frames:
                continue
            assert self.on_frame is not None and self.read is not None, "it has frames"
            samples, spec = summary["samples"], survey.scan(scan)
            frame = ScanFrame(
                scan,
                survey.carried[spec.sensor].name,
                spec.ray_count,
                int(summary["hits"]),
                int(summary["points"]),
                samples[~np.isnan(samples[:, 0])],
                survey,
                self.read,
            )
            self.trace("frame", SORT, [scan])
            self.on_frame(frame)
            # Only now: after an error of the caller the frame is handed out again.
            self.parts.frames = scan + 1
            self.trace("release", SORT, [scan])
        return self.parts.frames - framed


class BatchState(Enum):
    """State of a batch."""

    WAITING = "waiting"  # to be offered to a GPU worker
    CASTING = "casting"  # offered to one
    CAST = "cast"  # its columns are on that worker
    COLLECTING = "collecting"  # assigned to a collector


class Outcome(Enum):
    """What has become of a casting task; or why its batches are offered again."""

    PENDING = "pending"
    DONE = "done"
    DIED = "its worker died"
    GONE = "its worker is gone or silent"
    REFUSED = "its worker takes no tasks"
    LATE = "it is late"
    NO_RIG = "its worker has no scene any more"
    DIVIDE = "its task failed, perhaps because of another job"


@dataclass(eq=False)
class Batch:
    """Consecutive uncommitted scans of a job on their way to a part."""

    job: JobState
    first: int
    stop: int
    number: int  # of earlier batches: limits how far the last of a job is ahead of its first
    order: int = 0  # of waiting batches
    place: BatchState = BatchState.WAITING
    since: float = 0.0  # since when it is in its state
    key: str = ""  # of the casting task; "" while waiting
    worker: str = ""  # address of the GPU worker
    collector: str = ""  # name of the task of stage 4
    deaths: Counter[str] = field(default_factory=Counter)  # {stage: workers that died with it}
    divided: bool = False  # not to be cast with batches of other jobs

    def __post_init__(self) -> None:
        self.share = len(self) / self.job.fit  # of the memory of a task

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def scans(self) -> range:
        """Numbers of its scans."""
        return range(self.first, self.stop)

    def move(self, place: BatchState) -> None:
        """Record its new state."""
        self.place, self.since = place, time.monotonic()
