"""What a run gives."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from poolpart import TaskRecord

from .cloud import Cloud
from .plan import Plan, Trial
from .scan import StoredCloud
from .task_book import StageTotals


@dataclass(frozen=True, eq=False)
class Result:
    """What a run gives.

    Parameters
    ----------
    points
        The merged points, on disk: to be read in order a part at a time, or written with
        `save_cloud`.
    hit_counts
        int64 (f,): rays that hit each triangle of the scene.
    sample_rays
        float32 (k, 2, 3): first and last point of some rays, metres, local coordinates.
    plan, trials
        The best path and all trials; None and empty where nothing was planned.
    backend
        Name of the ray-casting backend that was used.
    rays, hits
        Rays fired, and those that hit something.
    records
        Tasks of the run: where each ran and when; of a stage with thousands, every so many.
    stages
        All tasks of each stage together.
    seconds, survey_seconds, planning_seconds
        Wall time of all, of the survey and of the planning.
    replayed, duplicates_dropped
        Batches that had to be sent again, and scans that came twice because of it.
    resumed
        Scans whose points an earlier run had left in the journal. `records` and seconds are of
        this run only.
    notes
        What a user should know, such as that the GPU partition had no GPU.
    """

    points: StoredCloud
    hit_counts: NDArray[np.int64]
    sample_rays: NDArray[np.float32]
    plan: Plan | None
    trials: tuple[Trial, ...]
    backend: str
    rays: int
    hits: int
    records: tuple[TaskRecord, ...]
    stages: tuple[StageTotals, ...]
    seconds: float
    survey_seconds: float
    planning_seconds: float
    replayed: int
    duplicates_dropped: int
    resumed: int
    notes: tuple[str, ...]

    @cached_property
    def cloud(self) -> Cloud:
        """The merged points in memory, 34 bytes each; read from disk when first asked for."""
        return self.points.load()
