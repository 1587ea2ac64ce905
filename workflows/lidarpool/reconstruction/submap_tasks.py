"""What processes do with the stretches of a drive: they align the sweeps, and rebuild the place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints, Ints32
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.scene_mesh import SceneMesh

from .alignment import AlignedSweeps, Alignment, align
from .charts import Above, SweepImages
from .free_space import standing_points
from .held_out import HeldOut, hold_out
from .lost_pulses import Answering
from .recorded_sweeps import RecordedSweeps
from .reflectances import Reflectances, fit_response
from .submaps import AlignedStretch, Stretch
from .surface_map import Observations, Place, build_place
from .surfels import Surfels, surfel_mesh


@dataclass(frozen=True, eq=False)
class StretchTask:
    """A stretch of a drive.

    Attributes
    ----------
    recorded
        All sweeps.
    alignment
        Of all sweeps.
    stretch
        Sweeps of the stretch, and around.
    mapped
        int64, ascending: sweeps of the drive whose points make the map.
    """

    recorded: RecordedSweeps
    alignment: Alignment
    stretch: Stretch
    mapped: Ints


@dataclass(frozen=True, eq=False)
class BuildTask(StretchTask):
    """A stretch whose place is built.

    Attributes
    ----------
    answering
        Where the sensor has returns at all.
    compared
        int64, ascending: held-out sweeps of the drive that are compared.
    voxel_m
        Edge of the voxels of which surfels are made.
    drawn_share
        Share of the points that are drawn from above.
    """

    answering: Answering
    compared: Ints
    voxel_m: float
    drawn_share: float

    def read(self) -> AlignedSweeps:
        """Read the sweeps of the stretch and around, and keep these."""
        recorded = self.recorded.keeping(self.stretch.numbers.tolist())
        return AlignedSweeps(recorded, self.alignment, self.answering)


class StretchSurfels(NamedTuple):
    """Surfels of a stretch, and numbers of the points of its own sweeps."""

    corners: Floats  # (m, 4, 3): meters
    dark_corners: Floats  # (d, 4, 3): of surfels that return nothing
    materials: AnyArray | None  # names
    material: Ints32 | None  # (m,): rows of `materials`
    points: Ints  # (k,): of each of its own sweeps
    moved: Ints  # (k,): of these, on things that moved

    @classmethod
    def of_surfels(
        cls, surfels: Surfels, chosen: Bools, standing: Mapping[int, Bools], own: Ints
    ) -> StretchSurfels:
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


BuiltStretch = tuple[StretchSurfels, Observations, HeldOut | None, SweepImages | None, Above]


def align_stretch(task: StretchTask) -> tuple[AlignedStretch]:
    """Align the sweeps of a stretch; LidarError if these show hardly any planes."""
    aligned = align(task.recorded, task.alignment, task.stretch.numbers, set(task.mapped.tolist()))
    return (AlignedStretch.of_alignment(aligned),)


def build_stretch(task: BuildTask) -> BuiltStretch:
    """Build the place of a stretch, and compare held-out sweeps; LidarError if nothing stands."""
    stretch = task.stretch
    sweeps = task.read()
    standing = standing_points(sweeps, stretch.numbers.tolist())
    held_out, images = compared_sweeps(sweeps, task, standing)
    place = build_place(sweeps, standing, task.voxel_m)
    own = stretch.owns(place.surfels.centers, task.alignment.poses)
    seen = place.observations(sweeps, standing).of_surfels(own & ~place.surfels.dark)
    surfels = StretchSurfels.of_surfels(place.surfels, own, standing, stretch.own_numbers)
    above = Above.of_sweeps(sweeps, standing, stretch.own_numbers, task.drawn_share)
    return surfels, seen, held_out, images, above


def compared_sweeps(
    sweeps: AlignedSweeps, task: BuildTask, standing: Mapping[int, Bools]
) -> tuple[HeldOut | None, SweepImages | None]:
    """Compare held-out sweeps of a stretch with the place that the others make.

    Parameters
    ----------
    sweeps
        The sweeps, at their places.
    task
        The stretch. Without sweeps of its own to compare, nothing is.
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
    stretch = task.stretch
    compared = np.intersect1d(task.compared, stretch.own_numbers).tolist()
    if not compared:
        return None, None
    mapped = np.intersect1d(stretch.numbers, task.mapped).tolist()
    place, reflectances = rebuild(sweeps, mapped, task.voxel_m)
    rays = hold_out(sweeps, place, reflectances, standing, compared)
    with_points = np.unique(rays.sweep[rays.returned])
    if not len(with_points):
        return rays, None
    drawn = int(with_points[len(with_points) // 2])
    return rays, SweepImages.of_sweep(sweeps, place, reflectances, drawn)


def rebuild(
    sweeps: AlignedSweeps, numbers: list[int], voxel_m: float
) -> tuple[Place, Reflectances | None]:
    """Build the place of some sweeps alone, without what moved.

    Returns its reflectances, too, or None without intensities; LidarError if too few points stand.
    """
    standing = standing_points(sweeps, numbers)
    place = build_place(sweeps, standing, voxel_m)
    seen = place.observations(sweeps, standing)
    response = fit_response(
        [seen],
        sweeps.recorded.ring_count,
        are_energies=sweeps.recorded.recording.energies,
    )
    if response is None:
        return place, None
    return place, response.reflectances(seen, place.surfels.centers)
