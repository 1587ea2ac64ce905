"""What processes do with the submaps of a drive: they align the sweeps, and rebuild the surface_map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints, Ints32
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.scene_mesh import SceneMesh

from .alignment import AlignedSweeps, Alignment, align
from .charts import SweepImages, TopViewPoints
from .free_space import find_stationary_points
from .held_out import HeldOutRays, simulate_held_out
from .lost_pulses import SensorCoverage
from .recorded_sweeps import RecordedSweeps
from .reflectances import Reflectances, fit_response
from .submaps import AlignedSubmap, Submap
from .surface_map import Observations, SurfaceMap, build_surface_map
from .surfels import Surfels, surfel_mesh


@dataclass(frozen=True, eq=False)
class SubmapTask:
    """A submap of a drive.

    Attributes
    ----------
    recorded
        All sweeps.
    alignment
        Of all sweeps.
    submap
        Sweeps of the submap, and around.
    mapped
        int64, ascending: sweeps of the drive whose points make the map.
    """

    recorded: RecordedSweeps
    alignment: Alignment
    submap: Submap
    mapped: Ints


@dataclass(frozen=True, eq=False)
class BuildTask(SubmapTask):
    """A submap whose place is built.

    Attributes
    ----------
    coverage
        Where the sensor has returns at all.
    compared
        int64, ascending: held-out sweeps of the drive that are compared.
    voxel_m
        Edge of the voxels of which surfels are made.
    drawn_share
        Share of the points that are drawn from above.
    """

    coverage: SensorCoverage
    compared: Ints
    voxel_m: float
    drawn_share: float

    def read(self) -> AlignedSweeps:
        """Read the sweeps of the submap and around, and keep these."""
        recorded = self.recorded.with_cached(self.submap.numbers.tolist())
        return AlignedSweeps(recorded, self.alignment, self.coverage)


class SubmapSurfels(NamedTuple):
    """Surfels of a submap, and numbers of the points of its own sweeps."""

    corners: Floats  # (m, 4, 3): meters
    dark_corners: Floats  # (d, 4, 3): of surfels that return nothing
    materials: AnyArray | None  # names
    material: Ints32 | None  # (m,): rows of `materials`
    points: Ints  # (k,): of each of its own sweeps
    moved: Ints  # (k,): of these, on things that moved

    @classmethod
    def from_surfels(
        cls, surfels: Surfels, chosen: Bools, standing: Mapping[int, Bools], own: Ints
    ) -> SubmapSurfels:
        """Return the arrays of chosen surfels (m,), and numbers of points of its `own` sweeps."""
        corners = surfels.mesh.vertices.reshape(-1, 4, 3)
        lit = chosen & ~surfels.dark
        materials = surfels.mesh.materials
        index = None if materials is None else materials.index
        masks = [standing[number] for number in own.tolist()]
        return cls(
            corners[lit],
            corners[chosen & surfels.dark],
            None if materials is None else np.array(materials.names),
            None if index is None else index[::2][lit],
            np.array([len(mask) for mask in masks]),
            np.array([int((~mask).sum()) for mask in masks]),
        )

    def mesh(self, name: str) -> SceneMesh:
        """Return the mesh of the surfels that return light."""
        materials = None
        if self.materials is not None:
            index = None if self.material is None else self.material.repeat(2)
            materials = FaceMaterials(tuple(self.materials.tolist()), index)
        return replace(surfel_mesh(name, self.corners), materials=materials)


BuiltSubmap = tuple[
    SubmapSurfels, Observations, HeldOutRays | None, SweepImages | None, TopViewPoints
]


def align_submap(task: SubmapTask) -> tuple[AlignedSubmap]:
    """Align the sweeps of a submap; LidarError if these show hardly any planes."""
    aligned = align(task.recorded, task.alignment, task.submap.numbers, set(task.mapped.tolist()))
    return (AlignedSubmap.from_alignment(aligned),)


def build_submap(task: BuildTask) -> BuiltSubmap:
    """Build the place of a submap, and compare held-out sweeps; LidarError if nothing stands."""
    submap = task.submap
    sweeps = task.read()
    standing = find_stationary_points(sweeps, submap.numbers.tolist())
    held_out, images = compared_sweeps(sweeps, task, standing)
    surface_map = build_surface_map(sweeps, standing, task.voxel_m)
    own = submap.owns(surface_map.surfels.centers, task.alignment.poses)
    observations = surface_map.observations(sweeps, standing).select_surfels(
        own & ~surface_map.surfels.dark
    )
    surfels = SubmapSurfels.from_surfels(surface_map.surfels, own, standing, submap.own_numbers)
    top_view = TopViewPoints.from_sweeps(sweeps, standing, submap.own_numbers, task.drawn_share)
    return surfels, observations, held_out, images, top_view


def compared_sweeps(
    sweeps: AlignedSweeps, task: BuildTask, standing: Mapping[int, Bools]
) -> tuple[HeldOutRays | None, SweepImages | None]:
    """Compare held-out sweeps of a submap with the place that the others make.

    Parameters
    ----------
    sweeps
        The sweeps, at their places.
    task
        The submap. Without sweeps of its own to compare, nothing is.
    standing
        Which points of the sweeps stand: {number: (n,)}.

    Returns
    -------
    tuple
        The rays of its held-out sweeps, and images of one; None without a sweep with points.

    Raises
    ------
    LidarError
        If too few points stand.
    """
    submap = task.submap
    compared = np.intersect1d(task.compared, submap.own_numbers).tolist()
    if not compared:
        return None, None
    mapped = np.intersect1d(submap.numbers, task.mapped).tolist()
    surface_map, reflectances = build_map_with_reflectances(sweeps, mapped, task.voxel_m)
    rays = simulate_held_out(sweeps, surface_map, reflectances, standing, compared)
    with_points = np.unique(rays.sweep[rays.returned])
    if not len(with_points):
        return rays, None
    drawn = int(with_points[len(with_points) // 2])
    return rays, SweepImages.from_sweep(sweeps, surface_map, reflectances, drawn)


def build_map_with_reflectances(
    sweeps: AlignedSweeps, numbers: list[int], voxel_m: float
) -> tuple[SurfaceMap, Reflectances | None]:
    """Build the place of some sweeps alone, without what moved.

    Returns its reflectances, too, or None without intensities; LidarError if too few points stand.
    """
    standing = find_stationary_points(sweeps, numbers)
    surface_map = build_surface_map(sweeps, standing, voxel_m)
    observations = surface_map.observations(sweeps, standing)
    response = fit_response(
        [observations],
        sweeps.recorded.ring_count,
        are_energies=sweeps.recorded.recording.energies,
    )
    if response is None:
        return surface_map, None
    return surface_map, response.reflectances(observations, surface_map.surfels.centers)
