"""Rebuilds a place from a recording: the scene, the drive, the sensor, and how near they come."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import yaml
from distributed import Client

from lidarscenes.writers.scene_file import write_scene
from lidarsim._version import __version__
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import require_package
from lidarsim.errors import LidarError, explained
from lidarsim.motion.rotations import quaternions_of
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.colors import Colors, as_srgb
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.checks import check_number
from lidarsim.sensor.models import SensorModel, read_model
from lidarsim.words import plural

from ..clouds.folder import result_folder, staging
from ..clouds.kitti import CALIBRATION_FILE
from ..clouds.recording import Recording
from ..columns.parts import StoredCloud
from ..comparing.fit import Fit, fit
from ..recordings.opening import open_recording
from ..report.page.rendering import rendered
from ..scenario.point_scene import CLASS_MATERIAL
from .alignment import AlignedSweeps, Alignment, first_alignment
from .charts import STANDING_DOTS, Above, SweepImages, draw_above, draw_errors, draw_sweep
from .finished_steps import FinishedSteps, Map, TwinStep
from .held_out import HeldOut
from .labels import divided
from .lost_pulses import Answering, firings_per_turn
from .motion import Motion
from .odometry import RecordedPoses, find_poses
from .processes import mapping
from .recorded_sweeps import RecordedSweeps, Rotation
from .reflectances import IntensityModel, Reflectances, Response, fit_response
from .submap_tasks import BuildTask, StretchSurfels, StretchTask, align_stretch, build_stretch
from .submaps import AlignedStretch, Stretch, divide, joined
from .surface_map import Observations
from .surfels import joined_surfels, surfel_centers, surfel_mesh

MIN_SWEEPS = 4
SCENE_FILE = "place.glb"
TRAJECTORY_FILE = "trajectory.csv"
SENSOR_FILE = "sensor.yaml"
SCENARIO_FILE = "scenario.yaml"
FIGURES_FILE = "twin.json"
PAGE_FILE = "report.html"
_COLUMNS = ["time", "intensity", "reflectivity", "class"]  # that the export to KITTI requires, too
DEFAULT_VOXEL_M = 0.1
_FIT_SWEEPS = 13  # whose pulses tell the noise of the sensor
_COMPARED_SWEEPS = 12  # of the held-out sweeps
_POSE_DECIMALS = 6
_RESPONSE_STRETCHES = 4  # that tell the response of the sensor
_POSES = TwinStep("poses", (RecordedPoses,))
_ALIGN = TwinStep("align", (AlignedStretch,))
_BUILD = TwinStep("build", (StretchSurfels, Observations, HeldOut, SweepImages, Above))
NO_RETURN = "no return"  # name of the object of dark surfels
_ROTATION_FIELDS = {"clockwise", "zero_deg", "rate_hz"}  # which are written even by default
_RATE_DECIMALS = 4
_MIN_STEP_S = 1e-5  # between poses of the trajectory
_MIN_LEAD = 0.01  # of a revolution, by which a stamp is after the first point
_MIN_DRIVE_M = 0.3  # a shorter drive shows things from one side


class TwinPose(NamedTuple):
    """Pose at a time."""

    pose: Floats  # (4, 4)
    time_s: float


@dataclass(frozen=True, eq=False, repr=False)
class Twin:
    """A place that was reconstructed from a recording, with the recorded drive and the sensor.

    Attributes
    ----------
    scene
        The place as surfels, with reflectances as colors and classes as materials.
    poses
        Transformations from the sensor frame at the stamp of each sweep to the scene frame. float64
        array of shape (s, 4, 4).
    times_s
        Stamps of the sweeps in seconds since the first. float64 array of shape (s,).
    start, stop
        Poses as in `poses`, and times as in `times_s`, of the first point of the first sweep and
        of the end of the last sweep.
    origin
        Origin of the scene frame in the world frame of the recorded poses, in meters. float64 array
        of shape (3,).
    model
        The recorded sensor, with the fitted noise.
    figures
        Statistics and texts of the report. Lengths are in meters.
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

    def __repr__(self) -> str:
        return rendered("twin.txt", report=self.figures).rstrip("\n")

    def save(self, folder: str | Path) -> list[Path]:
        """Write the scene, the drive, the sensor, a scenario that combines them, and a report.

        The folder is created if it does not exist.

        Raises
        ------
        LidarError
            If the folder cannot be written to.
        """
        path = Path(folder)
        with (
            result_folder(path),
            explained(f"The reconstruction cannot be written to {path}", "free some disk space"),
            staging(path) as staged,
        ):
            write_scene(staged / SCENE_FILE, self.scene)
            pictures = {name: page.svg() for name, page in self.pictures.items()}
            page = rendered("twin.html", report=self.figures, pictures=pictures)
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
            return [(staged / name).replace(path / name) for name in (SCENE_FILE, *texts)]

    def _classes(self) -> dict[int, str]:
        """Return the names of the materials of surfels with a class of the recording."""
        materials = self.scene.materials
        names = () if materials is None else sorted({*chain.from_iterable(materials.names)})
        numbers = {int(name.removeprefix(CLASS_MATERIAL)): name for name in names if name}
        return {number: numbers[number] for number in sorted(numbers) if number >= 0}

    def _trajectory(self) -> str:
        """Return the table of the poses, from the start of the first sweep to the end of the last.

        Otherwise a simulation would lack the last sweep.
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
        """Return a scenario of the recording's sensor on its drive through the place."""
        scenario: dict[str, Any] = {
            "scene": SCENE_FILE,
            "sensor": SENSOR_FILE,
            "trajectory": TRAJECTORY_FILE,
        }
        if self.origin.any():
            scenario["world"] = {"origin": self.origin.tolist()}
        light = {"reflectance": "texture"} if self.scene.has_colors.any() else {}
        classes = self._classes()
        is_dark = NO_RETURN in self.scene.names
        materials: list[dict[str, Any]] = [{"objects": NO_RETURN, "reflectance": 0}] * is_dark
        materials += [
            {"material": name} | light | {"class": number} for number, name in classes.items()
        ]
        if light:
            materials.append({"objects": "*"} | light)
        if materials:
            scenario["materials"] = materials
        scenario["classes"] = {0: "unlabeled"} | {
            number: name for number, name in classes.items() if number
        }
        scenario["cloud"] = {"columns": _COLUMNS}
        head = (
            f"# Reconstruction of {self.figures['name']}, created by lidarpool "
            f"{__version__}.\n# To simulate another sensor on the same drive: lidarpool run "
            "scenario.yaml --sensor MODEL\n"
        )
        return head + yaml.safe_dump(scenario, sort_keys=False, default_flow_style=None)


def twin(
    recording: str | Path | Cloud | StoredCloud | Recording,
    *,
    model: str | Path | None = None,
    trajectory: str | Path | None = None,
    voxel_m: float = DEFAULT_VOXEL_M,
    sensor: str | None = None,
    intensity: str | None = None,
    client: Client | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Twin:
    """Reconstruct the static scene of a recording, so that it can be scanned again.

    The drive is divided into submaps, which processes reconstruct one by one. For the statistics,
    every second sweep is first held out, and the rays of some of these sweeps are cast in the scene
    that is reconstructed from the other sweeps. The final scene is reconstructed from all sweeps.

    Parameters
    ----------
    recording
        Sweeps in any format that `compare` supports, or a cloud in memory that has sweeps. The
        points may be as fired or compensated for the motion during their sweep, which is detected.
    model
        Sensor model, by name or file, from which the optics and the data sheet are taken. It is
        required for a sensor without rings. By default, the model is a sensor with the recorded
        rings.
    trajectory
        File with the poses of the sensor, with times on the clock of the recording, or in the KITTI
        format with one row for each sweep. By default, the poses are taken from the recording. If
        it has none, the sweeps are registered to each other.
    voxel_m
        Edge length in meters of the voxels in which points are averaged.
    sensor
        Name of the sensor, or topic of a bag, if the recording has several.
    intensity
        Name of the column that contains the intensities, by default ``intensity``. They may be
        energies or compensated for range, which is detected.
    client
        Client of a cluster whose OTHER workers can read the recording at the same path. By default,
        processes on this machine reconstruct the submaps. A recording in memory is always processed
        by this process.
    folder
        Folder for the results of finished steps, which is removed at the end. By default, a
        temporary folder is used.
    resume
        Whether to continue with the finished steps in the folder.
    tell
        Function that is called with a line for each step.

    Returns
    -------
    Twin
        The reconstructed scene, with the drive and the sensor.

    Raises
    ------
    LidarError
        If the recording cannot be read, has fewer than four sweeps, has no planes, or has no rings
        and `model` is not set; if an extra is missing; or if the folder contains the steps of a
        different twin.
    """
    check_number("voxel_m", voxel_m, gt=0, le=10)
    require_package("scipy", "twin", "Reconstructing a recording")
    base = None if model is None else read_model(model)  # before the recording, which takes long
    if isinstance(recording, (str, Path)):
        recorded = RecordedSweeps.open(Path(recording), sensor, intensity)
    else:
        if client is not None:
            raise LidarError(
                "A recording in memory can only be reconstructed in this process. Pass the "
                "path of a recording to use a cluster, or omit the client."
            )
        if not isinstance(recording, Recording):
            recording = open_recording(recording, sensor, intensity, name="the recording")
        recorded = RecordedSweeps.from_recording(recording)
    _check(recorded)
    if base is None and not len(recorded.elevation_rad):
        reason = " ".join(recorded.notes) or f"{recorded.recording.name} has no rings."
        raise LidarError(f"{reason} Specify its sensor, for example `--model livox/mid360`.")
    track = None if trajectory is None else Path(trajectory)
    tell = tell or (lambda line: None)
    with ExitStack() as stack:
        if folder is None:
            folder = stack.enter_context(TemporaryDirectory(prefix="lidarpool-"))
        made_of = (_stated(recorded, track), voxel_m)
        steps = FinishedSteps.begin(Path(folder), made_of, resume=resume)
        built = _Building(recorded, base, voxel_m, steps, client, tell).twin(track)
        steps.remove()
    return built


def _check(recorded: RecordedSweeps) -> None:
    """Raise LidarError if a place cannot be made of the sweeps."""
    recording = recorded.recording
    if recording.thinned:
        raise LidarError(f"{recording.notes[0]}.")
    if recorded.count < MIN_SWEEPS:
        raise LidarError(
            f"{recording.name} has {plural(recorded.count, 'sweep')}, but a reconstruction "
            f"requires at least {MIN_SWEEPS}, because sweeps that agree identify stationary "
            "surfaces."
        )


def _stated(recorded: RecordedSweeps, trajectory: Path | None) -> list[object]:
    """Return what was chosen, and names, sizes and times of change of files that twins are of.

    Nothing is the same as a recording in memory.
    """
    source = recorded.source
    if isinstance(source, Recording):
        return [secrets.token_hex()]
    files = [source[0]]
    if trajectory is not None:
        files += [trajectory, trajectory.with_name(CALIBRATION_FILE)]
    inner = chain.from_iterable(sorted(file.rglob("*")) for file in files if file.is_dir())
    stated = [
        (str(file), status.st_size, status.st_mtime_ns)
        for file in chain(files, inner)
        if file.is_file() and (status := file.stat())
    ]
    return [source, str(trajectory), *stated]


@dataclass(frozen=True, eq=False)
class _Building:
    """What a twin is built of, and how."""

    recorded: RecordedSweeps
    base: SensorModel | None
    voxel_m: float
    steps: FinishedSteps
    client: Client | None
    tell: Callable[[str], None]

    def twin(self, trajectory: Path | None) -> Twin:
        """Build the twin."""
        recorded = self.recorded
        self.tell(f"estimating the poses of {plural(recorded.count, 'sweep')}")
        poses = self._poses(trajectory)
        self.tell(f"poses {poses.source}; determining the motion compensation of the points")
        first = first_alignment(recorded, poses)
        stretches = divide(first.poses[:, :3, 3])
        counting = np.concatenate([stretch.own_numbers for stretch in stretches])
        others = counting[1::2]
        compared = others[even_indices(len(others), _COMPARED_SWEEPS)]
        task = BuildTask(
            recorded=recorded,
            alignment=first,
            stretch=stretches[0],
            mapped=counting[::2],
            answering=Answering.of_sweeps(recorded),
            compared=compared,
            voxel_m=self.voxel_m,
            drawn_share=0.0,
        )
        is_shared = not isinstance(recorded.source, Recording)
        with mapping(self.client, len(stretches) if is_shared else 1) as run:
            task = replace(task, alignment=self._aligned(run, task, stretches))
            built = self._built(run, task, stretches)
            sweeps = AlignedSweeps(recorded, task.alignment, task.answering)
            return self._finished(built, sweeps, poses)

    def _poses(self, trajectory: Path | None) -> RecordedPoses:
        """Return the poses of all sweeps."""

        def find() -> tuple[RecordedPoses]:
            return (find_poses(self.recorded, trajectory),)

        (poses,) = self.steps.once(_POSES, find)
        return poses._replace(
            source=str(poses.source), share=float(poses.share), first_s=float(poses.first_s)
        )

    def _aligned(self, run: Map, task: BuildTask, stretches: Sequence[Stretch]) -> Alignment:
        """Align all sweeps."""
        self.tell(f"aligning the sweeps in {plural(len(stretches), 'submap')}")
        tasks = [
            StretchTask(task.recorded, task.alignment, stretch, task.mapped)
            for stretch in stretches
        ]
        aligned = [one for (one,) in self.steps.each(_ALIGN, run, align_stretch, tasks)]
        return joined(task.alignment, stretches, aligned)

    def _built(self, run: Map, task: BuildTask, stretches: Sequence[Stretch]) -> _Built:
        """Build the places of all stretches."""
        sizes = [len(task.recorded.read(int(one.numbers[0]))) for one in stretches]
        count = sum(sizes) / len(sizes) * sum(len(one.own_numbers) for one in stretches)
        share = STANDING_DOTS / max(count, 1.0)
        tasks = [replace(task, stretch=one, drawn_share=share) for one in stretches]
        parts = []
        for number, part in enumerate(self.steps.each(_BUILD, run, build_stretch, tasks), 1):
            self.tell(f"built {number} of {plural(len(stretches), 'submap')}")
            surfels, _, *others = part
            parts.append(_BuiltStretch(surfels, *others))
        return _Built(parts, stretches)

    def _seen(self, index: int) -> Observations:
        """Return the rays that end on surfels of a stretch."""
        seen: Observations = self.steps.load(_BUILD, index)[1]
        return seen

    def _finished(self, built: _Built, sweeps: AlignedSweeps, poses: RecordedPoses) -> Twin:
        """Fit the response and the noise of the sensor, and make the twin."""
        recorded = self.recorded
        alignment = sweeps.alignment
        self.tell("fitting the sensor model")
        some = even_indices(len(built.parts), _RESPONSE_STRETCHES).tolist()
        response = fit_response(
            [self._seen(index) for index in some],
            recorded.ring_count,
            are_energies=recorded.recording.energies,
        )
        name = Path(recorded.recording.name).name
        # The points of a stretch may all belong to its neighbors.
        meshes = {
            index: part.surfels.mesh(name)
            for index, part in enumerate(built.parts)
            if len(part.surfels.corners)
        }
        timing = SweepTiming.of_sweeps(sweeps)
        model, notes = self._sensor(built, sweeps, meshes, response, timing)
        held_out = built.held_out()
        figures = self._figures(built, alignment) | {
            "poses": poses.source,
            "motion": alignment.motion.value,
            "held_out": held_out.figures(),
            "response": None if response is None else response.figures(),
            "model": model.name,
            "notes": [
                *recorded.recording.notes,
                *recorded.notes,
                *notes,
                *_drive_notes(alignment),
            ],
        }
        pictures = {
            "sweep": draw_sweep(built.images()),
            "above": draw_above([part.above for part in built.parts], alignment.poses[:, :3, 3]),
            "errors": draw_errors(figures),
        }
        if response is not None:
            meshes = {
                index: colored(mesh, response.reflectances(self._seen(index), surfel_centers(mesh)))
                for index, mesh in meshes.items()
            }
        return Twin(
            scene=Scene.from_meshes([*divided(joined_surfels([*meshes.values()])), *built.dark()]),
            poses=alignment.poses,
            times_s=poses.times_s,
            start=timing.start(alignment),
            stop=timing.stop(alignment),
            origin=poses.origin,
            model=model,
            figures=figures,
            pictures=pictures,
        )

    def _sensor(
        self,
        built: _Built,
        sweeps: AlignedSweeps,
        meshes: Mapping[int, SceneMesh],
        response: Response | None,
        timing: SweepTiming,
    ) -> tuple[SensorModel, list[str]]:
        """Return the sensor with the noise of its pulses on a part of the place, and notes."""
        middle = len(built.parts) // 2
        numbers = built.stretches[middle].own_numbers
        sizes = built.parts[middle].surfels.points
        near = [mesh for index, mesh in meshes.items() if abs(index - middle) <= 1]
        sensor = self.base or timing.sensor(sweeps, int(numbers[sizes.argmax()]))
        model, notes = fit_sensor(
            sweeps,
            dict(zip(numbers.tolist(), sizes.tolist(), strict=True)),
            Scene.from_meshes([joined_surfels(near)]),
            response,
            sensor,
        )
        if self.base is None and timing.rotation is None:
            notes.append(
                "the direction of rotation of the sensor is unknown, so sensor.yaml assumes a "
                "counterclockwise rotation. Set clockwise and zero_deg in this file"
            )
        return model, notes

    def _figures(self, built: _Built, alignment: Alignment) -> dict[str, Any]:
        """Return the figures of the place and of the drive."""
        path = alignment.poses[:, :3, 3]
        surfels = [part.surfels for part in built.parts]
        return {
            "versions": {"lidarpool": __version__},
            "name": Path(self.recorded.recording.name).name,
            "sweeps": self.recorded.count,
            "used_sweeps": sum(len(one.points) for one in surfels),
            "submaps": len(surfels),
            "rings": len(self.recorded.elevation_rad),
            "points": sum(int(one.points.sum()) for one in surfels),
            "moved": sum(int(one.moved.sum()) for one in surfels),
            "surfels": sum(len(one.corners) for one in surfels),
            "dark_surfels": sum(len(one.dark_corners) for one in surfels),
            "voxel_m": self.voxel_m,
            "length_m": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
            "thickness_m": list(alignment.thickness_m),
            "plane_distance_m": _median(alignment.plane_distance_m),
            "ring_offset_m": float(np.std(alignment.ring_offsets[:, 0])),
            "ring_offset_deg": float(np.degrees(np.std(alignment.ring_offsets[:, 1]))),
        }


class _BuiltStretch(NamedTuple):
    """What is kept of a stretch in memory."""

    surfels: StretchSurfels
    held_out: HeldOut | None
    images: SweepImages | None
    above: Above


@dataclass(frozen=True, eq=False)
class _Built:
    """The places of all stretches."""

    parts: Sequence[_BuiltStretch]
    stretches: Sequence[Stretch]

    def held_out(self) -> HeldOut:
        """Return the rays of all held-out sweeps that were compared."""
        return HeldOut.joined([part.held_out for part in self.parts if part.held_out is not None])

    def dark(self) -> list[SceneMesh]:
        """Return the surfels that return nothing as at most one mesh."""
        corners = np.concatenate([part.surfels.dark_corners for part in self.parts])
        return [surfel_mesh(NO_RETURN, corners)] if len(corners) else []

    def images(self) -> SweepImages:
        """Return the images of a held-out sweep in the middle, or raise LidarError without one."""
        images = [part.images for part in self.parts if part.images is not None]
        if not images:
            raise LidarError(
                "The sweeps that were held out for the comparison contain no points. Use a "
                "complete recording."
            )
        return images[len(images) // 2]


class SweepTiming(NamedTuple):
    """When sweeps start, relative to their stamps, and how the sensor rotates."""

    rate_hz: float  # revolutions in a second
    revolutions: int  # with those whose sweeps were dropped
    first_s: float  # from the stamp of a sweep to its start, at most 0
    rotation: Rotation | None  # None if unknown

    @classmethod
    def of_sweeps(cls, sweeps: AlignedSweeps) -> SweepTiming:
        """Find the timing of sweeps."""
        recorded = sweeps.recorded
        alignment = sweeps.alignment
        span_s = float(alignment.times_s[-1] - alignment.times_s[0])
        # Stamps jitter, and their mean step does not, if steps with dropped sweeps count as many.
        steps = max(round(span_s / alignment.sweep_s), 1)
        rate_hz = round(steps / span_s, _RATE_DECIMALS)
        period_s = 1 / rate_hz
        first_s = 0.0 if recorded.point_times is None else recorded.point_times.first_s
        first_s = first_s if first_s < -_MIN_LEAD * period_s else 0.0
        rotation = recorded.rotation(period_s, first_s)
        if rotation is None and alignment.motion.is_turning:
            rotation = recorded.starts(is_clockwise=alignment.motion is Motion.CLOCKWISE)
        return cls(rate_hz, steps + 1, first_s, rotation)

    def start(self, alignment: Alignment) -> TwinPose:
        """Return the start of the first sweep."""
        step, step_s = alignment.step(0)
        pose = alignment.poses[0] @ step.part(self.first_s / step_s)
        return TwinPose(pose, float(alignment.times_s[0]) + self.first_s)

    def stop(self, alignment: Alignment) -> TwinPose:
        """Return the end of the last sweep, to which its motion goes on."""
        span_s = float(alignment.times_s[-1] - alignment.times_s[0])
        rest_s = self.first_s + self.revolutions / self.rate_hz - span_s
        step, step_s = alignment.step(len(alignment.poses) - 1)
        pose = alignment.poses[-1] @ step.part(rest_s / step_s)
        return TwinPose(pose, float(alignment.times_s[-1]) + rest_s)

    def sensor(self, sweeps: AlignedSweeps, number: int) -> SensorModel | None:
        """Return a sensor with the recorded rings and rotation, or None without rings.

        The steps of azimuth are those of a sweep.
        """
        recorded = sweeps.recorded
        if not len(recorded.elevation_rad):
            return None
        elevation_deg = np.degrees(np.sort(recorded.elevation_rad)).round(3)
        known: dict[str, Any] = {}
        if self.rotation is not None:
            zero_deg = round(self.rotation.start_deg, 2) % 360
            known = {"clockwise": self.rotation.is_clockwise, "zero_deg": zero_deg}
        return SensorModel(
            name="Recorded sensor",
            sources={"angles": "median angles of the recorded points"},
            **known,
            firings_per_turn=firings_per_turn(recorded.read(number)),
            rate_hz=self.rate_hz,
            range_m=(0.0, float(np.ceil(1.1 * sweeps.answering.max_range_m))),
            beams={"elevation_deg": elevation_deg.tolist()},
        )


def fit_sensor(
    sweeps: AlignedSweeps,
    sizes: Mapping[int, int],
    scene: Scene,
    response: Response | None,
    sensor: SensorModel | None,
) -> tuple[SensorModel, list[str]]:
    """Fit the noise of a sensor to its pulses on a place.

    Parameters
    ----------
    sweeps
        Sweeps, at their places.
    sizes
        Numbers of points of the sweeps that may be read: {number of the sweep: points}.
    scene
        The place.
    response
        How intensities follow from reflectances; None without intensities.
    sensor
        The sensor without noise, which may only be None for a recording with rings.

    Returns
    -------
    tuple
        The sensor, and notes.
    """
    assert sensor is not None
    if not len(sweeps.recorded.elevation_rad):
        return sensor, ["without rings, the sensor noise is that of the sensor model"]
    # A sweep with few points, as with lost packets, looks like one of another sensor.
    counts = np.array([*sizes.values()])
    whole = np.array([*sizes])[counts >= np.median(counts) / 2]
    some = whole[even_indices(len(whole), 2 * _FIT_SWEEPS)]
    # Compensated sweeps may be tilted against the sensor, so that their rings are no cones.
    spread_rad = [sweeps.recorded.cone_spread_rad(number) for number in some.tolist()]
    chosen = np.sort(some[np.argsort(spread_rad, kind="stable")[:_FIT_SWEEPS]])
    try:
        fitted = _fitted(sweeps, chosen, scene, response)
    except LidarError as error:  # the place is there, and a scan of it needs no noise
        return sensor, [f"the sensor noise is unknown: {error}"]
    performance = fitted.model.performance
    if performance is None:
        return sensor, []
    stated = performance.model_dump(exclude_defaults=True)
    dropout = fitted.figures["figures"].get("dropout")
    if dropout is not None and not dropout["low"] > 0:
        stated.pop("dropout", None)
    count = plural(len(chosen), "sweep")
    source = f"fitted by lidarpool {__version__} to {Path(sweeps.name).name}, {count}"
    changes = {"performance": stated, "sources": {**sensor.sources, "performance": source}}
    return SensorModel.model_validate(sensor.model_dump() | changes), []


def _fitted(sweeps: AlignedSweeps, chosen: Ints, scene: Scene, response: Response | None) -> Fit:
    """Fit a sensor to chosen sweeps on a place, or raise LidarError.

    Points as fired have a pose for each pulse. Compensated ones have none: their rings are blurred,
    and steps of azimuth beside near things look like lost pulses.
    """
    recorded = sweeps.recorded
    poses = sweeps.alignment.poses[chosen]
    are_energies = response is not None and response.model is IntensityModel.ENERGIES
    white = None if response is None else response.white

    def with_points(sweep: Sweep, points: Floats, **fields: Any) -> Sweep:
        intensity = sweep.intensity
        if intensity is not None:  # as an energy, white at 10 m is 1
            intensity = intensity / (white if are_energies and white else 1)
        channel = recorded.ring_count - 1 - sweep.columns["row"]
        return sweep.with_columns(channel=channel, intensity=intensity).replace(
            points=points, **fields
        )

    def fired(index: int) -> Sweep:
        number = int(chosen[index])
        sweep = recorded.read(number)
        as_fired = sweeps.alignment.fired(sweep, number)
        assert as_fired is not None
        points, firing_poses = as_fired
        return with_points(sweep, points, firing_poses=firing_poses)

    def compensated(index: int) -> Sweep:
        number = int(chosen[index])
        sweep = recorded.read(number)
        return with_points(sweep, sweeps.aligned(sweep, number).points)

    is_compensated = sweeps.alignment.motion is Motion.COMPENSATED
    recording = Recording(
        sweeps.name,
        len(chosen),
        compensated if is_compensated else fired,
        energies=are_energies,
        read_poses=lambda: poses,
        fired=None if is_compensated else fired,
        noise_classes=None,
    )
    pose = poses if is_compensated else None
    return fit(recording, scene=scene, pose=pose, white=None if are_energies else white)


def _drive_notes(alignment: Alignment) -> list[str]:
    """Return a note on a sensor that stood."""
    if np.ptp(alignment.poses[:, :3, 3], axis=0).max() > _MIN_DRIVE_M:
        return []
    return [
        (
            "the sensor was stationary, so the reconstruction contains only surfaces that are "
            "visible from its position, with holes behind objects"
        )
    ]


def _median(values: Floats) -> float | None:
    """Return the median of the values that are known, or None."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def colored(mesh: SceneMesh, reflectances: Reflectances | None) -> SceneMesh:
    """Return the mesh of surfels, whose colors are their reflectances."""
    if reflectances is None:
        return mesh
    light = reflectances.surfels[:, None].repeat(3, axis=1)
    return replace(mesh, colors=Colors.of_faces(as_srgb(light).repeat(2, axis=0)))
