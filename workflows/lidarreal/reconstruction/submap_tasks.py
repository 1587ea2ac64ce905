"""Tasks of worker processes that align the sweeps of a submap or build its surface map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarfiles.work.mapping import describe_sweeps
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints, Ints32
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.scene_mesh import SceneMesh

from .air_returns import AirStatistics, find_air_returns
from .alignment import AlignedSweeps, Alignment, align
from .chart_data import SweepImages, TopViewPoints
from .free_space import find_stationary_points
from .held_out import HeldOutRays, simulate_held_out
from .lost_pulses import SensorCoverage
from .moving_objects import LabeledTracks
from .moving_rays import MovingRays, SweepMasks, collect_moving_rays
from .porosity import Porosity
from .published_metrics import HeldOutFrames
from .recorded_sweeps import RecordedSweeps
from .reflectances import Reflectances, fit_response
from .submap_objects import SubmapObjects
from .submaps import AlignedSubmap, Submap
from .surface_map import Observations, SurfaceMap, build_surface_map
from .surfels import surfel_mesh


@dataclass(frozen=True, eq=False)
class SubmapTask:
    """Task of aligning the sweeps of a submap.

    Attributes
    ----------
    recorded
        All sweeps.
    alignment
        Alignment of all sweeps.
    submap
        Sweeps of the submap and its surroundings.
    mapped
        Numbers of all sweeps whose points form the map, in ascending order. int64 array.
    """

    recorded: RecordedSweeps
    alignment: Alignment
    submap: Submap
    mapped: Ints

    @property
    def label(self) -> str:
        """Sweeps of the submap, for messages."""
        return describe_sweeps(int(self.submap.numbers[0]), int(self.submap.numbers[-1]))


@dataclass(frozen=True, eq=False)
class BuildTask(SubmapTask):
    """Task of building the surface map of a submap.

    Attributes
    ----------
    coverage
        Directions in which the sensor can have returns.
    compared
        Numbers of all held-out sweeps that are compared, in ascending order. int64 array.
    voxel_m
        Edge length in meters of the voxels from which surfels are created.
    drawn_share
        Share of the points that are drawn in the top view.
    objects
        Moving objects near the submap, or None if they are not reconstructed.
    beam_rad
        Divergence in radians of the beams with which the final scene is simulated, 0 for thin rays.
    """

    coverage: SensorCoverage
    compared: Ints
    voxel_m: float
    drawn_share: float
    objects: SubmapObjects | None = None
    beam_rad: float = 0.0

    def read(self) -> AlignedSweeps:
        """Read the sweeps of the submap and its surroundings into memory."""
        recorded = self.recorded.with_cached(self.submap.numbers.tolist())
        return AlignedSweeps(recorded, self.alignment, self.coverage)

    def read_without_air(self) -> tuple[AlignedSweeps, Mapping[int, Bools]]:
        """Read the sweeps without the returns from the air, and return the masks of these."""
        sweeps = self.read()
        if self.objects is not None:
            air = self.objects.air.masks()
        else:
            air = find_air_returns(sweeps, self.submap.numbers.tolist())
        return replace(sweeps, recorded=sweeps.recorded.without_air(air)).with_cache(), air


@dataclass(frozen=True, eq=False)
class MotionTask(BuildTask):
    """Task of finding the points on moving objects in a submap.

    Attributes
    ----------
    labels
        Labeled boxes of moving objects, or None if the objects are to be found.
    """

    labels: LabeledTracks | None = None


class SubmapSurfels(NamedTuple):
    """Surfels of a submap, and point counts of the sweeps that belong to it."""

    corners: Floats  # (m, 4, 3), meters
    dark_corners: Floats  # (d, 4, 3), meters, of surfels that return no pulses
    materials: AnyArray | None  # names
    material: Ints32 | None  # (m,), indices of `materials`
    gap_fraction: Floats  # (m,)
    range_spread_m: Floats  # (m,), meters
    points: Ints  # (k,), points in each of its own sweeps
    moved: Ints  # (k,), how many of them are on moving objects

    @classmethod
    def from_surfels(
        cls,
        surface_map: SurfaceMap,
        chosen: Bools,
        stationary: Mapping[int, Bools],
        own: Ints,
    ) -> SubmapSurfels:
        """Extract the selected surfels, and count the points of the sweeps in `own`."""
        surfels = surface_map.surfels
        corners = surfels.mesh.vertices.reshape(-1, 4, 3)
        lit = chosen & ~surfels.dark
        materials = surfels.mesh.materials
        index = None if materials is None else materials.index
        masks = [stationary[number] for number in own.tolist()]
        return cls(
            corners[lit],
            corners[chosen & surfels.dark],
            None if materials is None else np.array(materials.names),
            None if index is None else index[::2][lit],
            *surface_map.porosity.select(lit),
            np.array([len(mask) for mask in masks]),
            np.array([int((~mask).sum()) for mask in masks]),
        )

    @property
    def porosity(self) -> Porosity:
        """Gaps of those surfels that return pulses."""
        return Porosity(self.gap_fraction, self.range_spread_m)

    def mesh(self, name: str) -> SceneMesh:
        """Return a mesh of those surfels that return pulses."""
        materials = None
        if self.materials is not None:
            index = None if self.material is None else self.material.repeat(2)
            materials = FaceMaterials(tuple(self.materials.tolist()), index)
        return replace(surfel_mesh(name, self.corners), materials=materials)


BuiltSubmap = tuple[
    SubmapSurfels,
    Observations,
    HeldOutRays | None,
    HeldOutFrames | None,
    SweepImages | None,
    TopViewPoints,
    AirStatistics,
]


def align_submap(task: SubmapTask) -> tuple[AlignedSubmap]:
    """Align the sweeps of a submap.

    Raises
    ------
    LidarError
        If the sweeps contain hardly any planes.
    """
    aligned = align(task.recorded, task.alignment, task.submap.numbers, set(task.mapped.tolist()))
    return (AlignedSubmap.from_alignment(aligned),)


def find_moving_rays(
    task: MotionTask,
) -> tuple[SweepMasks, SweepMasks, SweepMasks, MovingRays, MovingRays]:
    """Find the points on moving objects in a submap, and collect the rays near these objects.

    Returns the masks of the returns from the air, of the stationary points of all sweeps, and of
    those that follow from the sweeps that form the map alone. The rays are those of the submap's
    own sweeps, in the same order.
    """
    sweeps, air = task.read_without_air()
    numbers = task.submap.numbers
    own = task.submap.own_numbers
    labels = task.labels or LabeledTracks((), ())
    masks = []
    rays = []
    for chosen, labeled in (
        (numbers, labels.all),
        (np.intersect1d(numbers, task.mapped), labels.in_mapped),
    ):
        stationary = find_stationary_points(sweeps, chosen.tolist())
        masks.append(SweepMasks.from_masks(stationary))
        collected = np.intersect1d(chosen, own).tolist()
        rays.append(collect_moving_rays(sweeps, stationary, collected, labeled))
    return SweepMasks.from_masks(air), masks[0], masks[1], rays[0], rays[1]


def build_submap(task: BuildTask) -> BuiltSubmap:
    """Build the surface map of a submap, and compare the held-out sweeps with a simulation.

    Raises
    ------
    LidarError
        If there are too few stationary points.
    """
    submap = task.submap
    sweeps, air = task.read_without_air()
    if task.objects is None:
        stationary = find_stationary_points(sweeps, submap.numbers.tolist())
    else:
        stationary = task.objects.stationary(sweeps)
    held_out, frames, images = compare_held_out_sweeps(sweeps, task, stationary)
    surface_map = build_surface_map(sweeps, stationary, task.voxel_m, task.beam_rad)
    own = submap.owns(surface_map.surfels.centers, task.alignment.poses)
    observations = surface_map.observations(sweeps, stationary).select_surfels(
        own & ~surface_map.surfels.dark
    )
    surfels = SubmapSurfels.from_surfels(surface_map, own, stationary, submap.own_numbers)
    top_view = TopViewPoints.from_sweeps(sweeps, stationary, submap.own_numbers, task.drawn_share)
    statistics = AirStatistics.from_sweeps(sweeps, air, submap.own_numbers)
    return surfels, observations, held_out, frames, images, top_view, statistics


def compare_held_out_sweeps(
    sweeps: AlignedSweeps, task: BuildTask, stationary: Mapping[int, Bools]
) -> tuple[HeldOutRays | None, HeldOutFrames | None, SweepImages | None]:
    """Compare the held-out sweeps of a submap with a map of the other sweeps.

    Parameters
    ----------
    sweeps
        Aligned sweeps.
    task
        The submap.
    stationary
        Masks of the stationary points, by sweep number.

    Returns
    -------
    tuple
        The rays and the metrics of the held-out sweeps, or None if the submap has none, and images
        of one of them, or None if none has points.

    Raises
    ------
    LidarError
        If there are too few stationary points.
    """
    submap = task.submap
    compared = np.intersect1d(task.compared, submap.own_numbers).tolist()
    if not compared:
        return None, None, None
    mapped = np.intersect1d(submap.numbers, task.mapped).tolist()
    objects = task.objects
    if objects is None:
        mapped_stationary = find_stationary_points(sweeps, mapped)
    else:
        mapped_stationary = objects.stationary_in_mapped(sweeps)
    surface_map, reflectances = build_map_with_reflectances(sweeps, mapped_stationary, task.voxel_m)
    rays, pulses = simulate_held_out(sweeps, surface_map, reflectances, stationary, compared)
    if objects is not None:
        response = None if reflectances is None else reflectances.response
        rays = objects.simulate(sweeps, rays, pulses, response)
    frames = HeldOutFrames.from_rays(sweeps, rays, pulses)
    with_points = np.unique(rays.sweep[rays.return_mask])
    if not len(with_points):
        return rays, frames, None
    drawn = int(with_points[len(with_points) // 2])
    return rays, frames, SweepImages.from_rays(sweeps, rays, drawn)


def build_map_with_reflectances(
    sweeps: AlignedSweeps, stationary: Mapping[int, Bools], voxel_m: float
) -> tuple[SurfaceMap, Reflectances | None]:
    """Build a surface map from the stationary points of sweeps, and estimate its reflectances.

    The reflectances are None if there are no intensities.

    Raises
    ------
    LidarError
        If there are too few stationary points.
    """
    surface_map = build_surface_map(sweeps, stationary, voxel_m)
    observations = surface_map.observations(sweeps, stationary)
    response = fit_response(
        [observations],
        sweeps.recorded.ring_count,
        are_energies=sweeps.recorded.recording.info.energies,
    )
    if response is None:
        return surface_map, None
    return surface_map, response.reflectances(observations, surface_map.surfels.centers)
