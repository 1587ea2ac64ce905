"""Convert the result of a run to the data from which its images are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lidarfiles.picture_file import PictureContent, PlannedPath, PlanningPicture
from lidarscenario.plan import Plan, Planning, Trial

from ..run.run_result import RunResult


def picture_content(result: RunResult) -> PictureContent:
    """Return the data from which the images of a result are drawn."""
    planning = planning_picture(result.planning, result.plan, result.trials)
    content, drawn = PictureContent.before_casting(result.scene, result.survey, planning)
    return replace(
        content,
        hit_counts=drawn.triangle_hit_counts(result.hit_counts),
        sample_rays=result.sample_rays,
    )


def planning_picture(
    planning: Planning | None, plan: Plan | None = None, trials: Sequence[Trial] = ()
) -> PlanningPicture | None:
    """Return a drawable planning problem, with the best path and all trials if they are known.

    Return None if the run plans no path.
    """
    if planning is None:
        return None
    best = None
    if plan is not None:
        best = PlannedPath(
            corners=plan.path,
            length_m=plan.length,
            shortest_m=plan.shortest_possible,
            clearance_m=plan.clearance,
            trials=[trial.waypoints for trial in trials],
        )
    return PlanningPicture(
        start=planning.start,
        target=planning.target,
        centers=planning.centers,
        radii=planning.radii,
        best=best,
    )
