"""Rebuilds a place from a recording: the scene, the drive, the sensor, and how near they come."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field

from lidarscenes.writers.scene_file import write_scene
from lidarsim._version import __version__
from lidarsim.base.arrays import Bools, Floats
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.even_samples import even_indices
from lidarsim.base.extras import need
from lidarsim.base.signatures import ReadableSignature
from lidarsim.base.validation import checked
from lidarsim.base.words import plural
from lidarsim.columns.cloud import Cloud
from lidarsim.motion.rotations import quaternions_of
from lidarsim.scene.colours import Colours, as_srgb
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sensor.models import SensorModel, read_model
from lidarview.render.picture_page import Page

from ..clouds.folder import result_folder, staging
from ..clouds.recording import Read, Recording
from ..columns.parts import StoredCloud
from ..comparing.fit import fit
from ..comparing.fit.fitting import recorded_sensor
from ..comparing.fit.stack import SweepStack
from ..recordings.opening import open_recording
from ..report.page.rendering import rendered
from ..scenario.point_scene import CLASS_MATERIAL
from .alignment import AlignedSweeps, align
from .charts import draw_above, draw_errors, draw_sweep
from .free_space import standing_points
from .held_out import HeldOut, hold_out
from .labels import divided
from .lost_pulses import Answering
from .odometry import find_poses
from .place import Place, build_place
from .recorded_sweeps import RecordedSweeps
from .reflectances import Reflectances, fit_reflectances

MIN_SWEEPS = 4
SCENE_FILE = "place.glb"
TRAJECTORY_FILE = "trajectory.csv"
SENSOR_FILE = "sensor.yaml"
SCENARIO_FILE = "scenario.yaml"
FIGURES_FILE = "twin.json"
PAGE_FILE = "report.html"
DEFAULT_VOXEL_M = 0.1
_FIT_SWEEPS = 13  # whose pulses tell the noise of the sensor
_COMPARED_SWEEPS = 12  # of the held-out sweeps
_POSE_DECIMALS = 6
_MIN_DRIVE_M = 0.3  # a shorter drive shows things from one side


@dataclass(frozen=True, eq=False, repr=False)
class Twin:
    """A place that was rebuilt from a recording, the drive through it, and the sensor.

    Attributes
    ----------
    scene
        The place: surfels with reflectances as colours, and classes as materials.
    poses
        float64 (s, 4, 4): from the sensor frame of each sweep to the scene frame.
    times_s
        float64 (s,): times of the sweeps, seconds from the first.
    origin
        float64 (3,): of the scene frame in the world of the recording's poses, metres.
    model
        The sensor of the recording, with the noise that was fitted.
    figures
        Numbers and texts of the report; lengths in metres.
    """

    __signature__ = ReadableSignature()

    scene: Scene
    poses: Floats
    times_s: Floats
    origin: Floats
    model: SensorModel
    figures: dict[str, Any]
    pictures: dict[str, Any]

    def __repr__(self) -> str:
        return rendered("twin.txt", report=self.figures).rstrip("\n")

    @checked
    def save(self, folder: str | Path) -> list[Path]:
        """Write the scene, the drive, the sensor, a scenario of the three, and a report.

        LidarError if the folder, which is created, cannot be written to.
        """
        path = Path(folder)
        with (
            result_folder(path),
            explained(f"The twin cannot be written to {path}", "make room"),
            staging(path) as staged,
        ):
            write_scene(staged / SCENE_FILE, self.scene)
            pictures = {name: page.svg() for name, page in self.pictures.items()}
            page = rendered("twin.html", report=self.figures, pictures=pictures)
            model = self.model.model_dump(mode="json", exclude_defaults=True)
            texts = {
                TRAJECTORY_FILE: self._trajectory(),
                SENSOR_FILE: yaml.safe_dump(model, sort_keys=False, default_flow_style=None),
                SCENARIO_FILE: self._scenario(),
                FIGURES_FILE: json.dumps(self.figures, indent=1, allow_nan=False) + "\n",
                PAGE_FILE: page,
            }
            for name, text in texts.items():
                (staged / name).write_text(text, encoding="utf-8", newline="\n")
            return [(staged / name).replace(path / name) for name in (SCENE_FILE, *texts)]

    def _classes(self) -> dict[int, str]:
        """Return the names of the materials of surfels with a class of the recording."""
        materials = self.scene.materials
        names = () if materials is None else sorted({*chain.from_iterable(materials.names)})
        numbers = {int(name.removeprefix(CLASS_MATERIAL)): name for name in names if name}
        return {number: numbers[number] for number in sorted(numbers) if number >= 0}

    def _trajectory(self) -> str:
        """Return the table of the poses."""
        quaternions = quaternions_of(self.poses[:, :3, :3])
        rows = np.column_stack([self.times_s, self.poses[:, :3, 3], quaternions])
        lines = ["time_s,x,y,z,qx,qy,qz,qw"]
        lines += [",".join(f"{value:.{_POSE_DECIMALS}f}" for value in row) for row in rows]
        return "\n".join(lines) + "\n"

    def _scenario(self) -> str:
        """Return a scenario of the recording's sensor on its drive through the place."""
        scenario: dict[str, Any] = {
            "scene": SCENE_FILE,
            "sensor": SENSOR_FILE,
            "trajectory": TRAJECTORY_FILE,
        }
        if self.origin.any():
            scenario["world"] = {"origin": self.origin.tolist()}
        light = {"reflectance": "texture"} if self.scene.has_colours.any() else {}
        classes = self._classes()
        materials: list[dict[str, Any]] = [
            {"material": name} | light | {"class": number} for number, name in classes.items()
        ]
        if light:
            materials.append({"objects": "*"} | light)
        if materials:
            scenario["materials"] = materials
        columns = ["time", "intensity", *(["class"] if classes else [])]
        scenario["cloud"] = {"keep_every": 1, "columns": columns}
        scenario["planning"] = {"enabled": False}
        head = (
            f"# The place of {self.figures['name']}, rebuilt by lidarpool {__version__}.\n"
            "# Another sensor on the same drive: lidarpool run scenario.yaml --sensor MODEL\n"
        )
        return head + yaml.safe_dump(scenario, sort_keys=False, default_flow_style=None)


@checked
def twin(
    recording: str | Path | Cloud | StoredCloud | Recording,
    *,
    model: str | Path | None = None,
    trajectory: str | Path | None = None,
    voxel_m: Annotated[float, Field(gt=0, le=10)] = DEFAULT_VOXEL_M,
    sensor: str | None = None,
    intensity: str | None = None,
    tell: Callable[[str], None] | None = None,
) -> Twin:
    """Rebuild the place of a recording without what moved, to scan it again.

    Every second sweep is held out first, and its rays are compared with the place that the other
    sweeps make: these are the figures. The place is then made of all sweeps.

    Parameters
    ----------
    recording
        Sweeps in any format of `compare`, or a cloud in memory that has sweeps. Points are
        compensated for the motion within their sweep, or the sensor is slow.
    model
        The sensor, by name or file, for its optics and data sheet; needed for a sensor without
        rings. By default a sensor with the recorded rings.
    trajectory
        File of the poses of the sensor. By default the poses are the recording's, and without these
        sweeps are registered to each other.
    voxel_m
        Edge of the cubes in each of which all points become their mean.
    sensor, intensity
        Name of the sensor, or topic of a bag, if the recording has several; column with the
        intensities, if not ``intensity``.
    tell
        Called with a line on each step.

    Raises
    ------
    LidarError
        If the recording cannot be read, has less than four sweeps, no planes or no rings and no
        `model`; or an extra is missing.
    """
    need("scipy", "twin", "Places are rebuilt")
    if not isinstance(recording, Recording):
        recording = open_recording(recording, sensor, intensity, name="the recording")
    if recording.thinned:
        raise LidarError(f"{recording.notes[0]}.")
    sweeps = RecordedSweeps.of_recording(recording)
    if sweeps.count < MIN_SWEEPS:
        raise LidarError(
            f"{recording.name} has {plural(sweeps.count, 'sweep')}, and a twin needs at least "
            f"{MIN_SWEEPS}: a place shows what stands by sweeps that agree."
        )
    base = None if model is None else read_model(model)
    if base is None and not len(sweeps.elevation_rad):
        raise LidarError(
            f"{' '.join(sweeps.notes) or f'{recording.name} has no rings.'} Name its sensor, for "
            "example --model livox/mid360."
        )
    return _Building(sweeps, base, voxel_m, tell or (lambda line: None)).twin(
        None if trajectory is None else Path(trajectory)
    )


@dataclass(frozen=True, eq=False)
class _Building:
    """What a twin is built of, and how."""

    recorded: RecordedSweeps
    base: SensorModel | None
    voxel_m: float
    tell: Callable[[str], None]

    def twin(self, trajectory: Path | None) -> Twin:
        """Build the twin."""
        recorded = self.recorded
        self.tell(f"{plural(recorded.count, 'sweep')}: finding poses")
        poses = find_poses(recorded, trajectory)
        mapped = list(range(0, recorded.count, 2))
        self.tell(f"poses {poses.source}; aligning the sweeps")
        sweeps = AlignedSweeps(
            recorded, align(recorded, poses, mapped), Answering.of_sweeps(recorded)
        )
        self.tell("finding what stands")
        standing = standing_points(sweeps, range(recorded.count))
        self.tell(f"building the place of {plural(len(mapped), 'sweep')}, to compare the others")
        held_out, picture = self._hold_out(sweeps, standing, mapped)
        self.tell("building the place of all sweeps")
        place, reflectances = _place_of(sweeps, standing, self.voxel_m)
        self.tell("fitting the sensor")
        model, notes = fit_sensor(sweeps, standing, place, reflectances, self.base)
        figures = self._figures(sweeps, standing, place) | {
            "poses": poses.source,
            "motion": sweeps.alignment.motion.value,
            "held_out": held_out.figures(),
            "response": None if reflectances is None else reflectances.figures(),
            "model": model.name,
            "notes": [
                *recorded.recording.notes,
                *recorded.notes,
                *notes,
                *_drive_notes(sweeps),
            ],
        }
        pictures = {
            "sweep": picture,
            "above": draw_above(sweeps, standing),
            "errors": draw_errors(figures),
        }
        mesh = coloured(place.surfels.mesh, reflectances)
        scene = Scene.from_meshes(divided(mesh))
        return Twin(
            scene=scene,
            poses=sweeps.alignment.poses,
            times_s=poses.times_s,
            origin=poses.origin,
            model=model,
            figures=figures,
            pictures=pictures,
        )

    def _hold_out(
        self, sweeps: AlignedSweeps, standing: Mapping[int, Bools], mapped: list[int]
    ) -> tuple[HeldOut, Page]:
        """Compare held-out sweeps with the place of the mapped sweeps, and draw a sweep."""
        place, reflectances = rebuild(sweeps, mapped, self.voxel_m)
        others = np.setdiff1d(np.arange(self.recorded.count), mapped)
        compared = others[even_indices(len(others), _COMPARED_SWEEPS)].tolist()
        held_out = hold_out(sweeps, place, reflectances, standing, compared)
        with_points = np.unique(held_out.sweep[held_out.returned])
        if not len(with_points):
            raise LidarError(f"{sweeps.name}: the sweeps to compare with have no points.")
        drawn = int(with_points[len(with_points) // 2])
        return held_out, draw_sweep(sweeps, place, reflectances, drawn)

    def _figures(
        self, sweeps: AlignedSweeps, standing: Mapping[int, Bools], place: Place
    ) -> dict[str, Any]:
        """Return the figures of the place and of the drive."""
        alignment = sweeps.alignment
        path = alignment.poses[:, :3, 3]
        moved = sum(int((~mask).sum()) for mask in standing.values())
        return {
            "versions": {"lidarpool": __version__},
            "name": Path(sweeps.name).name,
            "sweeps": self.recorded.count,
            "rings": len(self.recorded.elevation_rad),
            "points": sum(len(mask) for mask in standing.values()),
            "moved": moved,
            "surfels": len(place.surfels),
            "voxel_m": self.voxel_m,
            "length_m": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
            "thickness_m": list(alignment.thickness_m),
            "plane_distance_m": _median(alignment.plane_distance_m),
            "ring_offset_m": float(np.std(alignment.ring_offsets[:, 0])),
            "ring_offset_deg": float(np.degrees(np.std(alignment.ring_offsets[:, 1]))),
        }


def rebuild(
    sweeps: AlignedSweeps, numbers: Sequence[int], voxel_m: float
) -> tuple[Place, Reflectances | None]:
    """Build the place of some sweeps alone, without what moved.

    Parameters
    ----------
    sweeps
        The sweeps, all at their places.
    numbers
        Numbers of the sweeps whose points make the place, ascending.
    voxel_m
        Edge of the cubes in each of which all points become their mean.

    Returns
    -------
    tuple
        The place, and its reflectances; None without intensities.

    Raises
    ------
    LidarError
        If too few points stand.
    """
    return _place_of(sweeps, standing_points(sweeps, numbers), voxel_m)


def fit_sensor(
    sweeps: AlignedSweeps,
    standing: Mapping[int, Bools],
    place: Place,
    reflectances: Reflectances | None,
    base: SensorModel | None,
) -> tuple[SensorModel, list[str]]:
    """Fit the noise of a sensor to its pulses on a place; return the sensor, and notes.

    By default the sensor has the recorded rings. A sensor without rings is `base` itself.
    """
    if not len(sweeps.recorded.elevation_rad):
        assert base is not None
        return base, ["without rings, the noise of the sensor is that of its model"]
    # A sweep with few points, as with lost packets, looks like one of another sensor.
    counts = np.array([len(mask) for mask in standing.values()])
    whole = np.fromiter(standing, np.int64)[counts >= np.median(counts) / 2]
    chosen = whole[even_indices(len(whole), _FIT_SWEEPS)].tolist()

    def read(index: int) -> Read:
        sweep = sweeps.read(chosen[index])
        columns: dict[str, Any] = {"ring": sweeps.recorded.ring_count - 1 - sweep.ring}
        if sweep.intensities is not None:
            columns["intensity"] = sweep.intensities
        return sweep.points, columns, None

    aligned = Recording(sweeps.name, len(chosen), read)
    scene = Scene.from_meshes([place.surfels.mesh])
    white = None if reflectances is None else reflectances.white
    poses = sweeps.alignment.poses[chosen]
    try:
        fitted = fit(aligned, scene=scene, pose=poses, white=white).model
    except LidarError as error:  # the place is there, and a scan of it needs no noise
        sensor = base or recorded_sensor(SweepStack.read(aligned))
        return sensor, [f"the noise of the sensor is unknown: {error}"]
    if base is None or fitted.performance is None:
        return base or fitted, []
    source = f"fitted by lidarpool {__version__} to {Path(sweeps.name).name}"
    changes = {
        "performance": fitted.performance.model_dump(exclude_defaults=True),
        "sources": {**base.sources, "performance": source},
    }
    return SensorModel.model_validate(base.model_dump() | changes), []


def _place_of(
    sweeps: AlignedSweeps, standing: Mapping[int, Bools], voxel_m: float
) -> tuple[Place, Reflectances | None]:
    """Build the place of the points that stand, and fit its reflectances."""
    place = build_place(sweeps, standing, voxel_m)
    seen = place.observations(sweeps, standing)
    return place, fit_reflectances(seen, place.surfels, sweeps.recorded.ring_count)


def _drive_notes(sweeps: AlignedSweeps) -> list[str]:
    """Return a note on a sensor that stood."""
    if np.ptp(sweeps.alignment.poses[:, :3, 3], axis=0).max() > _MIN_DRIVE_M:
        return []
    return ["the sensor stood: the place is what it saw from there, and has holes behind things"]


def _median(values: Floats) -> float | None:
    """Return the median of the values that are known, or None."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def coloured(mesh: SceneMesh, reflectances: Reflectances | None) -> SceneMesh:
    """Return the mesh of surfels, whose colours are their reflectances."""
    if reflectances is None:
        return mesh
    light = reflectances.surfels[:, None].repeat(3, axis=1)
    return replace(mesh, colours=Colours.of_faces(as_srgb(light).repeat(2, axis=0)))
