"""Jobs, which combine a scene with a survey and validate both."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from lidarfiles.clouds.writing import ExportSpec
from lidarsim.casting.static_bodies import warn_of_reach
from lidarsim.casting.surfaces import warn_of_gray
from lidarsim.casting.visibility import unseen_objects
from lidarsim.errors import LidarError
from lidarsim.media.materials import MaterialTable
from lidarsim.scene.actors import check_spray
from lidarsim.scene.scene import Scene
from lidarsim.schema.checks import check_fields, check_type
from lidarsim.schema.value_texts import one_line
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import Sweeps

from .georeference import check_epsg, location_warning
from .plan import Planning

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Job:
    """Survey of a scene, optionally with path planning.

    A function that creates the jobs of a `Campaign` sets only the scene, the survey and the values.
    The campaign sets the number, name and split of each job.

    Parameters
    ----------
    scene, survey, planning
        As for `simulate`, in the local coordinates of the scene.
    values
        Values that differ between the jobs of a campaign, as a mapping from names to numbers,
        strings or booleans, or None for an empty cell. All jobs of a campaign have the same names,
        which are the columns of the job table.
    number, name, split
        Number of the job in its campaign, its name in file names, and the name of its split.
    outputs
        Formats of the cloud in addition to PLY.
    input_files
        Names and SHA-256 hashes of the files that the job was created from.

    Raises
    ------
    LidarError
        If a field has the wrong type, if the precision of the survey is too small for the extent of
        the scene, if a material matches no object, if only some objects have a material, or if the
        coordinate system of the survey is not in true meters at the location of the scene.
    """

    scene: Scene
    survey: Survey
    planning: Planning | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    number: int = 0
    name: str = ""
    split: str = ""
    outputs: Sequence[ExportSpec] = ()
    input_files: Sequence[tuple[str, str]] = ()

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_type(
            "scene", self.scene, Scene, advice=" To read a file, use Scene.load('hall.glb')."
        )
        check_fields(self)
        scene = self.scene
        survey = self.survey
        MaterialTable.build(survey.materials, scene.surface_kinds, voxels=scene.has_voxels)
        unseen_objects(scene, survey)  # raises LidarError if a pattern matches no object
        # Largest local coordinate, including actors. In units of the precision, coordinates are
        # stored as 32-bit integers.
        reach_m = float(np.abs(scene.bounds).max(initial=0.0))
        if survey.spray_g_m3:  # vehicles on a wet road raise spray
            check_spray(scene.actors)
        for actor in scene.actors:
            actor.check(0.0, survey.duration_ns)
            positions, _ = actor.trajectory.poses(0, np.linspace(0, survey.duration_ns, 100))
            reach_m = max(reach_m, float(np.abs(positions).max() + np.abs(actor.bounds).max()))
        if reach_m / survey.precision_m >= 2**31 - 1:
            raise LidarError(
                f"`precision_m` is {survey.precision_m}, which is too small for a scene that "
                f"extends {reach_m:.0f} m from its origin. Set it to at least {reach_m / 2e9:.2g}"
                f"{_outlier_advice(scene)}."
            )
        if survey.epsg is not None:
            check_epsg(survey.epsg, scene)
        if self.location_warning:
            _log.warning("%s", self.location_warning)
        warn_of_gray(scene, survey)
        warn_of_reach(scene, survey)

    @cached_property
    def location_warning(self) -> str:
        """Warning that the scene is probably in the wrong location, or an empty string."""
        return location_warning(self.scene, self.survey.epsg)

    def with_fields(self, **fields: Any) -> Self:
        """Return a copy in which the given fields are replaced.

        The job is not validated again, so only use this method for fields that do not affect the
        validation, such as `number`.
        """
        job = copy(self)
        vars(job).update(fields)
        return job

    @property
    def trials(self) -> int:
        """Number of planning trials."""
        return self.planning.trials if self.planning else 0

    @cached_property
    def sweeps(self) -> Sweeps:
        """Sweeps with their poses and the bounding boxes of actors.

        Computing thousands of poses takes seconds.
        """
        return Sweeps.from_survey(self.survey, self.scene)


def _outlier_advice(scene: Scene) -> str:
    """Return advice to remove an object far away from all others, or an empty string."""
    with np.errstate(invalid="ignore"):  # the bounds of objects without triangles are infinite
        centers = scene.object_bounds.mean(axis=1)
    distances_m = np.linalg.norm(centers - np.nanmedian(centers, axis=0), axis=1)
    order = np.argsort(np.nan_to_num(distances_m))
    if len(order) < 3 or not distances_m[order[-1]] > 10 * distances_m[order[-2]]:
        return ""
    return f", or remove {scene.names[order[-1]]!r}, which is far from all other objects"
