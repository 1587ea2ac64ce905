"""What a run gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from poolpart import TaskRecord

from .cloud import Cloud
from .plan import Plan, Trial


@dataclass(frozen=True, eq=False)
class Result:
    """What a run gives.

    Parameters
    ----------
    cloud
        The merged points.
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
        Each task of the run: where it ran and when.
    seconds, survey_seconds, planning_seconds
        Wall time of all, of the survey and of the planning.
    replayed, duplicates_dropped
        Batches that had to be sent again, and scans that came twice because of it.
    notes
        What a user should know, such as that the GPU partition had no GPU.
    """

    cloud: Cloud
    hit_counts: NDArray[np.int64]
    sample_rays: NDArray[np.float32]
    plan: Plan | None
    trials: tuple[Trial, ...]
    backend: str
    rays: int
    hits: int
    records: tuple[TaskRecord, ...]
    seconds: float
    survey_seconds: float
    planning_seconds: float
    replayed: int
    duplicates_dropped: int
    notes: tuple[str, ...]
