"""What a run is to do; it does not change while it is done."""

from __future__ import annotations

from dataclasses import dataclass

from .checks import check_counts, check_precision
from .plan import Planning
from .scene import Scene
from .survey import Survey


@dataclass(frozen=True, eq=False)
class Job:
    """A survey, beside it perhaps a planning, and how both are to be run.

    Parameters
    ----------
    scene, survey, planning
        What to scan, how, and what to plan meanwhile.
    backend
        Ray-casting backend of stage 2: auto, cuda, embree or numpy.
    queue_capacity
        Items that stage 1 may be ahead of stage 2.
    collectors
        Tasks of stage 4.

    Raises
    ------
    LidarpoolError
        If a number is below 1, or the survey's precision too fine for the scene.
    """

    scene: Scene
    survey: Survey
    planning: Planning | None = None
    backend: str = "auto"
    queue_capacity: int = 10
    collectors: int = 2

    def __post_init__(self) -> None:
        check_precision(self.scene, self.survey)
        check_counts(queue_capacity=self.queue_capacity, collectors=self.collectors)

    @property
    def trials(self) -> int:
        """Planning trials that there are to be."""
        return self.planning.trials if self.planning else 0
