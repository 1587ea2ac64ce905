"""Reconstruct the scene, drive and sensor of a recording, and measure the accuracy."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from lidarfiles.clouds.folder import check_new_result, result_folder
from lidarfiles.clouds.kitti import CALIBRATION_FILE
from lidarfiles.clouds.recording import PointCloud, Recording
from lidarfiles.parts.parts import StoredCloud
from lidarfiles.recordings.opening import as_recording, with_sweeps
from lidarfiles.work.mapping import MapFunction, parallel_map
from lidarfiles.work.work import Inputs, Step, Work
from lidarsim._version import __version__
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.colors import Colors, as_srgb
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.checks import check_choice, check_number
from lidarsim.sensor.models import SensorModel, read_model
from lidarsim.words import plural

from ..comparing.lidar4d import WINDOWS
from .air_returns import AirStatistics
from .alignment import AlignedSweeps, Alignment, first_alignment
from .chart_data import STATIONARY_DOTS, SweepImages, TopViewPoints
from .held_out import HeldOutRays
from .isolated_returns import IsolatedRanges
from .labels import split_by_object
from .lost_pulses import SensorCoverage
from .moving_objects import LabeledTracks
from .moving_rays import MovingRays, SweepMasks
from .odometry import RecordedPoses
from .porosity import Porosity
from .published_metrics import HeldOutFrames
from .recorded_actors import FOLDER as ACTORS_FOLDER
from .recorded_actors import RecordedActor, actors_of
from .recorded_sensor import FittedSensor, SweepTiming, fit_sensor
from .recorded_sweeps import RecordedSweeps
from .reflectances import Reflectances, Response, fit_response
from .submap_objects import MovingObjects, ObjectMap, ObjectTask
from .submap_tasks import (
    BuildTask,
    MotionTask,
    SubmapSurfels,
    SubmapTask,
    align_submap,
    build_submap,
    find_moving_rays,
)
from .submaps import AlignedSubmap, Submap, merge_alignments, split_into_submaps
from .surface_map import Observations
from .surfels import merge_surfels, surfel_centers, surfel_mesh
from .twin import NO_RETURN, SCENARIO_FILE, Twin
from .vehicle_detection import find_poses_and_vehicle
from .vehicle_returns import VehicleReturns
from .visibility import estimate_visibility

if TYPE_CHECKING:
    from lidarfiles.work.mapping import Client

ActorSource = Literal["boxes", "clusters", "none"]
MIN_SWEEPS = 4
_SUBMAP_BYTES = 3 << 30  # memory per process for a submap of a sensor with 64 rings
DEFAULT_VOXEL_M = 0.1
_COMPARED_SWEEPS = 12  # held-out sweeps that are compared
_RESPONSE_SUBMAPS = 4  # submaps from which the response of the sensor is determined
_POSES = Step("poses", (RecordedPoses, VehicleReturns, IsolatedRanges))
_ALIGN = Step("align", (AlignedSubmap,))
_MOTION = Step("motion", (SweepMasks, SweepMasks, SweepMasks, MovingRays, MovingRays))
_BUILD = Step(
    "build",
    (
        SubmapSurfels,
        Observations,
        HeldOutRays,
        HeldOutFrames,
        SweepImages,
        TopViewPoints,
        AirStatistics,
    ),
)
_MIN_DRIVE_M = 0.3  # On a shorter drive, the sensor counts as stationary.


def twin(
    recording: str | Path | Cloud | StoredCloud | Recording | PointCloud,
    *,
    model: str | Path | None = None,
    trajectory: str | Path | None = None,
    voxel_m: float = DEFAULT_VOXEL_M,
    sensor: str | None = None,
    intensity: str | None = None,
    lidar4d_window: int | None = None,
    actors: ActorSource | None = None,
    client: Client | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    restart: bool = False,
    overwrite: bool = False,
    report: Callable[[str], None] | None = None,
) -> Twin:
    """Reconstruct the static scene of a recording, so that the scene can be scanned again.

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
    lidar4d_window
        First frame of a window of KITTI-360 in which LiDAR4D was evaluated, such as 4950. Only the
        frames of this window are used, and the same frames are held out. The recording must be a
        folder with the frames of the drive 0000, or with the frames of the window.
    actors
        How the moving objects are found: "boxes" uses the labeled boxes of the recording,
        "clusters" uses clusters of points that moved, and "none" omits moving objects. By default,
        the boxes are used if the recording has any, and otherwise the clusters.
    client
        Client of a cluster whose OTHER workers can read the recording at the same path. By default,
        processes on this machine reconstruct the submaps. A recording in memory is always processed
        by this process.
    out
        Folder to which the reconstruction is written, as by `Twin.save`. The results of finished
        steps are kept in it until it is complete. By default, nothing is written.
    resume
        Whether to continue an unfinished reconstruction in the folder.
    restart
        Whether to remove an unfinished reconstruction in the folder.
    overwrite
        Whether to replace a finished reconstruction in the folder.
    report
        Function that is called with a line for each step.

    Returns
    -------
    Twin
        The reconstructed scene, with the drive and the sensor.

    Raises
    ------
    LidarError
        If the recording cannot be read, has fewer than four sweeps, has no planes, or has no rings
        and `model` is not set; if an extra is missing; if `actors` is "boxes" but the recording has
        no boxes; if the folder contains the steps of a different twin, or if another reconstruction
        is using it; or if the cluster is lost.
    """
    check_number("voxel_m", voxel_m, gt=0, le=10)
    if lidar4d_window is not None:
        check_choice("lidar4d_window", str(lidar4d_window), tuple(map(str, WINDOWS)))
    # Before the recording is read, which takes long.
    _check_output(out, resume=resume, restart=restart, overwrite=overwrite)
    base = None if model is None else read_model(model)
    if isinstance(recording, (str, Path)):
        recorded = RecordedSweeps.open(Path(recording), sensor, intensity, lidar4d_window)
    else:
        if lidar4d_window is not None:
            raise LidarError("`lidar4d_window` requires the path of a recording.")
        if client is not None:
            raise LidarError(
                "A recording in memory can only be reconstructed in this process. Pass the "
                "path of a recording to use a cluster, or omit the client."
            )
        opened = with_sweeps(as_recording(recording, sensor, intensity))
        recorded = RecordedSweeps.from_recording(opened)
    _check_sweeps(recorded)
    source = _actor_source(recorded, actors)
    if base is None and not len(recorded.elevation_rad):
        reason = " ".join(recorded.notes) or f"{recorded.recording.info.name} has no rings."
        raise LidarError(f"{reason} Specify its sensor, for example `--model livox/mid360`.")
    track = None if trajectory is None else Path(trajectory)
    report = report or (lambda line: None)
    stated = None if base is None else base.model_dump(mode="json")
    inputs = _inputs(recorded, track, {"model": stated, "options": (voxel_m, source)})
    with ExitStack() as stack:
        if out is None:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="lidarpool-")))
        else:
            folder = stack.enter_context(result_folder(Path(out)))
        work = stack.enter_context(
            Work.open(folder, inputs, noun="reconstruction", resume=resume, restart=restart)
        )
        built = _Building(recorded, base, voxel_m, source, work, client, report).twin(track)
        if out is not None:
            with work.publishing(SCENARIO_FILE, [ACTORS_FOLDER]) as staged:
                built.write(staged)
    return built


def _check_output(out: str | Path | None, *, resume: bool, restart: bool, overwrite: bool) -> None:
    """Raise LidarError if options contradict each other, or if the result exists."""
    if out is not None:
        check_new_result(
            Path(out), [SCENARIO_FILE], resume=resume, restart=restart, overwrite=overwrite
        )
    elif resume or restart or overwrite:
        name = "resume" if resume else "restart" if restart else "overwrite"
        raise LidarError(f"`{name}` requires `out`, the folder of the reconstruction.")


def _check_sweeps(recorded: RecordedSweeps) -> None:
    """Raise LidarError if the recording is unsuitable for a reconstruction."""
    recording = recorded.recording
    if recording.info.thinned:
        raise LidarError(f"{recording.notes[0]}.")
    if recorded.count < MIN_SWEEPS:
        raise LidarError(
            f"{recording.info.name} has {plural(recorded.count, 'sweep')}, but a reconstruction "
            f"requires at least {MIN_SWEEPS}, because sweeps that agree identify stationary "
            "surfaces."
        )


def _actor_source(recorded: RecordedSweeps, chosen: ActorSource | None) -> ActorSource:
    """Return how moving objects are found, or raise LidarError if there are no labeled boxes."""
    if chosen is not None:
        check_choice("actors", chosen, get_args(ActorSource))
    if chosen in ("clusters", "none"):
        return chosen
    boxes = recorded.recording.boxes
    if boxes is not None and boxes.are_tracked:
        return "boxes"
    if chosen == "boxes":
        raise LidarError(
            f"{recorded.recording.info.name} contains no labeled boxes of objects that are "
            "identified in several sweeps. Set `actors` to `clusters`, or omit it."
        )
    return "clusters"


def _inputs(
    recorded: RecordedSweeps, trajectory: Path | None, values: Mapping[str, object]
) -> Inputs:
    """Return what a twin depends on.

    A recording in memory has no identity, so it never matches an earlier one.
    """
    ref = recorded.ref
    if ref is None:
        return Inputs({}, {"recording": secrets.token_hex(), **values})
    files = {"recording": ref.path}
    if trajectory is not None:
        files |= {
            "trajectory": trajectory,
            "calibration": trajectory.with_name(CALIBRATION_FILE),
        }
    part = str(ref.folder / ref.path), ref.sensor, ref.intensity, recorded.window
    return Inputs(files, {"part of the recording": part, **values})


@dataclass(frozen=True, eq=False)
class _Building:
    """Steps of reconstructing a twin, and their settings."""

    recorded: RecordedSweeps
    base: SensorModel | None
    voxel_m: float
    actors: ActorSource
    work: Work
    client: Client | None
    report: Callable[[str], None]

    def twin(self, trajectory: Path | None) -> Twin:
        self.report(f"estimating the poses of {plural(self.recorded.count, 'sweep')}")
        poses, recorded = self._find_poses(trajectory)
        return replace(self, recorded=recorded)._build(poses)

    def _build(self, poses: RecordedPoses) -> Twin:
        recorded = self.recorded
        self.report(f"poses {poses.source}; determining the motion compensation of the points")
        first = first_alignment(recorded, poses)
        submaps = split_into_submaps(first.poses[:, :3, 3])
        counting = np.concatenate([submap.own_numbers for submap in submaps])
        mapped, compared = _held_out_split(recorded, counting)
        sweeps = AlignedSweeps(recorded, first, SensorCoverage.from_sweeps(recorded))
        task = BuildTask(
            recorded=recorded,
            alignment=first,
            submap=submaps[0],
            mapped=mapped,
            coverage=sweeps.find_coverage(mapped),
            compared=compared,
            voxel_m=self.voxel_m,
            drawn_share=0.0,
            beam_rad=_beam_rad(self.base),
        )
        is_shared = recorded.ref is not None
        count = len(submaps) if is_shared else 1
        with parallel_map(self.client, count, _SUBMAP_BYTES) as run:
            task = replace(task, alignment=self._align_submaps(run, task, submaps))
            moving = None
            if self.actors != "none":
                moving = self._find_moving_objects(run, task, submaps)
            built = self._build_submaps(run, task, submaps, moving)
            sweeps = AlignedSweeps(recorded, task.alignment, task.coverage)
            return self._assemble(built, sweeps, poses, moving)

    def _find_poses(self, trajectory: Path | None) -> tuple[RecordedPoses, RecordedSweeps]:
        """Find the poses, and the returns that do not come from the scene.

        Return the sweeps without the returns from the vehicle.
        """

        def find() -> tuple[RecordedPoses, VehicleReturns | None, IsolatedRanges]:
            poses, recorded = find_poses_and_vehicle(self.recorded, trajectory)
            return poses, recorded.vehicle, recorded.isolated

        poses, vehicle, isolated = self.work.once(_POSES, find)
        return poses, replace(self.recorded, vehicle=vehicle, isolated=isolated)

    def _align_submaps(
        self, run: MapFunction, task: BuildTask, submaps: Sequence[Submap]
    ) -> Alignment:
        self.report(f"aligning the sweeps in {plural(len(submaps), 'submap')}")
        tasks = [
            SubmapTask(task.recorded, task.alignment, submap, task.mapped) for submap in submaps
        ]
        aligned = [one for (one,) in self.work.each(_ALIGN, run, align_submap, tasks)]
        return merge_alignments(task.alignment, submaps, aligned)

    def _find_moving_objects(
        self, run: MapFunction, task: BuildTask, submaps: Sequence[Submap]
    ) -> MovingObjects:
        """Find the moving objects in all sweeps, and in the sweeps that form the map alone."""
        self.report(f"finding moving objects in {plural(len(submaps), 'submap')}")
        boxes = self.recorded.recording.boxes
        labels = LabeledTracks.from_boxes(boxes, task.alignment, task.mapped)
        used = labels if self.actors == "boxes" else None
        motion = MotionTask(**vars(task), labels=used)
        tasks = [replace(motion, submap=one) for one in submaps]
        parts = [
            (of_all, of_mapped)
            for *_, of_all, of_mapped in self.work.each(_MOTION, run, find_moving_rays, tasks)
        ]
        of_all, of_mapped = (MovingRays.concatenate(part) for part in zip(*parts, strict=True))
        del parts  # to save memory
        sweep_s = task.alignment.sweep_s
        size = self.voxel_m, self.recorded.gap_rad
        object_tasks = [
            ObjectTask(of_all, None if used is None else used.all, sweep_s, *size),
            ObjectTask(of_mapped, None if used is None else used.in_mapped, 2 * sweep_s, *size),
        ]
        in_all, in_mapped = run(ObjectMap.from_task, object_tasks)
        return MovingObjects(in_all, in_mapped, None if labels is None else labels.all)

    def _build_submaps(
        self,
        run: MapFunction,
        task: BuildTask,
        submaps: Sequence[Submap],
        moving: MovingObjects | None,
    ) -> _Built:
        sizes = [len(task.recorded.read(int(one.numbers[0]))) for one in submaps]
        count = sum(sizes) / len(sizes) * sum(len(one.own_numbers) for one in submaps)
        fraction = STATIONARY_DOTS / max(count, 1.0)
        tasks = _BuildTasks(replace(task, drawn_share=fraction), submaps, moving, self.work)
        parts = []
        for number, part in enumerate(self.work.each(_BUILD, run, build_submap, tasks), 1):
            self.report(f"built {number} of {plural(len(submaps), 'submap')}")
            surfels, _, *others = part
            parts.append(_BuiltSubmap(surfels, *others))
        return _Built(parts, submaps)

    def _load_observations(self, index: int) -> Observations:
        observations: Observations = self.work.load(_BUILD, index, 1)
        return observations

    def _assemble(
        self,
        built: _Built,
        sweeps: AlignedSweeps,
        poses: RecordedPoses,
        moving: MovingObjects | None,
    ) -> Twin:
        """Fit the sensor's response and noise, and assemble the twin."""
        recorded = self.recorded
        alignment = sweeps.alignment
        self.report("fitting the sensor model")
        some = even_indices(len(built.parts), _RESPONSE_SUBMAPS).tolist()
        response = fit_response(
            [self._load_observations(index) for index in some],
            recorded.ring_count,
            are_energies=recorded.recording.info.energies,
        )
        name = Path(recorded.recording.info.name).name
        # All points of a submap may belong to its neighbors.
        meshes = {
            index: part.surfels.mesh(name)
            for index, part in enumerate(built.parts)
            if len(part.surfels.corners)
        }
        timing = SweepTiming.from_sweeps(sweeps)
        model, noise, notes = self._fit_sensor(built, sweeps, meshes, response, timing)
        start, stop = timing.start(alignment), timing.stop(alignment)
        actors = self._actors(moving, response, alignment.sweep_s, (start.time_s, stop.time_s))
        figures = self._figures(built, alignment) | {
            "poses": poses.source,
            "motion": alignment.motion.value,
            "actors_from": self.actors,
            "actors": [actor.figures() for actor in actors],
            "held_out": built.held_out().figures(),
            "weather": self._weather(built, model),
            "lidar4d": HeldOutFrames.figures(
                [part.frames for part in built.parts if part.frames is not None]
            ),
            "response": None if response is None else response.figures(),
            "range_noise": None if noise is None else noise.figures(),
            "model": model.name,
            "notes": [
                *recorded.recording.notes,
                *recorded.notes,
                *notes,
                *_stationary_notes(alignment),
            ],
        }
        from .charts import draw_errors, draw_sweep, draw_top_view  # imports Matplotlib

        pictures = {
            "sweep": draw_sweep(built.images()),
            "above": draw_top_view(
                [part.top_view for part in built.parts], alignment.poses[:, :3, 3]
            ),
            "errors": draw_errors(figures),
        }
        return Twin(
            scene=self._scene(built, meshes, response),
            poses=alignment.poses,
            times_s=poses.times_s,
            start=start,
            stop=stop,
            origin=poses.origin,
            model=model,
            figures=figures,
            pictures=pictures,
            actors=actors,
            classes=recorded.recording.classes,
        )

    def _scene(
        self, built: _Built, meshes: Mapping[int, SceneMesh], response: Response | None
    ) -> Scene:
        """Return the scene, given the surfels of each submap that return pulses.

        If there are intensities, the colors of the surfels are their reflectances.
        """
        spreads = np.zeros(sum(len(mesh.faces) for mesh in meshes.values()) // 2)
        if response is not None:
            reflectances = {
                index: response.reflectances(self._load_observations(index), surfel_centers(mesh))
                for index, mesh in meshes.items()
            }
            spreads = np.concatenate([one.spreads for one in reflectances.values()])
            meshes = {
                index: color_by_reflectance(mesh, reflectances[index])
                for index, mesh in meshes.items()
            }
        surfels = merge_surfels([*meshes.values()])
        return Scene.from_meshes(
            [*split_by_object(surfels, built.porosity(), spreads), *built.dark()]
        )

    def _actors(
        self,
        moving: MovingObjects | None,
        response: Response | None,
        sweep_s: float,
        span_s: tuple[float, float],
    ) -> list[RecordedActor]:
        """Return the moving objects as actors, whose colors are their reflectances."""
        if moving is None:
            return []
        meshes = []
        for one in moving.of_all.objects:
            reflectances = None
            if response is not None:
                reflectances = response.reflectances(one.observations, one.surfels.centers)
            meshes.append(color_by_reflectance(one.surfels.mesh, reflectances))
        names = self.recorded.recording.classes
        return actors_of(moving.of_all.objects, meshes, names, span_s, sweep_s)

    def _fit_sensor(
        self,
        built: _Built,
        sweeps: AlignedSweeps,
        meshes: Mapping[int, SceneMesh],
        response: Response | None,
        timing: SweepTiming,
    ) -> FittedSensor:
        """Fit the sensor's noise to the middle of the drive."""
        middle = len(built.parts) // 2
        numbers = built.submaps[middle].own_numbers
        sizes = built.parts[middle].surfels.points
        near = [mesh for index, mesh in meshes.items() if abs(index - middle) <= 1]
        sensor = self.base or timing.sensor(sweeps, int(numbers[sizes.argmax()]), response)
        fitted = fit_sensor(
            sweeps,
            dict(zip(numbers.tolist(), sizes.tolist(), strict=True)),
            Scene.from_meshes([merge_surfels(near)]),
            response,
            sensor,
        )
        elevation_deg = np.degrees(self.recorded.elevation_rad)
        if self.base is not None and not self.base.matches_rings(elevation_deg):
            fitted.notes.append(
                f"the recorded rings do not match the rings of {self.base.name}. Check `--model`"
            )
        if self.base is None and timing.rotation is None:
            fitted.notes.append(
                "the direction of rotation of the sensor is unknown, so sensor.yaml assumes a "
                "counterclockwise rotation. Set clockwise and zero_deg in this file"
            )
        return fitted

    def _weather(self, built: _Built, model: SensorModel) -> dict[str, Any] | None:
        """Return statistics of the weather, or None if there are no returns from the air."""
        found = built.air_returns()
        if found is None:
            return None
        some = even_indices(len(built.parts), _RESPONSE_SUBMAPS).tolist()
        observations = [self._load_observations(index) for index in some]
        wavelength_nm = model.optics.simulated_nm
        return found | {"visibility_m": estimate_visibility(observations, wavelength_nm)}

    def _figures(self, built: _Built, alignment: Alignment) -> dict[str, Any]:
        """Return statistics of the reconstruction and the drive."""
        path = alignment.poses[:, :3, 3]
        surfels = [part.surfels for part in built.parts]
        vehicle = self.recorded.vehicle
        return {
            "versions": {"lidarpool": __version__},
            "name": Path(self.recorded.recording.info.name).name,
            "sweeps": self.recorded.count,
            "used_sweeps": sum(len(one.points) for one in surfels),
            "submaps": len(surfels),
            "rings": len(self.recorded.elevation_rad),
            "points": sum(int(one.points.sum()) for one in surfels),
            "vehicle_share": vehicle.share if vehicle is not None else 0.0,
            "moved": sum(int(one.moved.sum()) for one in surfels),
            "surfels": sum(len(one.corners) for one in surfels),
            "dark_surfels": sum(len(one.dark_corners) for one in surfels),
            "voxel_m": self.voxel_m,
            "lidar4d_window": self.recorded.window,
            "length_m": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
            "thickness_m": list(alignment.thickness_m),
            "plane_distance_m": _median(alignment.plane_distance_m),
            "ring_offset_m": float(np.std(alignment.ring_offsets[:, 0])),
            "ring_offset_deg": float(np.degrees(np.std(alignment.ring_offsets[:, 1]))),
        }


def _beam_rad(model: SensorModel | None) -> float:
    """Return the mean divergence of a model's beams in radians.

    It is 0 if it is unknown, because a twin is then simulated with thin rays.
    """
    if model is None or model.optics.divergence_mrad is None:
        return 0.0
    return 1e-3 * float(np.mean(model.optics.divergence_mrad))


def _held_out_split(recorded: RecordedSweeps, counting: Ints) -> tuple[Ints, Ints]:
    """Return the numbers of the sweeps from which the map is built, and of those to compare.

    `counting` are the numbers of the sweeps that are used, in ascending order.
    """
    window = recorded.window
    if window is None:
        others = counting[1::2]
        return counting[::2], others[even_indices(len(others), _COMPARED_SWEEPS)]
    held_out = np.array(WINDOWS[window].held_out) - window
    return np.setdiff1d(counting, held_out), np.intersect1d(counting, held_out)


class _BuiltSubmap(NamedTuple):
    """Results of building a submap that are kept in memory."""

    surfels: SubmapSurfels
    held_out: HeldOutRays | None
    frames: HeldOutFrames | None
    images: SweepImages | None
    top_view: TopViewPoints
    air: AirStatistics


@dataclass(frozen=True, eq=False)
class _Built:
    parts: Sequence[_BuiltSubmap]
    submaps: Sequence[Submap]

    def held_out(self) -> HeldOutRays:
        return HeldOutRays.concatenate(
            [part.held_out for part in self.parts if part.held_out is not None]
        )

    def air_returns(self) -> dict[str, Any] | None:
        """Return statistics of the returns from the air, or None if there are none."""
        parts = [part.air for part in self.parts if part.air.returns]
        count = sum(int(part.returns) for part in parts)
        if not count:
            return None
        total = count + sum(int(part.surfels.points.sum()) for part in self.parts)
        ranges_m = np.concatenate([part.ranges_m for part in parts])
        return {
            "returns": count,
            "share": count / total,
            "median_range_m": float(np.median(ranges_m)),
            "p95_range_m": float(np.quantile(ranges_m, 0.95)),
        }

    def dark(self) -> list[SceneMesh]:
        """Return the mesh of all surfels that return no pulses.

        The list is empty if there are no such surfels.
        """
        corners = np.concatenate([part.surfels.dark_corners for part in self.parts])
        return [surfel_mesh(NO_RETURN, corners)] if len(corners) else []

    def porosity(self) -> Porosity:
        """Return the gaps of all surfels that return pulses."""
        parts = [part.surfels.porosity for part in self.parts]
        return Porosity(*map(np.concatenate, zip(*parts, strict=True)))

    def images(self) -> SweepImages:
        """Return the images of a held-out sweep from the middle of the drive.

        Raise LidarError if there is none.
        """
        images = [part.images for part in self.parts if part.images is not None]
        if not images:
            raise LidarError(
                "The sweeps that were held out for the comparison contain no points. Use a "
                "complete recording."
            )
        return images[len(images) // 2]


@dataclass(frozen=True, eq=False)
class _BuildTasks(Sequence[BuildTask]):
    """Tasks of building the submaps, which are created when they are needed to save memory."""

    task: BuildTask
    submaps: Sequence[Submap]
    moving: MovingObjects | None
    work: Work

    def __len__(self) -> int:
        return len(self.submaps)

    def __getitem__(self, index: Any) -> Any:
        submap = self.submaps[index]
        objects = None
        if self.moving is not None:
            masks = (self.work.load(_MOTION, index, number) for number in range(3))
            times_s = self.task.alignment.times_s[submap.numbers]
            objects = self.moving.between(float(times_s[0]), float(times_s[-1]), *masks)
        return replace(self.task, submap=submap, objects=objects)


def _stationary_notes(alignment: Alignment) -> list[str]:
    """Return a note if the sensor was stationary during the recording."""
    if np.ptp(alignment.poses[:, :3, 3], axis=0).max() > _MIN_DRIVE_M:
        return []
    return [
        (
            "the sensor was stationary, so the reconstruction contains only surfaces that are "
            "visible from its position, with holes behind objects"
        )
    ]


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def color_by_reflectance(mesh: SceneMesh, reflectances: Reflectances | None) -> SceneMesh:
    """Color the surfels of a mesh according to their reflectances."""
    if reflectances is None:
        return mesh
    light = reflectances.surfels[:, None].repeat(3, axis=1)
    return replace(mesh, colors=Colors.from_face_colors(as_srgb(light).repeat(2, axis=0)))
