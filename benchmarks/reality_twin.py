"""Reconstruct one half of a recording, and simulate sweeps of the other half pulse by pulse."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarpool import Material, Pose, Returns, Scanner, Scene, Sensor, Track, load_sensor
from lidarreal.reconstruction.alignment import AlignedSweeps, first_alignment
from lidarreal.reconstruction.building import DEFAULT_VOXEL_M, color_by_reflectance
from lidarreal.reconstruction.free_space import find_stationary_points
from lidarreal.reconstruction.labels import SurfelMaterial, split_by_object
from lidarreal.reconstruction.lost_pulses import SensorCoverage
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.recorded_sensor import SweepTiming, fit_sensor
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.reconstruction.reflectances import IntensityModel
from lidarreal.reconstruction.submap_tasks import (
    BuildTask,
    SubmapSurfels,
    align_submap,
    build_map_with_reflectances,
)
from lidarreal.reconstruction.submaps import merge_alignments, split_into_submaps
from lidarreal.reconstruction.surfels import surfel_mesh
from lidarreal.reconstruction.twin import NO_RETURN
from lidarreal.reconstruction.vehicle_detection import find_poses_and_vehicle
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import Trajectory
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.sensor.models import SensorModel

MAX_SWEEPS = 80  # A submap of this size is reconstructed at once.
_HELD_OUT = 12  # held-out sweeps that are simulated
_FINER = 4  # simulated azimuth steps per recorded step, so that the directions of pulses agree
_SUBRAYS = 19
_DIVERGENCE_MRAD = 3.4  # of an HDL-64E


class Effects(NamedTuple):
    """Modeled effects that a simulation includes. The defaults are those of a run."""

    beam_width: bool = False
    range_noise: bool = True
    reflectances: bool = True
    reflectance_spread: bool = True
    gaps: bool = True
    motion: bool = True


class PairedPulses(NamedTuple):
    """Recorded pulses of a sweep, and the simulated pulses in the same directions.

    The k pulses that returned in the recording are first, in the order of the returns.
    """

    number: int  # of the sweep
    range_m: Floats  # (n,), recorded range, NaN for a lost pulse
    intensity: Floats  # (n,), recorded, NaN if unknown
    stationary: Bools  # (n,), whether the recorded return is from a stationary surface
    simulated_m: Floats  # (n,), NaN for a pulse without a return
    simulated_intensity: Floats  # (n,)
    simulated_points: Floats  # (n, 3), in the sensor frame at the time of the pulse


@dataclass(frozen=True, eq=False)
class HalfTwin:
    """Scene and sensor that were reconstructed from every second sweep of a recording.

    The sensor, the materials and the trajectory are those that a twin writes.
    """

    sweeps: AlignedSweeps
    held_out: Ints  # numbers of the sweeps to simulate
    stationary: Mapping[int, Bools]  # masks of their stationary returns
    scene: Scene
    model: SensorModel
    timing: SweepTiming
    intensity_column: str  # simulated column that corresponds to the recorded intensities

    @classmethod
    def from_recording(cls, recording: Recording) -> HalfTwin:
        """Reconstruct the sweeps with even numbers, without moving objects."""
        poses, recorded = find_poses_and_vehicle(RecordedSweeps.from_recording(recording), None)
        first = first_alignment(recorded, poses)
        mapped = np.arange(0, recorded.count, 2)
        others = np.arange(1, recorded.count, 2)
        held_out = others[even_indices(len(others), _HELD_OUT)]
        (submap,) = split_into_submaps(first.poses[:, :3, 3])
        coverage = SensorCoverage.from_sweeps(recorded)
        coverage = AlignedSweeps(recorded, first, coverage).find_coverage(mapped)
        task = BuildTask(
            recorded, first, submap, mapped, coverage, held_out, DEFAULT_VOXEL_M, drawn_share=0.0
        )
        alignment = merge_alignments(first, [submap], align_submap(task))
        sweeps, _ = replace(task, alignment=alignment).read_without_air()
        all_stationary = find_stationary_points(sweeps, submap.numbers.tolist())
        return cls._from_aligned(
            sweeps, mapped, {number: all_stationary[number] for number in held_out.tolist()}
        )

    @classmethod
    def _from_aligned(
        cls, sweeps: AlignedSweeps, mapped: Ints, stationary: Mapping[int, Bools]
    ) -> HalfTwin:
        """Reconstruct the scene and the sensor from the sweeps in `mapped`."""
        in_mapped = find_stationary_points(sweeps, mapped.tolist())
        surface_map, reflectances = build_map_with_reflectances(sweeps, in_mapped, DEFAULT_VOXEL_M)
        is_dark = surface_map.surfels.dark
        surfels = SubmapSurfels.from_surfels(
            surface_map, np.ones(len(is_dark), bool), in_mapped, mapped
        )
        mesh = surfels.mesh("scene")
        response = None
        spreads = np.zeros(len(surfels.corners))
        if reflectances is not None:
            response = reflectances.response
            spreads = reflectances.spreads[~is_dark]
            mesh = color_by_reflectance(
                mesh, replace(reflectances, surfels=reflectances.surfels[~is_dark], spreads=spreads)
            )
        dark = [surfel_mesh(NO_RETURN, surfels.dark_corners)] if is_dark.any() else []
        timing = SweepTiming.from_sweeps(sweeps)
        sensor = timing.sensor(sweeps, int(mapped[surfels.points.argmax()]), response)
        sizes = dict(zip(mapped.tolist(), surfels.points.tolist(), strict=True))
        fitted = fit_sensor(sweeps, sizes, Scene.from_meshes([mesh]), response, sensor)
        is_compensated = response is None or response.model is IntensityModel.COMPENSATED
        return cls(
            sweeps=sweeps,
            held_out=np.array([*stationary]),
            stationary=stationary,
            scene=Scene.from_meshes([*split_by_object(mesh, surfels.porosity, spreads), *dark]),
            model=fitted.model,
            timing=timing,
            intensity_column="reflectance" if is_compensated else "intensity",
        )

    @property
    def is_as_fired(self) -> bool:
        """Whether the recorded points are not compensated for motion."""
        return self.sweeps.alignment.motion is not Motion.COMPENSATED

    def effective(self, effects: Effects) -> Effects:
        """Return the effects without those that the recording does not have."""
        has_reflectances = bool(self.scene.has_colors.any())
        return effects._replace(
            reflectances=effects.reflectances and has_reflectances,
            reflectance_spread=effects.reflectance_spread and has_reflectances,
            motion=effects.motion and self.is_as_fired,
        )

    def simulate(self, effects: Effects) -> Iterator[PairedPulses]:
        """Simulate the held-out sweeps."""
        sensor = self._sensor()
        scanner = Scanner(
            self.scene,
            sensor,
            columns=["ray", "range", self.intensity_column],
            coordinates="sensor",
            **self._settings(sensor, effects),
        )
        for number in self.held_out.tolist():
            path, start_s = self._path(number, moves=effects.motion)
            cloud = scanner.sweep(path, start_s=start_s)
            first_firings = [sensor.firings(step)[0] for step in sensor.steps_of_revolution(0)]
            firing = np.array(first_firings)[cloud["scan"]] + cloud["ray"] // sensor.channels
            image = np.full((sensor.channels, sensor.head.period, 5), np.nan)
            values = (cloud["range"], cloud[self.intensity_column], *cloud.positions.T)
            image[cloud["channel"], firing] = np.column_stack(values)
            yield self._paired(number, image)

    def _sensor(self) -> Sensor:
        """Load the sensor with a finer azimuth step."""
        assert self.model.firings_per_turn is not None
        with TemporaryDirectory() as folder:
            file = Path(folder, "sensor.yaml")
            file.write_text(self.model.model_dump_json(exclude_none=True))
            return load_sensor(file, columns=_FINER * self.model.firings_per_turn)

    def _settings(self, sensor: Sensor, effects: Effects) -> dict[str, Any]:
        """Return the arguments of a scanner with the given effects.

        Range errors of the rings are calibration errors, so they always remain.
        """
        settings: dict[str, Any] = {"materials": self._materials(effects)}
        if effects.beam_width:
            settings["returns"] = Returns(subrays=_SUBRAYS, divergence_mrad=_DIVERGENCE_MRAD)
        noise = sensor.noise
        if noise is not None:
            if not effects.range_noise:
                noise = replace(noise, range_m=0.0, range_per_m=0.0, angle_deg=0.0)
            settings["noise"] = noise
        return settings

    def _materials(self, effects: Effects) -> list[Material]:
        is_textured = effects.reflectances and bool(self.scene.has_colors.any())
        reflectance: Literal["texture"] | None = "texture" if is_textured else None
        materials = self.scene.materials
        names = set() if materials is None else {*chain.from_iterable(materials.names)}
        entries = []
        for name in sorted(names - {""}):
            surfels = SurfelMaterial.from_name(name)
            if not effects.gaps:
                surfels = surfels._replace(gap_fraction=0.0, range_spread_m=0.0)
            if not effects.reflectance_spread:
                surfels = surfels._replace(reflectance_spread=0.0)
            entries.append(surfels.entry() | {"material": name})
        return [
            Material(NO_RETURN, reflectance=0),
            *(Material(reflectance=reflectance, **entry) for entry in entries),
            Material("*", reflectance=reflectance),
        ]

    def _path(self, number: int, *, moves: bool) -> tuple[Pose | Trajectory, float | None]:
        """Return the trajectory of the sensor, and the time on it at which a sweep starts."""
        alignment = self.sweeps.alignment
        pose = alignment.poses[number]
        if not moves or not self.is_as_fired:
            return Pose.from_rotation(pose[:3, 3], pose[:3, :3]), None
        start, stop = self.timing.start(alignment), self.timing.stop(alignment)
        before = [start] if start.time_s < alignment.times_s[0] else []
        times_s = [*(one.time_s for one in before), *alignment.times_s, stop.time_s]
        poses = np.stack([*(one.pose for one in before), *alignment.poses, stop.pose])
        path = Track(np.array(times_s), poses[:, :3, 3], quaternions_of(poses[:, :3, :3]))
        return path, alignment.times_s[number] + self.timing.first_s - start.time_s

    def _paired(self, number: int, image: Floats) -> PairedPulses:
        """Pair the pulses of a recorded sweep with the simulated pulses of the same rings.

        `image` has the range, the intensity and the position of each simulated pulse.
        """
        lasers = self.sweeps.recorded.lasers
        returned = self.sweeps.recorded.read(number)
        lost, _ = self.sweeps.read_lost(number)
        points = np.concatenate([returned.points, lost.points])
        ring = np.concatenate([returned.columns["row"], lost.columns["row"]])
        azimuth, _ = lasers.angles(points, ring)
        turned = azimuth - np.radians(self.model.zero_deg)
        turned = -turned if self.model.clockwise else turned
        columns = image.shape[1]
        firing = np.rint(turned / (2 * np.pi) * columns).astype(np.int64) % columns
        simulated = image[len(lasers) - 1 - ring, firing]
        unknown = np.full(len(points), np.nan)
        range_m = unknown.copy()
        range_m[: len(returned)] = lasers.ranges(returned.points, returned.columns["row"])
        intensity = unknown.copy()
        if returned.intensity is not None:
            intensity[: len(returned)] = returned.intensity
        stationary = np.zeros(len(points), bool)
        stationary[: len(returned)] = self.stationary[number]
        return PairedPulses(
            number,
            range_m,
            intensity,
            stationary,
            simulated[:, 0],
            simulated[:, 1],
            simulated[:, 2:],
        )
