"""Scene, drive and sensor that were reconstructed from a recording, and their files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from lidarfiles.clouds.folder import result_folder
from lidarfiles.work.publishing import publishing
from lidarscenario.points.point_scene import CLASS_MATERIAL
from lidarscenes.writers.scene_file import write_scene
from lidarsim._version import __version__
from lidarsim.errors import explain_os_errors
from lidarsim.motion.rotations import quaternions_of
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.scene import Scene
from lidarsim.sensor.models import SensorModel
from lidarview.page_templates import render_template

from ..comparing import lidar4d
from .labels import SurfelMaterial
from .recorded_actors import FOLDER as ACTORS_FOLDER
from .recorded_actors import RecordedActor, class_names

SCENE_FILE = "place.glb"
TRAJECTORY_FILE = "trajectory.csv"
SENSOR_FILE = "sensor.yaml"
SCENARIO_FILE = "scenario.yaml"
FIGURES_FILE = "twin.json"
PAGE_FILE = "report.html"
# includes the columns that the KITTI export requires
_COLUMNS = ["time", "intensity", "reflectivity", "class"]
_POSE_DECIMALS = 6
NO_RETURN = "no return"  # object name of surfels that return no pulses
_ROTATION_FIELDS = {"clockwise", "zero_deg", "rate_hz"}  # written even if they have default values
_MIN_STEP_S = 1e-5  # minimum time between poses of the trajectory


class TwinPose(NamedTuple):
    """Pose of the sensor at a given time."""

    pose: Floats  # (4, 4)
    time_s: float


@dataclass(frozen=True, eq=False, repr=False)
class Twin:
    """Static scene reconstructed from a recording, and the drive and sensor of the recording.

    Attributes
    ----------
    scene
        The scene as surfels, with reflectances as colors and classes as materials.
    poses
        Transformations from the sensor frame at the timestamp of each sweep to the scene frame.
        float64 array of shape (s, 4, 4).
    times_s
        Timestamps of the sweeps in seconds since the first. float64 array of shape (s,).
    start, stop
        Pose and time of the first point of the first sweep, and of the end of the last sweep, in
        the same frames as `poses` and `times_s`.
    origin
        Origin of the scene frame in the world frame of the recorded poses, in meters. float64 array
        of shape (3,).
    model
        The recorded sensor with the fitted noise.
    figures
        Statistics and texts of the report. Lengths are in meters.
    pictures
        Charts of the report by name.
    actors
        Moving objects of the recording.
    classes
        Names of the semantic classes from the recording, keyed by class number.
    """

    scene: Scene
    poses: Floats
    times_s: Floats
    start: TwinPose
    stop: TwinPose
    origin: Floats
    model: SensorModel
    figures: dict[str, Any]
    pictures: dict[str, Any]
    actors: Sequence[RecordedActor] = ()
    classes: Mapping[int, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        return render_template("twin.txt", __name__, lidar4d.__name__, report=self.figures).rstrip(
            "\n"
        )

    def save(self, folder: str | Path) -> list[Path]:
        """Write the scene, drive and sensor, a scenario that uses all three, and a report.

        The folder is created if it does not exist.

        Returns
        -------
        list of Path
            The written files and folders.

        Raises
        ------
        LidarError
            If the folder cannot be written to.
        """
        path = Path(folder)
        with (
            result_folder(path),
            explain_os_errors(
                f"The reconstruction cannot be written to {path}", "free some disk space"
            ),
            publishing(path / SCENARIO_FILE, remove=[ACTORS_FOLDER]) as staged,
        ):
            self.write(staged)
        return [path / name for name in self.file_names]

    @property
    def file_names(self) -> list[str]:
        """Names of the files and folders that `save` writes. The scenario is the last one."""
        names = [SCENE_FILE, TRAJECTORY_FILE, SENSOR_FILE, FIGURES_FILE, PAGE_FILE]
        return [*names, *([ACTORS_FOLDER] if self.actors else []), SCENARIO_FILE]

    def write(self, staged: Path) -> None:
        """Write the files of `save` to an empty folder."""
        write_scene(staged / SCENE_FILE, self.scene)
        if self.actors:
            (staged / ACTORS_FOLDER).mkdir()
        for actor in self.actors:
            actor.write(staged / ACTORS_FOLDER)
        pictures = {name: page.svg() for name, page in self.pictures.items()}
        page = render_template(
            "twin.html", __name__, lidar4d.__name__, report=self.figures, pictures=pictures
        )
        stated = self.model.model_dump(mode="json", exclude_defaults=True)
        stated |= self.model.model_dump(mode="json", include=_ROTATION_FIELDS)
        model = {name: stated[name] for name in SensorModel.model_fields if name in stated}
        texts = {
            TRAJECTORY_FILE: self._trajectory(),
            SENSOR_FILE: yaml.safe_dump(model, sort_keys=False, default_flow_style=None),
            SCENARIO_FILE: self._scenario(),
            FIGURES_FILE: json.dumps(self.figures, indent=1, allow_nan=False) + "\n",
            PAGE_FILE: page,
        }
        for name, text in texts.items():
            (staged / name).write_text(text, encoding="utf-8", newline="\n")

    def _materials(self) -> list[SurfelMaterial]:
        """Return the materials of surfels that have a class or gaps, in ascending order."""
        materials = self.scene.materials
        names = set() if materials is None else {*chain.from_iterable(materials.names)}
        return sorted(SurfelMaterial.from_name(name) for name in names if name)

    def _trajectory(self) -> str:
        """Format the trajectory as CSV, from the start of the first sweep to the end of the last.

        If the trajectory ended at the last timestamp, a simulation would omit the last sweep.
        """
        before = [self.start] if self.start.time_s < self.times_s[0] else []
        after = [self.stop] if self.stop.time_s > self.times_s[-1] + _MIN_STEP_S else []
        poses = np.stack([*(one.pose for one in before), *self.poses, *(one.pose for one in after)])
        times_s = [*(one.time_s for one in before), *self.times_s, *(one.time_s for one in after)]
        quaternions = quaternions_of(poses[:, :3, :3])
        rows = np.column_stack([times_s, poses[:, :3, 3], quaternions])
        lines = ["time_s,x,y,z,qx,qy,qz,qw"]
        lines += [",".join(f"{value:.{_POSE_DECIMALS}f}" for value in row) for row in rows]
        return "\n".join(lines) + "\n"

    def _scenario(self) -> str:
        """Format a scenario that simulates the recorded drive of the sensor through the scene."""
        scenario: dict[str, Any] = {
            "scene": SCENE_FILE,
            "sensor": SENSOR_FILE,
            "trajectory": TRAJECTORY_FILE,
        }
        if self.origin.any():
            scenario["world"] = {"origin": self.origin.tolist()}
        light = {"reflectance": "texture"} if self.scene.has_colors.any() else {}
        surfel_materials = self._materials()
        is_dark = NO_RETURN in self.scene.names
        materials: list[dict[str, Any]] = [{"objects": NO_RETURN, "reflectance": 0}] * is_dark
        materials += [material.entry() | light for material in surfel_materials]
        if light or materials:
            scenario["materials"] = [*materials, {"objects": "*"} | light]
        scenario["classes"] = {0: "unlabeled"} | {
            number: f"{CLASS_MATERIAL}{number}"
            for number in sorted({material.semantic_class for material in surfel_materials})
            if number
        }
        if self.actors:
            scenario["classes"] |= class_names(self.actors)
            scenario["actors"] = [actor.section() for actor in self.actors]
        scenario["classes"] |= {
            number: self.classes[number] for number in scenario["classes"] if number in self.classes
        }
        scenario["cloud"] = {"columns": _COLUMNS}
        head = (
            f"# Reconstruction of {self.figures['name']}, created by lidarpool "
            f"{__version__}.\n# To simulate another sensor on the same drive: lidarpool run "
            "scenario.yaml --sensor MODEL\n"
        )
        return head + yaml.safe_dump(scenario, sort_keys=False, default_flow_style=None)
