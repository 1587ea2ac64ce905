"""What the long-running stages of a run are to do each time that they are started."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from poolpart import Pipe

from ..survey import Survey
from .messages import Attempt
from .stage_names import COLLECT, GENERATE, SORT
from .stage_tasks import Command, Work
from .stages import collect, generate, sort_frames
from .survey_run import SurveyRun


def long_stages(
    run: SurveyRun,
    survey: Survey,
    *,
    collectors: int,
    first: Callable[[], int],
    pace: float | None,
    scans: Pipe,
    inlet: Callable[[str, int], Pipe],
    deliveries: Pipe,
) -> dict[str, Command]:
    """Commands for `StageTasks`, by the name of the task.

    Parameters
    ----------
    run, survey
        The run and what it scans.
    collectors
        Number of tasks of stage 4.
    first
        Says which scan stage 1 is to begin with.
    pace
        Scans a second, None for as many as are taken.
    scans, deliveries
        Pipes from stage 1, and to the driver.
    inlet
        Makes the pipe that an attempt of stage 3 or 4 is to read, of stage and number.
    """

    def generator(number: int) -> Work:
        attempt = Attempt(run.id, GENERATE, number)
        return generate, (attempt, survey, scans, first(), pace)

    def sorter(number: int) -> Work:
        return sort_frames, (Attempt(run.id, SORT, number), inlet(SORT, number), deliveries)

    def collector(name: str, number: int) -> Work:
        cloud = (survey.sensor, survey.keep_every, survey.precision_m)
        attempt = Attempt(run.id, name, number)
        return collect, (attempt, *cloud, inlet(COLLECT, number), deliveries)

    names = [f"{COLLECT}-{which}" for which in range(collectors)]
    return {
        GENERATE: generator,
        SORT: sorter,
        **{name: partial(collector, name) for name in names},
    }
