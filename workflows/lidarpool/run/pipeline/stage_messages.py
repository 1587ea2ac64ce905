"""Messages between the four stages and the driver: descriptions, summaries and receipts.

Their size does not depend on the number of points. Messages about scans have the number of the
`job` in the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.part_columns import PartColumns
from lidarsim.errors import LidarError
from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Floats32, Ints
from lidarsim.schema.value_texts import one_line
from lidarsim.survey.survey import Survey

from ...processes.tracing import trace
from .task_records import TaskRecord

BatchRange = tuple[int, int]  # the first scan of a batch, and its end

MAX_SAMPLES_PER_SCAN = 4  # sample rays
SAMPLES_PER_SURVEY = 400  # sample rays, about


def samples_of_scan(scan_count: int) -> int:
    """Return the number of sample rays of each scan: fewer for many scans, as all are sent."""
    return max(1, min(MAX_SAMPLES_PER_SCAN, -(-SAMPLES_PER_SURVEY // scan_count)))


def summary_type(samples: int) -> np.dtype[np.void]:
    """Return the dtype of the summary of a scan with a number of sample rays.

    A summary has the number of hits and of points kept, and the ends of the sample rays, meters,
    local coordinates. Missing samples are NaN.
    """
    return np.dtype([("hits", "<u4"), ("points", "<u4"), ("samples", "<f4", (samples, 3))])


def scans_in_words(first: int, stop: int) -> str:
    """Name the scans from `first` to `stop`, half-open, for messages."""
    last = stop - 1
    return f"scan {last}" if first == last else f"scans {first} to {last}"


@dataclass(frozen=True, slots=True)
class StageStart:
    """One start of a stage, for its traces."""

    run: str  # id of the run
    stage: str
    attempt: int  # starts of stages before this one

    def trace(self, event: str, scans: Iterable[int] = ()) -> None:
        """Emit a trace event of this start of the stage about scans."""
        trace(f"{self.stage}.{event}", **asdict(self), scans=list(scans))


@dataclass(frozen=True, slots=True)
class Description:
    """To stage 1: describe the scans of a survey from `first` to `stop`."""

    job: int
    survey: bytes  # pickled: if a worker cannot unpickle it, others can be described
    first: int
    stop: int


@dataclass(frozen=True, slots=True)
class Scans:
    """Consecutive scans of a job."""

    job: int
    first: int
    stop: int

    @property
    def scans(self) -> range:
        """Numbers of the scans."""
        return range(self.first, self.stop)


class ScanRange(Scans):
    """From stage 1: scans that can be described, and may be cast."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Summaries(Scans):
    """To stage 3, and back in scan order: the summaries of the scans of a committed part."""

    data: bytes  # bytes of an array of `summary_type`
    framed: int  # one past the last scan that stage 3 need not wait for
    until: int  # one past the last scan of the job


@dataclass(frozen=True, slots=True)
class CollectOrder:
    """To stage 4: fetch the columns of the batches of a casting task, and write each as a part."""

    key: str  # key of the casting task
    worker: str  # address of the worker that has its result
    parts: tuple[tuple[int, BatchRange, str], ...]  # job, scans and name of each


@dataclass(frozen=True, slots=True)
class ColumnsLost:
    """From stage 4: the result of casting task `key` could not be fetched."""

    key: str


@dataclass(frozen=True, slots=True)
class Receipt(Scans):
    """From stage 4: a part is complete in storage, or in the memory of the worker `held_at`."""

    name: str  # name of the part
    point_count: int
    size: int  # bytes
    hit_count: int  # hits of its scans, before thinning out
    cell_box: tuple[int, ...]  # lowest and highest cell as six numbers; empty without points
    summaries: bytes  # summaries of its scans, of `summary_type`
    record: TaskRecord | None = None  # the casting task; None for a receipt from the database
    held_at: str = ""  # address of a worker that cannot access the storage, and holds the part

    @classmethod
    def from_part(
        cls, part: PartColumns, job: int, name: str, size: int, record: TaskRecord | None = None
    ) -> Receipt:
        """Return the receipt of a part of `size` bytes, with totals from the part's columns."""
        summaries = np.zeros(len(part.counts), summary_type(part.samples.shape[1]))
        summaries["hits"] = part.scan_hits
        summaries["points"] = part.counts
        summaries["samples"] = part.samples
        box = () if part.cell_box is None else tuple(part.cell_box.ravel().tolist())
        data = summaries.tobytes()
        return cls(
            job=job,
            first=part.first,
            stop=part.stop,
            name=name,
            point_count=len(part),
            size=size,
            hit_count=int(part.scan_hits.sum()),
            cell_box=box,
            summaries=data,
            record=record,
        )


@dataclass(frozen=True, slots=True)
class Failed:
    """From stages 1 and 4: the scans of a survey cannot be described or stored."""

    job: int
    stage: str
    reason: str


# To the driver.
Message = ScanRange | Summaries | ColumnsLost | Receipt | Failed


@dataclass(frozen=True)
class ScanFrame:
    """Scan of a survey, delivered in scan order once its points have been stored.

    Parameters
    ----------
    scan
        Number of the scan.
    sensor
        Name of the sensor, or "" for a single sensor without a name.
    rays, hit_count, count
        Number of rays fired, number of rays that hit a surface, and number of points in the cloud.
    samples
        End points of a few rays, in meters in local coordinates. float32 array of shape (m, 3).
    """

    scan: int
    sensor: str
    rays: int
    hit_count: int
    count: int
    samples: Floats32
    _triangles: int = field(repr=False, compare=False)  # of the scene, with instances and actors
    _survey: Survey = field(repr=False, compare=False)
    _read: Callable[[int], Cloud] = field(repr=False, compare=False)
    __repr__ = one_line

    @property
    def pose(self) -> Pose:
        """Pose of the sensor at the start of the scan, in the local coordinates of the scene."""
        return self._survey.pose(self.scan)

    @property
    def time_ns(self) -> float:
        """Start time of the scan in nanoseconds since the start of the survey."""
        return self._survey.begins_ns(self.scan)

    def points(self) -> Cloud:
        """Read the points of this scan from its part.

        Raises
        ------
        LidarError
            If the part cannot be read, for example because the run was removed.
        """
        return self._read(self.scan)

    def hit_counts(self) -> Ints:
        """Count the hits of this scan on each triangle of the scene.

        Returns
        -------
        int64 array of shape (triangles,). It contains the counts for `Scene.faces`, followed by
        those for the triangles of each instance, and then of each actor.

        Raises
        ------
        LidarError
            If the survey does not store the column `triangle`, if `keep_every` is greater than 1,
            or if the part cannot be read.

        Examples
        --------
        >>> def on_frame(frame):
        ...     total += frame.hit_counts()     # colors of the faces in a live figure
        """
        survey = self._survey
        if survey.keep_every > 1:
            raise LidarError(
                f"Hits of a frame cannot be counted, because the survey keeps only one of every "
                f"{survey.keep_every} hits. Set `keep_every` to 1."
            )
        if all(column.name != "triangle" for column in survey.stored_columns):
            raise LidarError(
                "Hits of a frame cannot be counted without the column `triangle`. Add it to the "
                "`columns` of the survey."
            )
        triangle = self.points()["triangle"]
        return np.bincount(triangle[triangle >= 0], minlength=self._triangles)
