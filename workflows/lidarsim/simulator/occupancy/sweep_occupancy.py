"""Occupancy of a voxel grid at the start of each sweep, observed by the rays of the sweep."""

from __future__ import annotations

import numpy as np

from ...numerics.arrays import Bytes, to_writable
from ...numerics.vectors import rotate
from ...scene.scene import Scene
from ...survey.survey import Survey
from ...survey.sweep_poses import platform_pose, sensor_pose
from ..rig import CentralRays, Rig
from .grid import FREE, GridFrame, Occupancy, VoxelGrid
from .marks import HIT
from .scene_voxels import GridPose, SceneVoxels


class OccupancySimulator:
    """Computes the occupancy of a voxel grid for the sweeps of a sensor.

    A voxel is occupied if a surface intersects it, or if its center is inside a closed surface. If
    several surfaces intersect a voxel, the one that is closest to its center determines its class
    and its instance. Actors are placed at their poses at the start of the sweep. A voxel is
    observed if the central ray of a pulse of the sweep passes through it, or ends in it, between
    the minimum range of the sensor and the first surface or, if there is none, the maximum range.

    Parameters
    ----------
    scene, survey
        As for `simulate`.
    grid
        Extent and voxel size.
    sensor
        Number of the sensor.
    frame
        Whether the grid is in the frame of the platform or of the sensor.
    backend, threads
        As for `RayCaster`.

    Examples
    --------
    >>> from lidarpool import Scene, Survey, load_sensor
    >>> survey = Survey(load_sensor("velodyne/vlp16"), poses=[(0, 0, 1)])
    >>> grid = VoxelGrid((-2, -2, -1), (2, 2, 1), 0.5)
    >>> OccupancySimulator(Scene.seed(), survey, grid).sweep(0).classes.shape
    (8, 8, 4)
    """

    def __init__(
        self,
        scene: Scene,
        survey: Survey,
        grid: VoxelGrid,
        sensor: int = 0,
        frame: GridFrame = "sensor",
        backend: str = "auto",
        threads: int | None = None,
    ) -> None:
        self.grid = grid
        self._survey = survey
        self._sensor = sensor
        self._frame = frame
        self._rig = Rig(scene, survey, backend, threads)
        self._voxels = SceneVoxels(scene, self._rig.scene_casters[sensor].unseen)

    def sweep(self, number: int, following: int = 0) -> Occupancy:
        """Return the occupancy at the start of a sweep.

        Parameters
        ----------
        number
            Number of the sweep among the sweeps of the sensor, counted from 0.
        following
            Number of following sweeps whose rays count in `Occupancy.observed_later`.
        """
        pose = self._grid_pose(number)
        start_ns = float(self._survey.sweeps_each[self._sensor].starts_ns[number])
        triangle = self._voxels.triangles(self.grid, pose, start_ns)
        occupied = triangle >= 0
        surfaces = self._rig.surfaces
        classes = np.zeros(self.grid.shape, np.int32)
        classes[occupied] = surfaces.materials.semantic_class[surfaces.kinds(triangle[occupied])]
        instances = np.full(self.grid.shape, FREE, np.int32)
        instances[occupied] = surfaces.triangles.objects(triangle[occupied])
        marks = self._ray_marks(number, pose)
        later = marks > 0
        last = min(number + following, len(self._survey.sweeps_each[self._sensor].firsts) - 1)
        for other in range(number + 1, last + 1):
            later |= self._ray_marks(other, pose) > 0
        return Occupancy(classes, instances, marks > 0, marks >= HIT, later)

    def _ray_marks(self, number: int, pose: GridPose) -> Bytes:
        """Return the bits `TRAVERSED` and `HIT` of each voxel for all rays of a sweep."""
        marks = np.zeros(self.grid.shape, np.uint8)
        first = self._survey.sweeps_each[self._sensor].firsts[number]
        stops = self._survey.sweep_stops
        stop = stops[np.searchsorted(stops, first, "right")]
        for rays in self._rig.central_rays(int(first), int(stop)):
            self._mark(rays, pose, marks)
        return marks

    def _mark(self, rays: CentralRays, pose: GridPose, marks: Bytes) -> None:
        from . import voxel_loops as loops  # imported here because numba is slow to import

        sensor = self._survey.mounted_sensors[self._sensor].sensor
        origins = rotate(rays.origins.T - pose.position, pose.rotation.T)
        directions = rotate(rays.directions.T, pose.rotation.T) / self.grid.voxel_m
        hits = np.isfinite(rays.ranges)
        loops.add_rays(
            to_writable(self.grid.to_voxels(origins).T),
            to_writable(directions.T),
            float(sensor.min_range_m),
            np.where(hits, rays.ranges, sensor.max_range_m),
            hits,
            marks,
        )

    def _grid_pose(self, number: int) -> GridPose:
        """Return the pose of the platform or of the sensor at the start of a sweep."""
        find = platform_pose if self._frame == "platform" else sensor_pose
        return GridPose(*find(self._survey, self._sensor, number))
