"""Stray light that reaches a receiver from retroreflectors outside its beam."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces, sensor_light_of
from ...columns.table import CAUSES
from ...media.materials import MaterialTable
from ...numerics.arrays import Bools, Floats, Integers, Ints, Ints32, to_writable
from ...numerics.random_numbers import Purpose
from ...numerics.vectors import dot, norm, rotate, rotate_into_frames
from ...scene.scene import Scene
from ..returns import RETURN_COLUMNS, PulseReturns, merge_returns, returns_without_surface
from .detection import exceeds_threshold
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

if TYPE_CHECKING:
    from .stray_loops import RayCells, RetroTriangles, StrayLight

STRAY = Purpose(22, "energy noise of stray light")
BLOOMING = CAUSES.index("blooming")
NEAREST_TRIANGLES = 4  # number of a cluster's triangles, nearest by angle, compared with a ray
CLUSTER_M = 1.0  # size of a cluster of triangles that are compared with rays together
FAINTEST = 0.1  # fainter light, as a fraction of the detection threshold, is never detected


class StrayLightStep(PulseStep):
    """Simulation step that adds stray light from retroreflectors outside the beams."""

    role = Role.RECEIVES
    effects = ("Blooming",)
    reads = "ray", "distance"
    writes = RETURN_COLUMNS
    causes = (BLOOMING,)
    purposes = (STRAY,)
    on_recordings = (
        "`noise.stray_light` cannot be simulated on a recording, because a recording does not "
        "state which surfaces are retroreflectors. Reconstruct the scene with `lidarpool twin`, "
        "and simulate the sensor in it."
    )

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: SceneSurfaces) -> None:
        super().__init__(setup, caster, surfaces)
        self._sensor_light = sensor_light_of(setup.survey, setup.sensor)
        self._clusters = [*_retro_clusters(setup.scene, surfaces, caster.unseen)]

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the noise of the sensor includes stray light."""
        return setup.noise.stray_light > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of return causes and of central rays, in bytes."""
        return Memory(retained=10 * sizes.return_count, casting=120 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add stray light to the returns of a batch.

        A beam adds its strongest stray light if this light is detected, in range, visible from the
        beam's origin, and not too close to another return of the beam to be separated from it.
        """
        if not self._clusters:
            return returns
        noise = self.setup.noise
        sensor = self.setup.sensor
        rays = np.arange(batch.start, batch.stop)
        times = batch.subray_poses.times((rays - batch.start) * batch.subrays_per_beam)
        light = self._strongest(batch, times)
        row = np.flatnonzero(light.energy > FAINTEST * noise.threshold)
        scan, number = batch.keys.scan_and_number(rays[row])
        row = row[exceeds_threshold(noise, STRAY, light.energy[row], scan, number)]
        distance = np.sqrt(dot(light.points[row].T, light.points[row].T))
        in_range = (distance >= sensor.min_range_m) & (distance <= sensor.max_range_m)
        row = row[in_range]
        distance = distance[in_range]
        origins, _ = batch.central_rays
        trajectories = batch.subray_poses.actor_trajectories
        visible = self.caster.is_visible(
            origins[row], light.points[row], distance, times[row], trajectories
        )
        visible &= ~self._has_return(returns, rays[row], distance)
        row = row[visible]
        stray = returns_without_surface(
            returns, rays[row], distance[visible], light.energy[row], BLOOMING
        )
        return merge_returns(returns, stray)

    def _strongest(self, batch: PulseBatch, times: Floats) -> StrayLight:
        """Return the strongest stray light on the central ray of each beam.

        `times` (n,) are the firing times of the beams in nanoseconds. Points are relative to the
        rays' origins, along the axes of the scene frame.
        """
        from . import stray_loops  # imported here because numba takes half a second to import

        origins, directions = batch.central_rays
        count = batch.stop - batch.start
        light = stray_loops.StrayLight(
            np.zeros(count), np.zeros((count, 3)), np.zeros(count, np.bool_)
        )
        limits = stray_loops.StrayLimits(
            float(self.setup.sensor.min_range_m),
            float(self.setup.noise.stray_light),
            float(FAINTEST * self.setup.noise.threshold),
            float(self._sensor_light.extinction),
        )
        chosen = np.zeros(NEAREST_TRIANGLES, np.int64)
        table = self.surfaces.at_wavelength(self._sensor_light.wavelength_nm)
        for actor, clusters in groupby(self._clusters, key=lambda cluster: cluster.actor):
            rotations = None
            positions = np.zeros(3)
            if actor is not None:
                positions, rotations = batch.subray_poses.actor_trajectories[actor].poses(0, times)
            cells = _ray_cells(
                rotate_into_frames(origins - positions, rotations),
                rotate_into_frames(directions, rotations),
            )
            light.new[:] = False
            for cluster in clusters:
                triangles = self._triangles(cluster, table)
                stray_loops.find_stray_light(cells, triangles, limits, chosen, light)
            if rotations is not None:  # rotate back to the scene frame
                row_indices = np.flatnonzero(light.new)
                to_scene = rotations[row_indices].transpose(0, 2, 1)
                light.points[row_indices] = rotate_into_frames(light.points[row_indices], to_scene)
        return light

    def _triangles(self, cluster: _RetroCluster, table: MaterialTable) -> RetroTriangles:
        """Return a cluster's triangles together with their energies at normal incidence."""
        from .stray_loops import RetroTriangles

        white = np.ones(len(cluster.triangles))
        back = table.relative_energy(self.surfaces.kinds(cluster.triangles), white, white)
        return RetroTriangles(cluster.corners, *cluster.bounds, back)

    def _has_return(self, returns: PulseReturns, ray: Ints, distance: Floats) -> Bools:
        """Return whether each of the given beams has a return close to the given distance.

        Two returns are close if they are within half a pulse length, so that the receiver cannot
        separate them.
        """
        first = np.searchsorted(returns.ray, ray, side="left")
        last = np.searchsorted(returns.ray, ray, side="right")
        close = np.zeros(len(ray), np.bool_)
        for number in range(int((last - first).max(initial=0))):
            row_indices = np.flatnonzero(first + number < last)
            return_distance = returns.distance[first[row_indices] + number]
            close[row_indices] |= (
                np.abs(return_distance - distance[row_indices]) <= self.setup.half_pulse_m
            )
        return close


def _ray_cells(origins: Floats, directions: Floats) -> RayCells:
    """Return rays and the cones around cells of consecutive rays, for compiled loops."""
    from . import stray_loops

    cones = np.empty((-(-len(origins) // stray_loops.CELL_RAYS), 5))
    cells = stray_loops.RayCells(to_writable(origins.T), to_writable(directions.T), cones)
    stray_loops.bound_cells(*cells)
    return cells


class _Bounds(NamedTuple):
    """Centers and bounding sphere of triangles."""

    centers: Floats  # (k, 3): centers of the triangles
    center: Floats  # (3,): center of the bounding sphere
    radius: float  # radius of the bounding sphere, meters


@dataclass(frozen=True)
class _RetroCluster:
    """A cluster of retroreflecting triangles."""

    triangles: Ints32  # (k,): numbers among all triangles of the scene
    corners: Floats  # (k, 3, 3): in the scene frame, or in the frame of an actor
    actor: int | None = None  # number of the actor, or None in the static scene

    @cached_property
    def bounds(self) -> _Bounds:
        """Centers and bounding sphere of the triangles."""
        a, b, c = self.corners.transpose(1, 0, 2)
        center = self.corners.reshape(-1, 3).mean(axis=0)
        radius = float(norm(self.corners.reshape(-1, 3) - center).max())
        return _Bounds(((a + b) + c) / 3, center, radius)


def _retro_clusters(
    scene: Scene, surfaces: SceneSurfaces, unseen: Bools | None
) -> Iterator[_RetroCluster]:
    """Yield the clusters of retroreflecting triangles in a scene, its instances and its actors.

    Objects in the mask `unseen` (objects,) are omitted.
    """
    retro = surfaces.materials.retro
    owners = surfaces.triangle_kinds.material_kinds.object
    if unseen is not None:
        retro = retro & ~unseen[owners]
    has_retro = np.zeros(len(scene.object_names), np.bool_)  # one for each object
    has_retro[owners[retro]] = True

    def clusters_of(
        faces: Integers, vertices: Floats, first: int, actor: int | None = None
    ) -> Iterator[_RetroCluster]:
        """Yield the clusters of the retroreflecting triangles among `faces`.

        The triangles of `faces` are numbered from `first` on.
        """
        face_indices = np.flatnonzero(retro[surfaces.kinds(first + np.arange(len(faces)))])
        return _clusters(first + face_indices, vertices[faces[face_indices]], actor)

    if has_retro[: len(scene.names)].any():
        yield from clusters_of(scene.faces, scene.vertices, 0)
    first = len(scene.faces)
    shared = scene.instances
    if shared is not None:
        for part, matrix, owner in zip(shared.part, shared.transforms, shared.owner, strict=True):
            mesh = shared.mesh_parts[part]
            if has_retro[owner]:
                vertices = rotate(mesh.vertices, matrix[:, :3]) + matrix[:, 3]
                yield from clusters_of(mesh.faces, vertices, first)
            first += len(mesh.faces)
    for number, actor in enumerate(scene.actors):
        faces = actor.mesh.faces
        if has_retro[len(scene.names) + number]:
            yield from clusters_of(faces, actor.mesh.vertices, first, number)
        first += len(faces)


def _clusters(
    triangles: Integers, corners: Floats, actor: int | None = None
) -> Iterator[_RetroCluster]:
    """Yield clusters of triangles, which are grouped by the cells of a grid."""
    if not len(triangles):
        return
    cells = np.floor(corners.mean(axis=1) / CLUSTER_M).astype(np.int64)
    cluster = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    for number in range(int(cluster.max()) + 1):
        row_indices = np.flatnonzero(cluster == number)
        yield _RetroCluster(triangles[row_indices].astype(np.int32), corners[row_indices], actor)
