"""What a run is to do; it does not change while it is done."""

from __future__ import annotations

from dataclasses import dataclass

from .checks import check_counts, check_precision
from .errors import LidarpoolError
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
    scans_per_second
        How fast scans are made; None for as fast as they are cast.

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
    scans_per_second: float | None = None

    def __post_init__(self) -> None:
        check_precision(self.scene, self.survey)
        check_counts(queue_capacity=self.queue_capacity, collectors=self.collectors)
        if self.scans_per_second is not None and not 0 < self.scans_per_second < float("inf"):
            raise LidarpoolError(
                f"scans_per_second is {self.scans_per_second}; it must be above 0, or None for "
                "as many as are cast."
            )

    @property
    def trials(self) -> int:
        """Planning trials that there are to be."""
        return self.planning.trials if self.planning else 0
