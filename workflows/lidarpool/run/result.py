"""What a run gives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from html import escape

import numpy as np
from numpy.typing import NDArray

from poolpart import TaskRecord

from ..base.task_book import StageTotals
from ..base.words import counted
from ..columns.cloud import Cloud
from ..columns.parts import StoredCloud
from ..plan import Plan, Planning, Trial
from ..scene.scene import Scene
from ..sensor import Survey


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a run gives.

    Parameters
    ----------
    scene, survey, planning
        What was scanned and how, and what was planned; None for nothing.
    points
        The points, in parts: to be read in order a piece at a time, or written with `save_cloud`.
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
        Batches that had to be offered again, and scans that came twice because of it.
    resumed
        Scans whose points are of an earlier run. `records` and seconds are of this run only.
    notes
        What a user should know, such as that the GPU partition had no GPU.
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
    records: tuple[TaskRecord, ...]
    stages: tuple[StageTotals, ...]
    resumed: int
    notes: tuple[str, ...]
    _hit_counts: Callable[[], NDArray[np.int64]] = field(repr=False)
    _sample_rays: Callable[[], NDArray[np.float32]] = field(repr=False)
    seconds: float = 0.0
    survey_seconds: float = 0.0
    planning_seconds: float = 0.0
    replayed: int = 0
    duplicates_dropped: int = 0

    def __repr__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self._figures())

    def _repr_html_(self) -> str:
        """Table that notebooks show."""
        rows = (
            f"<tr><th style='text-align:left'>{escape(name)}</th>"
            f"<td style='text-align:left'>{escape(value)}</td></tr>"
            for name, value in self._figures()
        )
        return f"<table>{''.join(rows)}</table>"

    def _figures(self) -> Iterator[tuple[str, str]]:
        """Names and values of what a reader looks for first."""
        yield (
            "survey",
            f"{self.survey.scan_count:,} scans, {self.rays:,} rays, {self.hits:,} hits on "
            f"{counted(len(self.scene.all_names), 'object')} ({self.backend}, "
            f"{self.survey_seconds:.1f} s)",
        )
        names = ", ".join(("x", "y", "z", *(column.in_files for column in self.points.table)))
        yield "cloud", f"{len(self.points):,} points: {names}"
        if self.plan is not None:
            free = "free of collisions" if self.plan.collision_free else "not free of collisions"
            yield (
                "path",
                f"{self.plan.length:.2f} m, {free} ({self.plan.trials} trials, "
                f"{self.planning_seconds:.1f} s)",
            )
        for note in self.notes:
            yield "note", note

    @cached_property
    def cloud(self) -> Cloud:
        """The points in memory, read when first asked for."""
        return self.points.load()

    @cached_property
    def hit_counts(self) -> NDArray[np.int64]:
        """Rays that hit each triangle of scene and actors, (f,), read when first asked for."""
        return self._hit_counts()

    @cached_property
    def sample_rays(self) -> NDArray[np.float32]:
        """First and last point of some rays, (k, 2, 3), metres, local coordinates."""
        return self._sample_rays()
