"""Result of a run: the points of a survey, or the totals of a campaign."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from lidarsim.base.arrays import Floats32, Ints
from lidarsim.base.signatures import ReadableSignature
from lidarsim.base.value_texts import one_line
from lidarsim.columns.cloud import Cloud
from lidarsim.scene.scene import Scene
from lidarsim.survey.survey import Survey

from ..columns.parts import StoredCloud
from ..datasets.job_table import JobRow
from ..plan import Plan, Planning, Trial
from .pipeline.task_book import StageTotals
from .pipeline.task_records import TaskRecord


@dataclass(frozen=True, eq=False)
class RunResult:
    """Result of a survey without files.

    `lidarpool.api.result` adds methods to its result.

    Parameters
    ----------
    points
        The points, in parts: read in order a piece at a time, or written by `save_cloud`.
    plan, trials
        The best path and all trials; None and empty without planning.
    backend
        Name of the ray-casting backend that was used.
    rays, hit_count
        Rays fired, and rays that hit a surface.
    stages
        All tasks of each stage together.
    resumed
        Scans from an earlier run. `records` and seconds are of this run only.
    notes
        Remarks for the user, such as that the GPU partition had no GPU.
    identity
        Fingerprints of scene, survey and planning, and versions of the software.
    sample_rays
        float32 (k, 2, 3): first and last point of some rays, meters, local coordinates.
    seconds, survey_seconds, planning_seconds
        Wall time of all, of the survey and of the planning.
    replayed
        Batches that were offered again.
    """

    __signature__ = ReadableSignature()

    scene: Scene
    survey: Survey
    planning: Planning | None
    points: StoredCloud
    plan: Plan | None
    trials: tuple[Trial, ...]
    backend: str
    rays: int
    hit_count: int
    stages: tuple[StageTotals, ...]
    resumed: int
    notes: tuple[str, ...]
    identity: Mapping[str, str]
    _hit_counts: Callable[[], Ints] = field(repr=False)
    sample_rays: Floats32 = field(repr=False)
    seconds: float = 0.0
    survey_seconds: float = 0.0
    planning_seconds: float = 0.0
    replayed: int = 0

    @property
    def thinned(self) -> str:
        """Clause on points that were thinned out, to follow their number.

        The clause is empty if all points are kept.
        """
        keep_every = self.survey.keep_every
        return f", one in {keep_every:,} hits of each scan (keep_every)" if keep_every > 1 else ""

    @property
    def records(self) -> tuple[TaskRecord, ...]:
        """Tasks of the run, with worker and time, every n-th of a stage with thousands."""
        return tuple(record for totals in self.stages for record in totals.records)

    @cached_property
    def cloud(self) -> Cloud:
        """The points in memory, read on first use."""
        return self.points.load()

    @cached_property
    def hit_counts(self) -> Ints:
        """Hits for each counter of the scene, read on first use."""
        return self._hit_counts()


@dataclass(frozen=True)
class CampaignRun:
    """Result of `Campaign.run`.

    Parameters
    ----------
    failed
        Jobs that have failed, with `number`, `name`, `values` and `error` (`jobs.csv`).
    done, points, rays
        Jobs in the data set, their points, and the rays that were cast for them.
    casting_seconds
        Casting time of all tasks.
    resumed
        Jobs of an earlier run.
    seconds
        Wall time of this run.
    stages
        Tasks of each stage.
    notes, sensors, classes
        Remarks for the user, the sensors of the jobs that are done, {name: models and rates}, and
        names of classes, {number: name}.
    """

    __signature__ = ReadableSignature()

    failed: tuple[JobRow, ...]
    done: int
    points: int
    rays: int
    casting_seconds: float
    resumed: int
    seconds: float
    stages: tuple[StageTotals, ...] = ()
    notes: tuple[str, ...] = ()
    sensors: Mapping[str, str] = field(default_factory=dict)
    classes: Mapping[int, str] = field(default_factory=dict)
    __repr__ = one_line

    @classmethod
    def from_rows(
        cls, rows: Iterable[JobRow], seconds: float, resumed: int | None = None, **details: Any
    ) -> CampaignRun:
        """Sum up the rows of a campaign, where by default all jobs are of an earlier run."""
        failed = []
        job_count = 0
        points = 0
        rays = 0
        casting_seconds = 0.0
        for row in rows:
            if row.error:
                failed.append(row)
            else:
                job_count += 1
                points += row.points
                rays += row.rays
                casting_seconds += row.seconds
        return cls(
            failed=tuple(failed),
            done=job_count,
            points=points,
            rays=rays,
            casting_seconds=casting_seconds,
            resumed=job_count if resumed is None else resumed,
            seconds=seconds,
            **details,
        )
