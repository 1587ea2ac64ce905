"""Files of a study: the report, the ranking as JSON, and a scenario of the best candidate."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from lidarfiles.clouds.folder import check_new_result, result_folder
from lidarfiles.work.work import Work
from lidarscenes.writers.scene_file import write_scene
from lidarsim._version import __version__
from lidarsim.media.weather import Weather
from lidarsim.motion.trajectory import Pose
from lidarsim.scene.scene import Scene
from lidarsim.schema.declared import declared_values
from lidarsim.words import printable
from lidarview.page_templates import render_template

from ..mount_sections import VehicleFile
from .evaluation import CONTACT_M
from .study import MountRanking, MountStudy, figures_of, pose_entry

if TYPE_CHECKING:
    from lidarfiles.work.mapping import Client

SCENARIO_FILE = "best.yaml"
PAGE_FILE = "report.html"
FIGURES_FILE = "mount.json"
VEHICLE_FILE = "vehicle.glb"
SHOWN_CANDIDATES = 50  # rows of the table in the report
_SHOWN_DISTANCE_M = 10.0  # distance of the targets in the scenario
_TARGET_FILES = tuple(f"targets/{number:02}.glb" for number in range(12))  # at most


def rank_mounts(
    vehicle: str | Path,
    out: str | Path,
    *,
    client: Client | None = None,
    workers: int | None = None,
    resume: bool = False,
    restart: bool = False,
    overwrite: bool = False,
    status: Callable[[str], AbstractContextManager[object]] = nullcontext,
) -> MountRanking:
    """Evaluate and rank the mounts in a vehicle file, and write the report and a scenario.

    Parameters
    ----------
    vehicle
        Vehicle file.
    out
        Output folder. Evaluated mounts are kept in it until all files are written.
    client, workers
        As for `MountStudy.run`.
    resume
        Whether to continue an unfinished ranking in the folder.
    restart
        Whether to remove an unfinished ranking in the folder.
    overwrite
        Whether to replace existing files.
    status
        Function that returns a context for each step, and receives its description.

    Raises
    ------
    LidarError
        If a file cannot be read, if a sensor cannot be simulated, if files exist or cannot be
        written, if the folder contains an unfinished ranking that is neither resumed nor removed,
        or if the cluster is lost.
    """
    path, folder = Path(vehicle), Path(out)
    names = (SCENARIO_FILE, FIGURES_FILE, PAGE_FILE, VEHICLE_FILE, *_TARGET_FILES)
    check_new_result(folder, names, resume=resume, restart=restart, overwrite=overwrite)
    study = MountStudy.from_file(VehicleFile.load(path))
    with (
        result_folder(folder),
        Work.open(
            folder, study.inputs(path), noun="ranking", resume=resume, restart=restart
        ) as work,
    ):
        with status("simulating the sensors at all mounts"):
            result = study.run(client=client, workers=workers, work=work)
        with (
            status("drawing the pictures"),
            work.publishing(SCENARIO_FILE, _TARGET_FILES, merge=True) as staged,
        ):
            write_study(result, staged, folder)
    return result


def write_study(result: MountRanking, staged: Path, folder: Path) -> None:
    """Write the report, the ranking and a scenario to a staging folder.

    `folder` is the folder to which the files will be moved.
    """
    files = _TARGET_FILES[: len(result.study.placements.meshes)]
    meshes = {VEHICLE_FILE: result.study.evaluator.body}
    meshes |= dict(zip(files, result.study.placements.meshes, strict=False))
    for name, mesh in meshes.items():
        (staged / name).parent.mkdir(exist_ok=True)
        write_scene(staged / name, Scene.from_meshes([mesh]))
    from .pictures import MAPS, draw_all  # imports Matplotlib

    figures = figures_of(result)
    pictures = {
        name: page.html() if name in MAPS else page.svg() for name, page in draw_all(result).items()
    }
    report = figures | {"versions": {"lidarpool": __version__}, "name": _title(result)}
    mounts = [
        (candidate["name"], name, mount)
        for candidate in figures["candidates"][:SHOWN_CANDIDATES]
        for name, mount in candidate["sensors"].items()
    ]
    texts = {
        SCENARIO_FILE: _scenario(result, folder, files),
        FIGURES_FILE: json.dumps(figures, indent=1, allow_nan=False) + "\n",
        PAGE_FILE: render_template(
            "mount.html",
            __name__,
            report=report,
            pictures=pictures,
            shown=SHOWN_CANDIDATES,
            mounts=mounts,
        ),
    }
    for name, text in texts.items():
        (staged / name).write_text(text, encoding="utf-8", newline="\n")


def _title(result: MountRanking) -> str:
    return Path(result.study.vehicle.source).stem


def _scenario(result: MountRanking, folder: Path, targets: Sequence[str]) -> str:
    """Return the text of a scenario with the best candidate and a target of each shape."""
    vehicle = result.study.vehicle
    near = {name for name, sensor in result.best.sensors.items() if sensor.blocked_near}
    ground = {"objects": "*", "reflectance": vehicle.map.reflectance}
    data = {
        "scene": {"files": [VEHICLE_FILE], "ground": {"margin_m": 50.0}},
        "sensors": {
            name: _sensor_entry(result, name, pose, folder, is_near=name in near)
            for name, pose in result.best.candidate.mounts.items()
        },
        "poses": [[0.0, 0.0, 0.0]],
        "actors": _target_actors(result, targets),
        "materials": [*_target_materials(result, len(targets)), ground],
        **_conditions(vehicle),
        "cloud": {"columns": ["range"]},
    }
    head = (
        f"# {printable(result.best.candidate.name)}, the best candidate of "
        f"{printable(str(vehicle.source))}. The vehicle is "
        "the object\n# vehicle, whose origin is on the ground. Each sensor scans one revolution.\n"
    )
    if near:
        head += (
            "# A minimum range of 0.001 m lets the vehicle block beams at close range. Ignore "
            "points that\n# are closer than the minimum range of the sensor.\n"
        )
    return head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def _target_actors(result: MountRanking, files: Sequence[str]) -> list[dict[str, Any]]:
    """Return actors that stand in a circle around the vehicle."""
    actors = []
    for number, (file, mesh) in enumerate(zip(files, result.study.placements.meshes, strict=False)):
        angle = 2 * math.pi * number / len(files)
        position = [_SHOWN_DISTANCE_M * math.cos(angle), _SHOWN_DISTANCE_M * math.sin(angle), 0.0]
        at = {"position": [round(value, 3) + 0.0 for value in position], "yaw_deg": 90.0}
        actors.append({"name": mesh.name, "file": file, "at": at})
    return actors


def _target_materials(result: MountRanking, count: int) -> list[dict[str, Any]]:
    """Return materials with the reflectances of the first meshes."""
    placements = result.study.placements
    return [
        {"objects": escape(mesh.name), "reflectance": placements.targets[target].reflectance}
        for mesh, target in zip(
            placements.meshes[:count], placements.mesh_target[:count].tolist(), strict=True
        )
    ]


def _conditions(vehicle: VehicleFile) -> dict[str, Any]:
    """Return the sections of a scenario with the weather, noise and returns of a vehicle file."""
    clear = Weather()
    weather = declared_values(vehicle.weather, Weather)
    sections = {
        "returns": vehicle.returns.model_dump(mode="json", exclude_unset=True, by_alias=True),
        "noise": vehicle.noise.model_dump(mode="json", exclude_unset=True, by_alias=True),
        "weather": {k: value for k, value in weather.items() if value != getattr(clear, k)},
    }
    return {name: content for name, content in sections.items() if content}


def _sensor_entry(
    result: MountRanking, name: str, pose: Pose, folder: Path, *, is_near: bool
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
