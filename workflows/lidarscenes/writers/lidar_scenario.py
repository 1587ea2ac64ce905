"""Write the lidars in another program's world as scenarios, on a common stationary platform."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from lidarsim.errors import LidarError
from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import matmul
from lidarsim.scene.transform import inverse_pose
from lidarsim.survey.survey import MAX_SENSORS

SCENARIO_FILE = "scenario.yaml"
_ZERO = 1e-9  # smaller numbers are rounding errors


class Lidar(NamedTuple):
    """A lidar in a world file of another simulator.

    Attributes
    ----------
    name
        Name of the lidar, which is unique in the world.
    sensor
        Short name of the lidar, which several lidars can share.
    model
        Name of the model that carries the lidar.
    data
        Content of the data file for the sensor.
    range_m
        Minimum and maximum range in meters. The maximum may be infinite.
    matrix, model_matrix
        Transforms from the frames of the lidar and of the model to the world. Shape (4, 4).
    unsupported
        Differences from the other program, as one clause each.
    unseen
        Name patterns of the objects that the lidar does not see.
    """

    name: str
    sensor: str
    model: str
    data: dict[str, Any]
    range_m: tuple[float, float]
    matrix: Floats
    model_matrix: Floats
    unsupported: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()


def write_scenario(
    folder: Path,
    program: str,
    entry: Mapping[str, Any],
    lidars: Sequence[Lidar],
    sections: Mapping[str, Any],
    unsupported: Sequence[str] = (),
) -> list[str]:
    """Write a scenario with lidars to a folder. Each distinct lidar gets a data file.

    Parameters
    ----------
    folder
        Existing output folder.
    program
        Name of the other program.
    entry
        Entry of `scene.files`, with the path of the world as `file` and, optionally, a path as
        `assets`.
    lidars
        One or more lidars.
    sections
        Additional sections of the scenario.
    unsupported
        Differences from the other program, in addition to those that the lidars state.

    Returns
    -------
    Differences from the other program, one line each.

    Raises
    ------
    LidarError
        If there are too many lidars.
    """
    if len(lidars) > MAX_SENSORS:
        raise LidarError(
            f"it has {len(lidars)} lidars, but a scenario can have at most {MAX_SENSORS} sensors."
        )
    lines = [
        *unsupported,
        *(f"{lidar.name}: {line}" for lidar in lidars for line in lidar.unsupported),
    ]
    files = _Files()
    data = {
        "scene": {"files": [_relative(entry, folder)]},
        **_carrier(lidars, files),
        **sections,
        "cloud": {"columns": ["time", "range", "intensity", "object"]},
    }
    head = [f"Created from {Path(entry['file']).name} ({program}) by lidarpool import."]
    head += [f"Not supported: {line}." for line in lines]
    text = "".join(f"# {line}\n" for line in head) + _dumped(data)
    for name, content in {**files.texts(), SCENARIO_FILE: text}.items():
        (folder / name).write_text(content, encoding="utf-8", newline="\n")
    return lines


def _relative(entry: Mapping[str, Any], folder: Path) -> Any:
    """Return a `scene.files` entry with paths relative to a folder.

    If the entry has only a file, its name is returned.
    """
    paths = {
        name: Path(os.path.relpath(value.resolve(), folder.resolve())).as_posix()
        for name, value in entry.items()
        if isinstance(value, Path)
    }
    return paths["file"] if len(entry) == 1 else {**entry, **paths}


def _carrier(lidars: Sequence[Lidar], files: _Files) -> dict[str, Any]:
    """Return the scenario sections that define sensors and poses.

    If all lidars belong to the same model, the pose is that of the model. Otherwise, it is the
    origin.
    """
    of_one_model = len({lidar.model for lidar in lidars}) == 1
    counts = Counter(lidar.sensor for lidar in lidars)
    sensors = {}
    for lidar in lidars:
        mount = lidar.matrix
        if of_one_model:
            mount = matmul(inverse_pose(lidar.model_matrix), mount)
        name = lidar.sensor if counts[lidar.sensor] == 1 else lidar.name
        min_range_m, max_range_m = lidar.range_m
        sensors[name] = {
            "model": files.name_of(lidar),
            "step_deg": 360,
            **({"min_range_m": round_value(min_range_m)} if min_range_m else {}),
            **({"max_range_m": round_value(max_range_m)} if math.isfinite(max_range_m) else {}),
            "mount": _pose(mount),
            **({"unseen": list(lidar.unseen)} if lidar.unseen else {}),
        }
    pose = _pose(lidars[0].model_matrix) if of_one_model else {"position": [0.0, 0.0, 0.0]}
    return {"sensors": sensors, "poses": [pose], "steps": 1}


def _pose(matrix: Floats) -> dict[str, Any]:
    """Convert a 4 x 4 matrix to a pose in a scenario."""
    pose = Pose.from_rotation(matrix[:3, 3], matrix[:3, :3])
    angles = {
        name: round_value(getattr(pose, name)) for name in ("yaw_deg", "pitch_deg", "roll_deg")
    }
    return {
        "position": [round_value(value) for value in matrix[:3, 3].tolist()],
        **{name: angle for name, angle in angles.items() if angle},
    }


class _Files:
    """The data files of lidars. Lidars with identical values share a file."""

    def __init__(self) -> None:
        self._data: dict[str, dict[str, Any]] = {}  # {name: content}

    def name_of(self, lidar: Lidar) -> str:
        """Return the name of the data file for a lidar, which is created if necessary."""
        for name, data in self._data.items():
            if {**data, "name": ""} == {**lidar.data, "name": ""}:
                return name
        stem = re.sub(r"[^\w.-]+", "_", lidar.sensor).strip("._").lower() or "lidar"
        name = f"{stem}.yaml"
        number = 1
        while name in self._data or name == SCENARIO_FILE:
            number += 1
            name = f"{stem}-{number}.yaml"
        self._data[name] = lidar.data
        return name

    def texts(self) -> dict[str, str]:
        """Return the content of each data file as text, by name."""
        return {name: _dumped(data) for name, data in self._data.items()}


def _dumped(data: dict[str, Any]) -> str:
    """Format data as YAML."""
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def round_value(value: float) -> float:
    """Round a number to 12 significant digits for a file, and set tiny values to zero."""
    return float(f"{value:.12g}") if abs(value) > _ZERO else 0.0
