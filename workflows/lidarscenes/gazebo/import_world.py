"""Worlds of Gazebo as scenarios: a sensor for each lidar, on one carrier that stands."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import yaml

from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.input_files import read_input
from lidarsim.base.vectors import matmul
from lidarsim.scene.files.scene_graph import MeshFileError
from lidarsim.sensor import Pose
from lidarsim.sensor.survey import MAX_SENSORS

from .frames import inverted, numbers_of
from .lidars import Lidar, clean, lidars_of
from .world import World, load_world

SCENARIO_FILE = "scenario.yaml"


def import_world(world: Path, folder: Path, assets: Sequence[Path]) -> list[str]:
    """Write a world as a scenario into a folder: `scenario.yaml`, and a data file of each lidar.

    Parameters
    ----------
    world
        A .sdf or .world file with lidars.
    folder
        The folder, which exists.
    assets
        Folders in which models are looked for first.

    Returns
    -------
    What is not as in Gazebo, a line each.

    Raises
    ------
    LidarError
        If the world cannot be read, or has no lidar.
    """
    if len(assets) > 1:
        raise LidarError("it is of Gazebo: give one folder, --assets DIR.")
    loaded = _loaded(world, assets)
    lidars = [*lidars_of(loaded)]
    if not lidars:
        raise LidarError(
            f"it has no lidar (gpu_lidar, gpu_ray, lidar, ray): lidarpool init --mesh "
            f"{world.name} makes a scenario for a sensor of yours."
        )
    if len(lidars) > MAX_SENSORS:
        raise LidarError(f"it has {len(lidars)} lidars; at most {MAX_SENSORS} are allowed.")
    left_out = [f"{lidar.name}: {line}" for lidar in lidars for line in lidar.left_out]
    files = _Files()
    data = {
        "scene": {"files": [_entry(world, folder, assets)]},
        **_carrier(lidars, files),
        **_materials(loaded),
        "cloud": {"columns": ["time", "range", "intensity", "object"]},
    }
    head = [f"From {world.name} of Gazebo by lidarpool import."]
    head += [f"Not as in Gazebo: {line}." for line in left_out]
    text = "".join(f"# {line}\n" for line in head) + _dumped(data)
    for name, content in {**files.texts(), SCENARIO_FILE: text}.items():
        (folder / name).write_text(content, encoding="utf-8", newline="\n")
    return left_out


def _loaded(world: Path, assets: Sequence[Path]) -> World:
    """Return a world; LidarError if the file cannot be read."""
    with explained("it cannot be read"):
        data = read_input(world)
    try:
        return load_world(data, world, (world.parent.resolve(), *(f.resolve() for f in assets)))
    except MeshFileError as error:
        raise LidarError(f"it {error}.") from error
    except ValueError as error:
        raise LidarError(f"it is broken or cut short ({error}): export it again.") from error


def _entry(world: Path, folder: Path, assets: Sequence[Path]) -> Any:
    """Return the entry of `scene.files` for a world."""

    def relative(path: Path) -> str:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()

    name = relative(world)
    return {"file": name, "assets": relative(assets[0])} if assets else name


def _carrier(lidars: Sequence[Lidar], files: _Files) -> dict[str, Any]:
    """Return the sections of sensors and poses: of the lidars' model, or of the world's zero."""
    of_one_model = len({lidar.model for lidar in lidars}) == 1
    counts = Counter(lidar.sensor for lidar in lidars)
    sensors = {}
    for lidar in lidars:
        mount = lidar.matrix
        if of_one_model:
            mount = matmul(inverted(lidar.model_matrix), mount)
        name = lidar.sensor if counts[lidar.sensor] == 1 else lidar.name
        min_range_m, max_range_m = lidar.range_m
        sensors[name] = {
            "model": files.name_of(lidar),
            "step_deg": 360,
            **({"min_range_m": clean(min_range_m)} if min_range_m else {}),
            **({"max_range_m": clean(max_range_m)} if math.isfinite(max_range_m) else {}),
            "mount": _pose(mount),
        }
    pose = _pose(lidars[0].model_matrix) if of_one_model else {"position": [0.0, 0.0, 0.0]}
    return {"sensors": sensors, "poses": [pose], "steps": 1}


def _pose(matrix: Floats) -> dict[str, Any]:
    """Return the pose of a matrix (4, 4) as a scenario has it."""
    pose = Pose.from_rotation(matrix[:3, 3], matrix[:3, :3])
    angles = {name: clean(getattr(pose, name)) for name in ("yaw_deg", "pitch_deg", "roll_deg")}
    return {
        "position": [clean(value) for value in matrix[:3, 3].tolist()],
        **{name: angle for name, angle in angles.items() if angle},
    }


def _materials(world: World) -> dict[str, Any]:
    """Return the section of materials, for shapes with a <laser_retro>."""
    if not any(_has_retro(link.link.element) for link in world.links):
        return {}
    return {"materials": [{"objects": "*", "reflectance": "texture"}]}


def _has_retro(link: Element) -> bool:
    """Return True if a shape of a link has a <laser_retro> above 0."""
    shapes = [*link.findall("visual"), *link.findall("collision")]
    return any(numbers_of(shape, "laser_retro", 1, "0").item() > 0 for shape in shapes)


class _Files:
    """Data files of lidars; lidars with the same figures share a file."""

    def __init__(self) -> None:
        self._data: dict[str, dict[str, Any]] = {}  # {name: content}

    def name_of(self, lidar: Lidar) -> str:
        """Return the name of the file of a lidar."""
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
        """Return the files: {name: text}."""
        return {name: _dumped(data) for name, data in self._data.items()}


def _dumped(data: dict[str, Any]) -> str:
    """Return data as YAML."""
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
