"""Evaluation of a sensor at a mounting position.

A sensor is evaluated independently of the other sensors of the vehicle, because sensors do not
occlude each other. Points on targets come from simulated sweeps, and the blind area is computed
from the same beams.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lidarsim.media.materials import Material, normal_incidence_energy
from lidarsim.motion.trajectory import CENTER
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints
from lidarsim.numerics.vectors import rotate
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sensor import Returns, Sensor
from lidarsim.simulator.scanner import Scanner
from lidarsim.survey.survey import Mounted
from raybeam import RayCaster

from .blind_loops import BeamSegments, CellGrid, lower_to_beams
from .placements import Placements, azimuths_in_view, pack_sweeps

VEHICLE = "vehicle"
GROUND = "ground"
# Rays start outside the vehicle, even if the sensor is mounted on its surface.
CONTACT_M = 1e-3
_ABOVE_GROUND_M = 1e-3  # lower heights require a return from the ground
_PARKED_M = -1000.0  # height of unused targets
_GROUND_MARGIN_M = 10.0
_BISECTIONS = 60
_FARTHEST_M = 1e5


class MountResult(NamedTuple):
    """Evaluation of a sensor at a mount.

    Attributes
    ----------
    points
        Number of points on each placement. Shape (p,).
    lowest_m
        Minimum height of an object that is visible to the sensor, for each cell of the map. Cells
        that no beam reaches are infinite, and cells whose ground returns light are 0. Shape (rows,
        columns), with the lowest y first.
    unobstructed_m
        As `lowest_m`, without the vehicle.
    beams
        Number of beams in a revolution.
    blocked
        Number of beams that the vehicle blocks.
    blocked_near
        Number of beams that the vehicle blocks within the minimum range of the sensor.
    blocked_share
        Share of beams that are blocked, by azimuth and elevation in the sensor frame, in cells of
        `SHARE_DEG`. Cells without beams are NaN. Shape (rows, columns).
    """

    points: Ints
    lowest_m: Floats32
    unobstructed_m: Floats32
    beams: int
    blocked: int
    blocked_near: int
    blocked_share: Floats32


SHARE_DEG = 2.0  # size of the cells of `MountResult.blocked_share`


@dataclass(frozen=True, eq=False)
class MountEvaluator:
    """Evaluator of sensors on a vehicle on level ground.

    Attributes
    ----------
    body
        Mesh of the vehicle in its own frame, with the ground at z = 0.
    placements
        Targets to detect.
    grid
        Cells of the blind-area map.
    max_height_m
        Maximum height of the map in meters.
    reflectance
        Reflectance of the ground, and of the objects on the map.
    returns
        Settings of returns for sensors without data sheet values.
    conditions
        Further arguments of `Scanner`: noise and weather.
    """

    body: SceneMesh
    placements: Placements
    grid: CellGrid
    max_height_m: float
    reflectance: float
    returns: Returns
    conditions: dict[str, Any]

    def __call__(self, mounted: Mounted) -> MountResult:
        """Evaluate a sensor at its mount.

        Examples
        --------
        >>> from lidarpool import Pose, load_sensor
        >>> from lidarscenario.mounting.study import MountStudy
        >>> from lidarscenario.mount_sections import VehicleFile
        >>> vehicle = VehicleFile.from_data({
        ...     "body": "saloon",
        ...     "sensors": {"top": {"model": "velodyne/vlp16", "mounts": [0, 0, 1.8]}},
        ...     "targets": ["car"],
        ...     "region": {"distances_m": [10], "bearings": 1, "headings_deg": [0]},
        ... })
        >>> study = MountStudy.from_file(vehicle)
        >>> result = study.evaluator(vehicle.mounted_sensor("top", Pose((0, 0, 1.8))))
        >>> int(result.points[0])
        284
        """
        seen = _with_contact(mounted)
        beams = _beams(seen)
        body = RayCaster(self.body.vertices, self.body.faces)
        blocked_m = body.cast(beams.origins, beams.directions, t_min=CONTACT_M).distance
        in_view = azimuths_in_view(beams.directions)
        points = self._points(mounted, seen, in_view)
        blocked = np.isfinite(blocked_m)
        lowest_m, unobstructed_m = self._lowest_heights(mounted, seen, beams, blocked_m)
        return MountResult(
            points,
            lowest_m,
            unobstructed_m,
            len(blocked),
            int(blocked.sum()),
            int((blocked_m < mounted.sensor.min_range_m).sum()),
            _blocked_share(seen.sensor, blocked),
        )

    def _scanner(self, seen: Mounted, meshes: Sequence[SceneMesh | SceneInstance]) -> Scanner:
        """Return a scanner in a scene with the vehicle, the ground and further objects."""
        names = {mesh.name.rpartition("-")[0] for mesh in meshes}
        materials = [
            Material(objects=f"{_slot_name(number)}-*", reflectance=target.reflectance)
            for number, target in enumerate(self.placements.targets)
            if any(name.startswith(f"{_slot_name(number)}-") for name in names)
        ]
        materials.append(Material(objects="*", reflectance=self.reflectance))
        scene = Scene.from_meshes([replace(self.body, name=VEHICLE), self._ground(), *meshes])
        return Scanner(
            scene,
            seen,
            columns=["range"],
            materials=materials,
            returns=self.returns,
            threads=1,
            **self.conditions,
        )

    def _ground(self) -> SceneMesh:
        """Return a rectangle below the vehicle, the map and all targets."""
        grid = self.grid
        reach = [abs(grid.x), abs(grid.y)]
        reach += [abs(grid.x + grid.columns * grid.cell_m), abs(grid.y + grid.rows * grid.cell_m)]
        if len(self.placements):
            reach.append(float(np.abs(self.placements.footprints()).max()))
        half = max(reach) + _GROUND_MARGIN_M
        corners = np.array([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)])
        return SceneMesh(GROUND, corners, np.array([[0, 1, 2], [0, 2, 3]]))

    def _points(self, mounted: Mounted, seen: Mounted, in_view: Bools) -> Ints:
        """Count the points on each placement."""
        placements = self.placements
        points = np.zeros(len(placements), np.int64)
        origin = np.array(mounted.mount.position)
        sweeps = [*pack_sweeps(placements, origin, seen.sensor, in_view)]
        if not sweeps:
            return points
        slots = _Slots.for_sweeps(placements, sweeps)
        scanner = self._scanner(seen, slots.instances(placements))
        first = 2  # the vehicle and the ground
        matrices = placements.matrices()
        for sweep in sweeps:
            taken = slots.of_sweep(placements.mesh[sweep])
            poses = np.tile(_parked(), (len(slots.names), 1, 1))
            poses[taken] = matrices[sweep]
            scanner.move(slots.names, poses)
            cloud = scanner.sweep(CENTER)
            kept = cloud["range"] >= mounted.sensor.min_range_m
            counts = np.bincount(cloud["object"][kept], minlength=first + len(slots.names))
            points[sweep] = counts[first + taken]
        return points

    def _lowest_heights(
        self, mounted: Mounted, seen: Mounted, beams: BeamSegments, blocked_m: Floats
    ) -> tuple[Floats32, Floats32]:
        """Compute the heights of the map from the beams, and from the returns of the ground.

        Return the heights with and without the vehicle.
        """
        scanner = self._scanner(seen, ())
        cloud = scanner.sweep(CENTER)
        on_ground = cloud["object"] == 1
        on_ground &= cloud["range"] >= mounted.sensor.min_range_m
        range_m = self._range_m(scanner)
        start_m = np.full(len(blocked_m), mounted.sensor.min_range_m)
        maps = []
        for stop_m in (np.minimum(blocked_m, range_m), np.full(len(blocked_m), range_m)):
            lowest = np.full((self.grid.rows, self.grid.columns), np.inf)
            segments = beams._replace(start_m=start_m, stop_m=stop_m)
            lower_to_beams(self.grid, segments, self.max_height_m, lowest)
            maps.append(np.maximum(lowest, _ABOVE_GROUND_M))
        columns, rows = self._cells(cloud.positions[on_ground])
        maps[0][rows, columns] = 0
        return maps[0].astype(np.float32), maps[1].astype(np.float32)

    def _cells(self, positions: Floats) -> tuple[Ints, Ints]:
        """Return the columns and rows of the cells that contain positions on the map."""
        grid = self.grid
        columns = np.floor((positions[:, 0] - grid.x) / grid.cell_m).astype(np.int64)
        rows = np.floor((positions[:, 1] - grid.y) / grid.cell_m).astype(np.int64)
        on_map = (columns >= 0) & (columns < grid.columns) & (rows >= 0) & (rows < grid.rows)
        return columns[on_map], rows[on_map]

    def _range_m(self, scanner: Scanner) -> float:
        """Return the maximum distance in meters at which the sensor detects an object on the map.

        At this distance, half of the pulses that hit a surface with `reflectance` at normal
        incidence return.
        """
        survey = scanner.survey
        sensor = survey.mounted_sensors[0].sensor
        threshold = survey.noise_each[0].threshold
        extinction = survey.extinction(sensor)
        near, far = 0.0, min(sensor.max_range_m, _FARTHEST_M)
        if self.reflectance * normal_incidence_energy(far, extinction) >= threshold:
            return far
        for _ in range(_BISECTIONS):
            middle = (near + far) / 2
            energy = self.reflectance * normal_incidence_energy(middle, extinction)
            near, far = (middle, far) if energy >= threshold else (near, middle)
        return near


class _Slots(NamedTuple):
    """Instances of the targets' meshes, which are reused in each sweep."""

    names: list[str]
    first: Ints  # (m,), index of the first slot of each mesh

    @classmethod
    def for_sweeps(cls, placements: Placements, sweeps: Sequence[Ints]) -> _Slots:
        """Return as many slots for each mesh as any sweep requires."""
        count = len(placements.meshes)
        most = np.max(
            [np.bincount(placements.mesh[sweep], minlength=count) for sweep in sweeps], axis=0
        )
        names = [
            f"{_slot_name(int(placements.mesh_target[mesh]))}-{mesh}-{slot}"
            for mesh in range(count)
            for slot in range(int(most[mesh]))
        ]
        return cls(names, np.cumsum(most) - most)

    def instances(self, placements: Placements) -> list[SceneInstance]:
        """Return an unused instance for each slot."""
        owners = np.searchsorted(self.first, np.arange(len(self.names)), "right") - 1
        return [
            SceneInstance(placements.meshes[mesh], _parked(), name)
            for mesh, name in zip(owners.tolist(), self.names, strict=True)
        ]

    def of_sweep(self, meshes: Ints) -> Ints:
        """Return distinct slots for placements with the given meshes. Shape (k,)."""
        taken = self.first.copy()
        slots = np.empty(len(meshes), np.int64)
        for row, mesh in enumerate(meshes.tolist()):
            slots[row] = taken[mesh]
            taken[mesh] += 1
        return slots


def _slot_name(target: int) -> str:
    return f"target-{target}"


def _parked() -> Floats:
    matrix = np.eye(4)
    matrix[2, 3] = _PARKED_M
    return matrix


def _with_contact(mounted: Mounted) -> Mounted:
    """Reduce the minimum range of a sensor, so that the vehicle also blocks beams within it.

    The simulation ignores surfaces that are closer than the minimum range.
    """
    sensor = replace(mounted.sensor, min_range_m=CONTACT_M)
    return replace(mounted, sensor=sensor)


def _beams(mounted: Mounted) -> BeamSegments:
    """Return all beams of the first revolution in the vehicle frame. The segments are empty."""
    sensor, mount = mounted.sensor, mounted.mount
    firings = np.array(sensor.firings_of_revolution(0))
    directions = rotate(sensor.directions(firings).reshape(-1, 3), mount.rotation)
    origins = sensor.origins(firings)
    offsets = np.zeros_like(directions)
    if origins is not None:
        offsets = rotate(origins.reshape(-1, 3), mount.rotation)
    nothing = np.zeros(len(directions))
    return BeamSegments(
        np.ascontiguousarray(offsets + mount.position),
        np.ascontiguousarray(directions),
        nothing,
        nothing,
    )


def _blocked_share(sensor: Sensor, blocked: Bools) -> Floats32:
    """Return the share of blocked beams by azimuth and elevation in the sensor frame."""
    firings = np.array(sensor.firings_of_revolution(0))
    x, y, z = sensor.directions(firings).reshape(-1, 3).T
    columns, rows = round(360 / SHARE_DEG), round(180 / SHARE_DEG)
    column = ((np.degrees(np.arctan2(y, x)) + 180) / SHARE_DEG).astype(int) % columns
    elevation = np.degrees(np.arcsin(np.clip(z, -1, 1))) + 90
    row = np.minimum((elevation / SHARE_DEG).astype(int), rows - 1)
    cell = row * columns + column
    counts = np.bincount(cell, minlength=rows * columns)
    hidden = np.bincount(cell, blocked, minlength=rows * columns)
    with np.errstate(invalid="ignore"):
        share: Floats = hidden / counts
    return share.reshape(rows, columns).astype(np.float32)
