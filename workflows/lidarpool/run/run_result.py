"""Results of runs, each with the points of a survey or the totals of a campaign."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from lidarfiles.datasets.job_table import JobRow
from lidarfiles.parts.parts import StoredCloud
from lidarscenario.plan import Plan, Planning, Trial
from lidarsim.columns.cloud import Cloud
from lidarsim.numerics.arrays import Floats32, Ints
from lidarsim.scene.scene import Scene
from lidarsim.schema.value_texts import one_line
from lidarsim.survey.survey import Survey

from .job_source import describe_inputs
from .pipeline.task_book import StageTotals
from .pipeline.task_records import TaskRecord


@dataclass(frozen=True, eq=False)
class RunResult:
    """Result of a survey that has not been written to files.

    `lidarpool.Result` adds methods to this class.

    Parameters
    ----------
    points
        The points, stored in parts. They can be read in order, one piece at a time, or written by
        `save_cloud`.
    plan, trials
        The best path and all planning trials, or None and an empty tuple without planning.
    backend
        Name of the ray-casting backend that was used.
    rays, hit_count
        Number of rays fired, and number of rays that hit a surface.
    stages
        Totals of the tasks in each stage.
    resumed
        Number of scans from an earlier run. `records` and the times describe this run only.
    notes
        Notes for the user, for example if the GPU partition had no GPU.
    identity
        Fingerprints of the scene, the survey and the planning, and versions of the software.
    sample_rays
        First and last points of some rays, in meters in local coordinates. float32 array of shape
        (k, 2, 3).
    seconds, survey_seconds, planning_seconds
        Wall time of the run, of the survey and of the planning, in seconds.
    replayed
        Number of batches that were cast or sent more than once.
    """

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
    def thinning_note(self) -> str:
        """Clause about omitted points, which messages append to the number of points.

        The clause is empty if all points are kept.
        """
        keep_every = self.survey.keep_every
        return f", one in {keep_every:,} hits of each scan (keep_every)" if keep_every > 1 else ""

    @property
    def records(self) -> tuple[TaskRecord, ...]:
        """Records of the tasks in the run, with their workers and times.

        If a stage has thousands of tasks, only every n-th task is included.
        """
        return tuple(record for totals in self.stages for record in totals.records)

    @property
    def fields(self) -> Mapping[str, str]:
        """Descriptions of the fields in the scene, survey and planning."""
        return describe_inputs(self.scene, self.survey, self.planning)

    @cached_property
    def cloud(self) -> Cloud:
        """Points of the survey, which are read into memory when they are first used."""
        return self.points.load()

    @cached_property
    def hit_counts(self) -> Ints:
        """Values of all hit counters of the scene, which are read when they are first used."""
        return self._hit_counts()


@dataclass(frozen=True)
class CampaignRun:
    """Result of `Campaign.run`.

    Parameters
    ----------
    failed
        Failed jobs, with `number`, `name`, `values` and `error` as in `jobs.csv`.
    done, points, rays
        Number of jobs in the data set, and the numbers of their points and rays.
    casting_seconds
        Casting time of all tasks, in seconds, excluding jobs whose casting time is unknown.
    resumed
        Number of jobs from an earlier run.
    seconds
        Wall time of this run, in seconds.
    stages
        Totals of the tasks in each stage.
    replayed
        Number of batches that were cast or sent more than once.
    notes, sensors, classes
        Notes for the user, the sensors of the finished jobs as {name: models and rates}, and the
        names of semantic classes as {number: name}.
    """

    failed: tuple[JobRow, ...]
    done: int
    points: int
    rays: int
    casting_seconds: float
    resumed: int
    seconds: float
    stages: tuple[StageTotals, ...] = ()
    replayed: int = 0
    notes: tuple[str, ...] = ()
    sensors: Mapping[str, str] = field(default_factory=dict)
    classes: Mapping[int, str] = field(default_factory=dict)
    __repr__ = one_line

    @classmethod
    def from_rows(
        cls, rows: Iterable[JobRow], seconds: float, resumed: int | None = None, **details: Any
    ) -> CampaignRun:
        """Summarize the table rows of a campaign's jobs.

        By default, all jobs are considered to come from an earlier run. `details` are further
        fields of the result.
        """
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
                casting_seconds += row.seconds or 0.0
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
