"""The immutable description of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..base.errors import LidarpoolError, Mistakes
from ..base.vocabulary import PATIENCE_S, WAIT_S
from ..plan import Planning
from ..scenario.scenario import Scenario
from ..scene.scene import Scene
from ..sensor import Survey
from ..sensor.materials import MaterialTable
from .checks import check_precision


@dataclass(frozen=True, eq=False)
class Job:
    """A survey, possibly a planning, and how to run both.

    Parameters
    ----------
    scene, survey, planning
        The scene, how to scan it, and what to plan.
    backend
        Ray-casting backend of stage 2: auto, cuda, embree or numpy.
    queue_capacity
        How many items stage 1 may be ahead of stage 2.
    collectors
        Tasks of stage 4.
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
    backend: str = "auto"
    queue_capacity: int = 10
    collectors: int = 2
    wait_s: float = WAIT_S
    patience_s: float = PATIENCE_S

    def __post_init__(self) -> None:
        MaterialTable.of(self.survey.materials, self.scene.all_names)  # that they fit
        for actor in self.scene.actors:
            actor.check(0.0, self.survey.duration_ns)
        check_precision(self.scene, self.survey)
        limits = {"queue_capacity": 1, "collectors": 1, "wait_s": 0, "patience_s": 0}
        for name, least in limits.items():
            if not getattr(self, name) >= least:  # nor NaN
                raise LidarpoolError(
                    f"{name} is {getattr(self, name)}; it must be at least {least}."
                )

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
    return Job(
        scene,
        survey,
        planning,
        backend or scenario.pool.backend,
        scenario.pool.queue_capacity,
        scenario.pool.collectors,
        **options,
    )
