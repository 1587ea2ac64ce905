"""The immutable description of a survey that can be run, alone or as one of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.errors import LidarpoolError
from ..base.validation import checked_fields
from ..export.formats import Format
from ..plan import Planning
from ..scene.scene import Scene
from ..sensor import Survey
from ..sensor.materials import MaterialTable
from ..simulator.surfaces import warn_of_grey
from .build import Built


@dataclass(frozen=True, eq=False)
@checked_fields
class Job:
    """A survey of a scene, possibly with path planning; in a `Campaign`, one of many.

    A function that makes jobs for a `Campaign` gives scene, survey and values: the campaign
    numbers, names and splits them.

    Parameters
    ----------
    scene, survey, planning
        As for `simulate`: in the scene's local coordinates.
    values
        What differs from job to job: {name: number, text, or True and False}; None for an empty
        cell. All jobs of a campaign have the same names, the columns of its table.
    number, name, split
        Its number in its campaign, its name in files, and the name of its split.
    outputs
        Formats that its cloud is also written in.
    made_of
        Names and SHA-256 of the files that it was made of.
    notes
        Remarks for the user.

    Raises
    ------
    LidarpoolError
        If something is of another type, the survey's precision is too fine for the scene, a
        material is for no object, or an object lacks a material while others have one.
    """

    scene: Scene
    survey: Survey
    planning: Planning | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    number: int = 0
    name: str = ""
    split: str = ""
    outputs: Sequence[Format] = ()
    made_of: Sequence[tuple[str, str]] = ()
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        scene, survey = self.scene, self.survey
        MaterialTable.of(survey.materials, scene.all_names, voxels=scene.has_voxels)
        for actor in scene.actors:
            actor.check(0.0, survey.duration_ns)
        _check_precision(scene, survey)
        warn_of_grey(scene, survey)

    @property
    def trials(self) -> int:
        """Number of planning trials."""
        return self.planning.trials if self.planning else 0


def job_of(built: Built, **own: Any) -> Job:
    """Return the job of a built scenario; `own` are further fields, such as `name`."""
    outputs = tuple(one for one in built.scenario.output.write if one.format != "ply")
    return Job(built.scene, built.survey, built.planning, outputs=outputs, **own)


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
