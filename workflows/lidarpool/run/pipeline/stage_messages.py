"""Messages between the driver and the four stages of the pipeline.

Their size does not depend on the number of points. In messages about scans, `job` is the number of
the job in the run.
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

BatchRange = tuple[int, int]  # first scan and stop of a batch

MAX_SAMPLES_PER_SCAN = 4  # maximum number of sample rays in a scan
SAMPLES_PER_SURVEY = 400  # approximate number of sample rays in a survey


def samples_of_scan(scan_count: int) -> int:
    """Return the number of sample rays per scan, which is smaller for larger surveys."""
    return max(1, min(MAX_SAMPLES_PER_SCAN, -(-SAMPLES_PER_SURVEY // scan_count)))


def summary_type(samples: int) -> np.dtype[np.void]:
    """Return the dtype of a scan summary.

    A summary contains the number of hits, the number of points, and the end points of sample rays
    in meters in local coordinates. Missing samples are NaN.

    Parameters
    ----------
    samples
        Number of sample rays per scan.
    """
    return np.dtype([("hits", "<u4"), ("points", "<u4"), ("samples", "<f4", (samples, 3))])


def format_scans(first: int, stop: int) -> str:
    """Format a half-open range of scans for use in messages.

    Examples
    --------
    >>> format_scans(3, 4), format_scans(3, 6)
    ('scan 3', 'scans 3 to 5')
    """
    last = stop - 1
    return f"scan {last}" if first == last else f"scans {first} to {last}"


@dataclass(frozen=True, slots=True)
class StageStart:
    """Data that identifies a started stage in traces."""

    run: str  # ID of the run
    stage: str
    attempt: int  # number of stages that were started before, including restarts

    def trace(self, event: str, scans: Iterable[int] = ()) -> None:
        """Trace an event of this stage."""
        trace(f"{self.stage}.{event}", **asdict(self), scans=list(scans))


@dataclass(frozen=True, slots=True)
class Description:
    """Order for stage 1 to describe the scans of a survey from `first` to `stop`."""

    job: int
    survey: bytes  # pickled separately, so that an error does not affect other surveys
    first: int
    stop: int


@dataclass(frozen=True, slots=True)
class Scans:
    """Range of consecutive scans of a job."""

    job: int
    first: int
    stop: int

    @property
    def scans(self) -> range:
        """Numbers of the scans in the range."""
        return range(self.first, self.stop)


class ScanRange(Scans):
    """Message from stage 1 that a range of scans is ready to be cast."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Summaries(Scans):
    """Scan summaries of a committed part, which stage 3 returns in scan order."""

    data: bytes  # bytes of a `summary_type` array
    framed: int  # one past the last scan that stage 3 does not have to wait for
    until: int  # one past the last scan of the job


@dataclass(frozen=True, slots=True)
class CollectOrder:
    """Order for stage 4 to fetch the batches of a casting task and write each of them as a part."""

    key: str  # key of the casting task
    worker: str  # address of the worker that holds the result of the task
    parts: tuple[tuple[int, BatchRange, str], ...]  # job, scans and name of each part


@dataclass(frozen=True, slots=True)
class ColumnsLost:
    """Message from stage 4 that it could not fetch the result of a casting task."""

    key: str  # key of the casting task


@dataclass(frozen=True, slots=True)
class Receipt(Scans):
    """Message from stage 4 that a part is complete."""

    name: str  # name of the part
    point_count: int
    size: int  # bytes
    hit_count: int  # number of hits before points are thinned out
    cell_box: tuple[int, ...]  # lowest and highest cell as six numbers, or empty without points
    summaries: bytes  # bytes of a `summary_type` array
    record: TaskRecord | None = None  # record of casting, or None if read from the database
    held_at: str = ""  # address of the worker that holds the part if it cannot access the storage

    @classmethod
    def from_part(
        cls, part: PartColumns, job: int, name: str, size: int, record: TaskRecord | None = None
    ) -> Receipt:
        """Create the receipt of a part, computing totals from its columns."""
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
    """Message from stage 1 or 4 that scans of a survey cannot be described or stored."""

    job: int
    stage: str
    reason: str


# Messages from the stages to the driver.
Message = ScanRange | Summaries | ColumnsLost | Receipt | Failed


@dataclass(frozen=True)
class ScanFrame:
    """Scan of a survey, which is delivered in scan order after its points have been stored.

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
    # Number of triangles in the scene, including instances and actors.
    _triangles: int = field(repr=False, compare=False)
    _survey: Survey = field(repr=False, compare=False)
    _read: Callable[[int], Cloud] = field(repr=False, compare=False)
    __repr__ = one_line

    @property
    def pose(self) -> Pose:
        """Sensor pose at the start of the scan, in the local coordinates of the scene."""
        return self._survey.pose(self.scan)

    @property
    def time_ns(self) -> float:
        """Start time of the scan, in nanoseconds since the start of the survey."""
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
        """Count how often rays of this scan hit each triangle of the scene.

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
