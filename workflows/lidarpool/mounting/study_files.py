"""Files of a study: the report, the ranking as JSON, and a scenario of the best candidate."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from lidarscenes.writers.scene_file import write_scene
from lidarsim._version import __version__
from lidarsim.errors import explain_os_errors
from lidarsim.motion.trajectory import Pose
from lidarsim.scene.scene import Scene

from ..clouds.folder import staging
from ..report.page.rendering import render_template
from .evaluation import CONTACT_M
from .pictures import draw_all
from .study import StudyResult, figures_of, pose_entry

SCENARIO_FILE = "best.yaml"
PAGE_FILE = "report.html"
FIGURES_FILE = "mount.json"
VEHICLE_FILE = "vehicle.glb"
TARGETS_FOLDER = "targets"
SHOWN_CANDIDATES = 50  # rows of the table in the report
_SHOWN_DISTANCE_M = 10.0  # distance of the targets in the scenario
_SHOWN_TARGETS = 12


def write_study(result: StudyResult, folder: Path) -> list[Path]:
    """Write the report, the ranking and a scenario to a folder that the caller has locked.

    Raises
    ------
    LidarError
        If the folder cannot be written to.
    """
    with (
        explain_os_errors(f"The report cannot be written to {folder}", "free some disk space"),
        staging(folder) as staged,
    ):
        (staged / TARGETS_FOLDER).mkdir()
        meshes = {VEHICLE_FILE: result.study.evaluator.body}
        shown = result.study.placements.meshes[:_SHOWN_TARGETS]
        files = [f"{TARGETS_FOLDER}/{number:02}.glb" for number in range(len(shown))]
        meshes |= dict(zip(files, shown, strict=True))
        for name, mesh in meshes.items():
            write_scene(staged / name, Scene.from_meshes([mesh]))
        figures = figures_of(result)
        pictures = {name: page.svg() for name, page in draw_all(result).items()}
        report = figures | {"versions": {"lidarpool": __version__}, "name": _title(result)}
        texts = {
            SCENARIO_FILE: _scenario(result, folder, files),
            FIGURES_FILE: json.dumps(figures, indent=1, allow_nan=False) + "\n",
            PAGE_FILE: render_template(
                "mount.html", report=report, pictures=pictures, shown=SHOWN_CANDIDATES
            ),
        }
        for name, text in texts.items():
            (staged / name).write_text(text, encoding="utf-8", newline="\n")
        (folder / TARGETS_FOLDER).mkdir(exist_ok=True)
        return [(staged / name).replace(folder / name) for name in (*texts, *meshes)]


def _title(result: StudyResult) -> str:
    return Path(result.study.vehicle.source).stem


def _scenario(result: StudyResult, folder: Path, target_files: list[str]) -> str:
    """Return the text of a scenario with the best candidate and a target of each shape."""
    study = result.study
    vehicle = study.vehicle
    placements = study.placements
    targets = placements.targets
    actors = []
    for number, file in enumerate(target_files):
        angle = 2 * math.pi * number / len(target_files)
        mesh = placements.meshes[number]
        x, y = _SHOWN_DISTANCE_M * math.cos(angle), _SHOWN_DISTANCE_M * math.sin(angle)
        at = {"position": [round(x, 3), round(y, 3), 0.0], "yaw_deg": 90}
        actors.append({"name": mesh.name, "file": file, "at": at})
    materials = [
        {"objects": mesh.name, "reflectance": targets[placements.mesh_target[number]].reflectance}
        for number, mesh in enumerate(placements.meshes[: len(target_files)])
    ]
    sections = {
        name: section.model_dump(mode="json", exclude_unset=True, by_alias=True)
        for name, section in (("returns", vehicle.returns), ("noise", vehicle.noise))
    }
    weather = {
        name: getattr(vehicle.weather, name)
        for name in vars(vehicle.weather)
        if getattr(vehicle.weather, name) != getattr(type(vehicle.weather)(), name)
    }
    near = {name for name, sensor in result.best.sensors.items() if sensor.blocked_near}
    data = {
        "scene": {"files": [VEHICLE_FILE], "ground": {"margin_m": 50.0}},
        "sensors": {
            name: _sensor_entry(result, name, pose, folder, is_near=name in near)
            for name, pose in result.best.candidate.mounts.items()
        },
        "poses": [[0.0, 0.0, 0.0]],
        "actors": actors,
        "materials": [*materials, {"objects": "*", "reflectance": study.evaluator.reflectance}],
        **{name: content for name, content in sections.items() if content},
        **({"weather": weather} if weather else {}),
        "cloud": {"columns": ["range"]},
    }
    head = (
        f"# {result.best.candidate.name}, the best candidate of {vehicle.source}. The vehicle is "
        "the object\n# vehicle, whose origin is on the ground. Each sensor scans one revolution.\n"
    )
    if near:
        head += (
            "# A minimum range of 0.001 m lets the vehicle block beams at close range. Ignore points "
            "that are\n# closer than the minimum range of the sensor.\n"
        )
    return head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def _sensor_entry(
    result: StudyResult, name: str, pose: Pose, folder: Path, *, is_near: bool
) -> Mapping[str, Any]:
    """Return the entry of a sensor in a scenario, which scans one revolution."""
    vehicle = result.study.vehicle
    section = vehicle.sensors[name]
    entry = section.model_dump(
        mode="json", exclude_unset=True, by_alias=True, exclude={"mounts", "ranges"}
    )
    for field in ("model", "calibration"):
        if entry.get(field) and (field == "calibration" or section.has_custom_model):
            path = vehicle.files.path(entry[field]).resolve()
            entry[field] = Path(os.path.relpath(path, folder.resolve())).as_posix()
    if is_near:
        entry["min_range_m"] = CONTACT_M
    sensor = vehicle.mounted_sensor(name, pose).sensor
    return {**entry, "mount": pose_entry(pose), "steps": len(sensor.steps_of_revolution(0))}
