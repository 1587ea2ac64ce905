"""The immutable description of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from ..base.declared import declared
from ..base.errors import LidarpoolError, Mistakes
from ..base.validation import checked_fields
from ..base.vocabulary import PATIENCE_S, WAIT_S
from ..plan import Planning
from ..scenario.scenario import KeptScenes, Scenario
from ..scenario.sections import TaskOptions
from ..scene.scene import Scene
from ..sensor import Survey
from ..sensor.materials import MaterialTable
from ..simulator.surfaces import warn_of_grey


@dataclass(frozen=True, eq=False)
@checked_fields
class Job(TaskOptions):
    """A survey, possibly a planning, and how to run both.

    LidarpoolError if a number is below 1, the survey's precision too fine for the scene, a material
    is for no object, or an object lacks a material while others have one.
    """

    scene: Scene
    survey: Survey
    planning: Planning | None = None
    # How long to wait for partitions that are empty at the start, and that become empty later.
    wait_s: Annotated[float, Field(ge=0)] = WAIT_S
    patience_s: Annotated[float, Field(ge=0)] = PATIENCE_S

    def __post_init__(self) -> None:
        _check_materials(self.scene, self.survey)
        for actor in self.scene.actors:
            actor.check(0.0, self.survey.duration_ns)
        _check_precision(self.scene, self.survey)
        warn_of_grey(self.scene, self.survey)

    @property
    def trials(self) -> int:
        """Number of planning trials."""
        return self.planning.trials if self.planning else 0


def _check_materials(scene: Scene, survey: Survey) -> None:
    """Check that materials fit the objects."""
    MaterialTable.of(survey.materials, scene.all_names, voxels=scene.has_voxels)


def make_job(
    scenario: Scenario,
    backend: str | None = None,
    no_plan: bool = False,
    *,
    kept: KeptScenes | None = None,
    wait_s: float = WAIT_S,
    patience_s: float = PATIENCE_S,
) -> Job:
    """Read the scene and make the job of a scenario; arguments override it.

    What stands still in a scene may be `kept` from other scenarios.

    LidarpoolError if a mesh file cannot be read, or fields do not fit together or the scene.
    """
    scene, survey, planning = scenario.build_scene(kept), None, None
    mistakes = Mistakes()
    with mistakes.noted():
        survey = scenario.survey(scene)
        _check_materials(scene, survey)
    with mistakes.noted():
        planning = None if no_plan else scenario.plan(scene)
    mistakes.tell()
    assert survey is not None, "a survey without mistakes"
    tasks = declared(scenario.pool, TaskOptions) | ({"backend": backend} if backend else {})
    return Job(scene, survey, planning, **tasks, wait_s=wait_s, patience_s=patience_s)


def _check_precision(scene: Scene, survey: Survey) -> None:
    """Check that the scene spans few enough cells of the cloud's precision to be numbered."""
    reach = float(np.abs(scene.bounds).max(initial=0.0))
    for actor in scene.actors:
        ways, _ = actor.trajectory.poses(0, np.linspace(0, survey.duration_ns, 100))
        reach = max(reach, float(np.abs(ways).max() + np.abs(actor.mesh.vertices).max()))
    if reach / survey.precision_m >= 2**31 - 1:
        raise LidarpoolError(
            f"precision_m {survey.precision_m} is too fine for a scene that reaches {reach:.0f} m "
            f"from its origin: use at least {reach / 2**31:.2g}."
        )
