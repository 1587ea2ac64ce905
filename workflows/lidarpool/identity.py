"""What makes the bytes of a result: two runs that agree in it give the same cloud."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from ._version import __version__
from .plan import Planning
from .scene import Scene
from .survey import Survey


@dataclass(frozen=True)
class Identity:
    """Fingerprints of the inputs of a run, and the versions of what computes with them.

    Parameters
    ----------
    scene, survey, planning
        SHA-256, in hexadecimal; the last is empty where nothing is planned.
    versions
        Of this package and of those whose arithmetic shows in the points.
    """

    scene: str
    survey: str
    planning: str
    versions: Mapping[str, str]

    @classmethod
    def of(cls, scene: Scene, survey: Survey, planning: Planning | None) -> Identity:
        """Identity of a run."""
        return cls(
            scene=_fingerprint(
                [scene.vertices, scene.faces, scene.face_object, scene.origin],
                {"names": scene.names},
            ),
            survey=_survey_fingerprint(survey),
            planning="" if planning is None else _planning_fingerprint(planning),
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

    def to_data(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Identity:
        """Inverse of `to_data`.

        Raises
        ------
        KeyError, TypeError, ValueError
            If it is not that.
        """
        versions = {str(name): str(number) for name, number in dict(data["versions"]).items()}
        texts = {name: str(data[name]) for name in ("scene", "survey", "planning")}
        return cls(**texts, versions=versions)


def _survey_fingerprint(survey: Survey) -> str:
    poses = np.array(
        [(*pose.position, pose.yaw_deg, pose.pitch_deg, pose.roll_deg) for pose in survey.poses]
    )
    names = ("steps", "keep_every", "precision_m")
    values = {name: getattr(survey, name) for name in names}
    return _fingerprint([poses], {**values, "sensor": asdict(survey.sensor)})


def _planning_fingerprint(planning: Planning) -> str:
    names = ("start", "target", "trials", "particles", "iterations", "waypoints", "seed")
    values = {name: getattr(planning, name) for name in names}
    return _fingerprint([planning.centres, planning.radii], values)


def _fingerprint(arrays: Iterable[np.ndarray], values: Mapping[str, Any]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    # JSON writes each float with as many digits as tell it from its neighbours.
    digest.update(json.dumps(values, sort_keys=True, default=_plain).encode())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    """NumPy's numbers as Python's."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no fingerprint")


def _open3d_version() -> str:
    """Version of Open3D, by either of the names that it is distributed under."""
    for name in ("open3d-cpu", "open3d"):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "none"
