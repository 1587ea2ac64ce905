"""What a run gives, before anything is made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from poolpart import TaskRecord

from ..base.arrays import Floats32, Ints
from ..columns.cloud import Cloud
from ..columns.parts import StoredCloud
from ..pipeline.task_book import StageTotals
from ..plan import Plan, Planning, Trial
from ..scene.scene import Scene
from ..sensor import Survey


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a run gives, before anything is made of it; `lidarpool.api.result` adds to that.

    Parameters
    ----------
    points
        The points, in parts: read in order a piece at a time, or written with their `save`.
    plan, trials
        The best path and all trials; None and empty without planning.
    backend
        Name of the ray-casting backend that was used.
    rays, hits
        Rays fired, and those that hit something.
    stages
        All tasks of each stage together.
    resumed
        Scans from an earlier run. `records` and seconds are of this run only.
    notes
        Remarks for the user, such as that the GPU partition had no GPU.
    identity
        Fingerprints of scene, survey and planning, and versions of the software.
    sample_rays
        float32 (k, 2, 3): first and last point of some rays, metres, local coordinates.
    seconds, survey_seconds, planning_seconds
        Wall time of all, of the survey and of the planning.
    replayed
        Batches that were offered again.
    """

    scene: Scene
    survey: Survey
    planning: Planning | None
    points: StoredCloud
    plan: Plan | None
    trials: tuple[Trial, ...]
    backend: str
    rays: int
    hits: int
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
        """Why there are fewer points than hits, for behind their number; empty if all are kept."""
        every = self.survey.keep_every
        return f", one of every {every:,} hits of a scan (keep_every)" if every > 1 else ""

    @property
    def records(self) -> tuple[TaskRecord, ...]:
        """Tasks of the run, with worker and time; every n-th of a stage with thousands."""
        return tuple(record for totals in self.stages for record in totals.records)

    @cached_property
    def cloud(self) -> Cloud:
        """The points in memory, read on first use."""
        return self.points.load()

    @cached_property
    def hit_counts(self) -> Ints:
        """Hits by `counters` of the scene, read when first asked for."""
        return self._hit_counts()
