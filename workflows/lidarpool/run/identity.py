"""Identity of a result: runs with the same identity give the same bytes."""

from __future__ import annotations

from collections.abc import Mapping

from ..base.fingerprint import fingerprint
from ..base.software import software
from .job import Job

_CONTENT = ("scene", "survey", "planning")


def identity_of(job: Job) -> dict[str, str]:
    """Fingerprints of the inputs of a run, and of lidarpool's sources.

    The software of the workers that cast is no part of it: see `RunStore.casting`.

    Raises
    ------
    LidarpoolError
        If a sensor, column or trajectory has a field without a fingerprint.
    """
    scene, survey = job.scene, job.survey
    return {
        **software(),
        "scene": fingerprint(
            scene.vertices, scene.faces, scene.face_object, scene.origin, scene.names, scene.actors
        ),
        "survey": fingerprint(
            survey.carried,
            survey.path,
            survey.steps_each,
            survey.coordinates,
            survey.keep_every,
            survey.precision_m,
            survey.columns,
            survey.materials,
            survey.returns,
            survey.noise,
            survey.visibility_km,
            survey.epsg,
            str(survey.start),
        ),
        "planning": "" if job.planning is None else fingerprint(job.planning),
    }


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Describe the difference of an earlier run in a clause; empty if there is none."""
    for name, value in here.items():
        if there.get(name) != value:
            if name in _CONTENT:
                return f"it is of another {name}"
            return f"it was written with {name} {there.get(name, 'none')}, here it is {value}"
    return ""
