"""The immutable description of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from ..base.arguments import checked_fields
from ..base.declared import declared
from ..base.errors import Mistakes
from ..base.vocabulary import PATIENCE_S, WAIT_S
from ..plan import Planning
from ..scenario.scenario import Scenario
from ..scenario.sections import TaskOptions
from ..scene.scene import Scene
from ..sensor import Survey
from ..sensor.materials import MaterialTable
from .checks import check_precision


@dataclass(frozen=True, eq=False)
@checked_fields
class Job(TaskOptions):
    """A survey, possibly a planning, and how to run both.

    Parameters
    ----------
    scene, survey, planning
        The scene, how to scan it, and what to plan.
    wait_s
        How long to wait for partitions that are empty at the start, seconds.
    patience_s
        How long to wait for partitions that become empty later, seconds.

    Raises
    ------
    LidarpoolError
        If a number is below 1, the survey's precision too fine for the scene, a material is for
        no object, or an object lacks a material while others have one.
    """

    scene: Scene
    survey: Survey
    planning: Planning | None = None
    wait_s: Annotated[float, Field(ge=0)] = WAIT_S
    patience_s: Annotated[float, Field(ge=0)] = PATIENCE_S

    def __post_init__(self) -> None:
        MaterialTable.of(self.survey.materials, self.scene.all_names)  # that they fit
        for actor in self.scene.actors:
            actor.check(0.0, self.survey.duration_ns)
        check_precision(self.scene, self.survey)

    @property
    def trials(self) -> int:
        """Number of planning trials."""
        return self.planning.trials if self.planning else 0


def make_job(
    scenario: Scenario, backend: str | None = None, no_plan: bool = False, **options: Any
) -> Job:
    """Read the scene and make the job of a scenario; options override it.

    Raises
    ------
    LidarpoolError
        If a mesh file cannot be read, or fields do not fit together or the scene.
    """
    scene, survey, planning = scenario.build_scene(), None, None
    mistakes = Mistakes()
    with mistakes.noted():
        survey = scenario.survey(scene)
        MaterialTable.of(survey.materials, scene.all_names)
    with mistakes.noted():
        planning = None if no_plan else scenario.plan(scene)
    mistakes.tell()
    assert survey is not None, "a survey without mistakes"
    tasks = declared(scenario.pool, TaskOptions) | ({"backend": backend} if backend else {})
    return Job(scene, survey, planning, **tasks, **options)
