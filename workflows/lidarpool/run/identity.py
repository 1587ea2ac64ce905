"""What makes the bytes of a result: two runs that agree in it give the same cloud."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version

from .._version import __version__
from ..base.fingerprint import fingerprint
from .job import Job


@dataclass(frozen=True)
class Identity:
    """Fingerprints of the inputs of a run, and the versions of what computes with them.

    Parameters
    ----------
    scene, survey, planning
        Fingerprints; the last is empty where nothing is planned.
    versions
        Of this package and of those whose arithmetic shows in the points.
    """

    scene: str
    survey: str
    planning: str
    versions: Mapping[str, str]

    @classmethod
    def of(cls, job: Job) -> Identity:
        """Identity of a run.

        Raises
        ------
        LidarpoolError
            If a sensor, column or trajectory holds something that has no fingerprint.
        """
        scene, survey = job.scene, job.survey
        return cls(
            scene=fingerprint(
                scene.vertices, scene.faces, scene.face_object, scene.origin, scene.names
            ),
            survey=fingerprint(
                survey.sensor,
                survey.path,
                survey.steps,
                survey.keep_every,
                survey.precision_m,
                survey.columns,
            ),
            planning="" if job.planning is None else fingerprint(job.planning),
            versions={
                "lidarpool": __version__,
                "numpy": version("numpy"),
                "open3d": _open3d_version(),
            },
        )

    def difference(self, other: Identity) -> str:
        """In what `other` differs, as a clause; empty where it does not."""
        for name, here in self.versions.items():
            there = other.versions.get(name, "none")
            if there != here:
                return f"it was written with {name} {there}, here it is {here}"
        for name in ("scene", "survey", "planning"):
            if getattr(self, name) != getattr(other, name):
                return f"it is of another {name}"
        return ""

    def to_text(self) -> str:
        """JSON."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_text(cls, text: str) -> Identity:
        """Inverse of `to_text`; of anything else, an identity that nothing agrees with."""
        try:
            data = json.loads(text)
            return cls(data["scene"], data["survey"], data["planning"], dict(data["versions"]))
        except (KeyError, TypeError, ValueError):
            return cls("", "", "", {})


def _open3d_version() -> str:
    """Version of Open3D, by either of the names that it is distributed under."""
    for name in ("open3d-cpu", "open3d"):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "none"
