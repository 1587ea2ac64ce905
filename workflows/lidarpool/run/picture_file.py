"""What the pictures of a result are drawn from, beside the cloud, kept in a file of its own."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import LidarpoolError
from ..plan import Plan, Planning
from ..scene.scene import Scene
from ..sensor import Survey
from .result import Result

PICTURE_FILE = "pictures.npz"
PICTURES = ("scene", "intensity", "cloud", "path")  # that are drawn

PLACES_MOST = 200  # of a sensor that moves
_FORMAT = 1
_PLAN_NUMBERS = ("length", "shortest_possible", "clearance", "trial", "trials")


@dataclass(frozen=True, eq=False)
class Pictured:
    """What the pictures of a result show, but for the points of the cloud.

    Parameters
    ----------
    scene
        What was scanned.
    poses
        float64 (p, 3): where the sensor stood, metres, world coordinates.
    hit_counts
        int64 (f,): hits of each triangle.
    sample_rays
        float32 (k, 2, 3): ends of some rays, metres, local coordinates.
    planning, plan
        What was planned and the best path; None where nothing was.
    trials
        What the best path was chosen from, float64 (w, 2) each: corners of the paths between the
        two ends, metres, local coordinates.
    """

    scene: Scene
    poses: NDArray[np.float64]
    hit_counts: NDArray[np.int64]
    sample_rays: NDArray[np.float32]
    planning: Planning | None
    plan: Plan | None
    trials: Sequence[NDArray[np.float64]]

    @classmethod
    def of(
        cls, result: Result, scene: Scene, survey: Survey, planning: Planning | None
    ) -> Pictured:
        """Return what the pictures of a result show."""
        return cls(
            scene,
            sensor_places(survey) + scene.origin,
            result.hit_counts,
            result.sample_rays,
            planning if result.plan is not None else None,
            result.plan if planning is not None else None,
            [trial.waypoints for trial in result.trials],
        )

    def save(self, path: Path) -> None:
        """Write it as a NumPy archive; the same content gives the same bytes.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        arrays: dict[str, Any] = {
            "format": _FORMAT,
            "vertices": self.scene.vertices,
            "faces": self.scene.faces,
            "face_object": self.scene.face_object,
            # Strings of NumPy are all as long as the longest, and lose zeros at their end.
            "names": np.frombuffer(json.dumps(self.scene.names).encode(), np.uint8),
            "origin": self.scene.origin,
            "poses": self.poses,
            "hit_counts": self.hit_counts,
            "sample_rays": self.sample_rays,
        }
        if self.planning is not None and self.plan is not None:
            arrays |= {
                "ends": [self.planning.start, self.planning.target],
                "centres": self.planning.centres,
                "radii": self.planning.radii,
                "path": self.plan.path,
                "waypoints": np.array(self.trials),
            }
            arrays |= {name: getattr(self.plan, name) for name in _PLAN_NUMBERS}
        # At the end of a full disk an archive that is written directly leaves a handle behind.
        memory = io.BytesIO()
        np.savez_compressed(memory, **arrays)
        path.write_bytes(memory.getbuffer())

    @classmethod
    def load(cls, path: Path) -> Pictured:
        """Read what `save` wrote. Nothing in the file is run.

        Raises
        ------
        LidarpoolError
            If the file cannot be read, is damaged, or of another version.
        """
        try:
            # NumPy leaves a file open that it opened itself and cannot read.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return cls._from_arrays(archive)
        except OSError as error:
            raise LidarpoolError(f"{path} cannot be read: {error.strerror or error}.") from error
        except Exception as error:  # zipfile, zlib, NumPy and Scene have many
            reason = " ".join(str(error).split())
            raise LidarpoolError(
                f"{path} is damaged or not of this version of lidarpool ({reason}): run the "
                "survey again."
            ) from error

    @classmethod
    def _from_arrays(cls, arrays: Mapping[str, Any]) -> Pictured:
        if (made := int(arrays["format"])) != _FORMAT:
            raise ValueError(f"it is of format {made}, not {_FORMAT}")
        scene = Scene(
            arrays["vertices"],
            arrays["faces"],
            arrays["face_object"],
            tuple(map(str, json.loads(arrays["names"].tobytes()))),
            arrays["origin"],
        )
        counts = arrays["hit_counts"]
        if counts.shape != (len(scene.faces),):
            raise ValueError(f"hit_counts of {counts.shape} for {len(scene.faces)} triangles")
        if "path" not in arrays:
            return cls(scene, arrays["poses"], counts, arrays["sample_rays"], None, None, ())
        start, target = arrays["ends"]
        planning = Planning(start, target, arrays["centres"], arrays["radii"])
        numbers = {name: arrays[name].item() for name in _PLAN_NUMBERS}
        plan, trials = Plan(path=arrays["path"], **numbers), tuple(arrays["waypoints"])
        return cls(scene, arrays["poses"], counts, arrays["sample_rays"], planning, plan, trials)


def sensor_places(survey: Survey) -> NDArray[np.float64]:
    """Where the sensor was, (p, 3): at each station, or now and then on its way."""
    path = survey.path
    if not path.moves:
        return np.array([path.pose(station).position for station in range(path.stations)])
    scans = np.unique(np.linspace(0, survey.scan_count - 1, PLACES_MOST).astype(int))
    return np.array([survey.pose(scan).position for scan in scans.tolist()])
