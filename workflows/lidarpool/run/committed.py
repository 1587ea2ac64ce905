"""Committed run, and the result that is created from it if the run is a survey."""

from __future__ import annotations

from dataclasses import dataclass

from lidarscenario.empty_cloud import EMPTY, empty_cloud_reason
from lidarscenario.plan import best
from lidarscenario.shard import ALL

from .pipeline.task_book import StageTotals
from .progress import Screen
from .run_result import RunResult
from .store.run_store import RunStore


@dataclass(frozen=True)
class CommittedRun:
    """Run whose jobs are all committed to its store.

    Attributes
    ----------
    store
        Store of the run.
    stages
        Totals of the tasks in each stage, which are empty if all points come from an earlier run.
    seconds, survey_seconds, planning_seconds
        Wall time of the run since its store was opened, of the survey, and of the planning, in
        seconds.
    replayed
        Number of batches that were cast or sent more than once.
    """

    store: RunStore
    stages: tuple[StageTotals, ...] = ()
    seconds: float = 0.0
    survey_seconds: float = 0.0
    planning_seconds: float = 0.0
    replayed: int = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings about the scenario, followed by the notes of the run."""
        only_job = self.store.only_job
        location_warning = "" if only_job is None else only_job.job.location_warning
        notes = (*self.store.warnings, location_warning, *self.store.notes)
        return tuple(dict.fromkeys(filter(None, notes)))

    def result(self, screen: Screen) -> RunResult:
        """Create the result of a survey, and warn the user if it has no points."""
        only_job = self.store.only_job
        assert only_job is not None, "the run is a survey"
        job = only_job.job
        trials = tuple(sorted(only_job.trials, key=lambda trial: trial.trial))
        points = only_job.points()
        if not len(points):
            self._warn_of_empty_cloud(screen)
        return RunResult(
            scene=job.scene,
            survey=job.survey,
            planning=job.planning,
            points=points,
            plan=best(trials, job.planning) if job.planning else None,
            trials=trials,
            backend=self.store.backend,
            rays=job.survey.ray_count,
            hit_count=only_job.parts.hit_count,
            stages=self.stages,
            resumed=only_job.resumed,
            notes=self.notes,
            identity=self.store.identity,
            _hit_counts=only_job.hit_counts,
            sample_rays=only_job.sample_rays(),
            seconds=self.seconds,
            survey_seconds=self.survey_seconds,
            planning_seconds=self.planning_seconds,
            replayed=self.replayed,
        )

    def _warn_of_empty_cloud(self, screen: Screen) -> None:
        """Warn that the survey has no points, and also add a note unless the run is a shard."""
        store = self.store
        assert store.only_job is not None
        job = store.only_job.job
        shard = store.jobs.shard
        if shard != ALL:
            scans = shard.scans(job.survey.scan_count)
            reason = empty_cloud_reason(job.scene, job.survey, scans)
            screen.warn(f"shard {shard} has no points: {reason}")
            return
        warning = f"{EMPTY}: {empty_cloud_reason(job.scene, job.survey, None)}"
        store.notes.append(warning)
        screen.warn(warning)
