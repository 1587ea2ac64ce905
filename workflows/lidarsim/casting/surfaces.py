"""Normals and colors of a scene's surfaces, and the light that their materials reflect."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..media.materials import NEAR_NM, Material, MaterialTable, normal_incidence_energy
from ..numerics.arrays import Bools, Floats, Integers, Ints, Ints32, UInts32, to_writable
from ..numerics.vectors import rotate_into_frames
from ..scene.colors import GRAY, Lookup, join_colors, luminance, pack_colors
from ..scene.scene import Scene
from ..sensor import Sensor
from ..survey.survey import Survey
from .actor_surfaces import ActorSurfaces
from .actor_trajectories import ActorTrajectories
from .media_bodies import MediaBodies
from .stored_triangles import BLOCK_FACES, StoredTriangles, normals_of
from .triangle_kinds import TriangleKinds
from .voxels import Grids

if TYPE_CHECKING:
    from .surface_loops import Incidence

_log = logging.getLogger(__name__)

LEVEL = math.sqrt(0.75)  # smallest z of normals of surfaces that hold water: 30 degrees of slope
BLOCK_HITS = 1 << 14  # number of hits whose colors are looked up at a time, to fit a cache
_NO_NORMALS = np.zeros((0, 3), np.float32)


class SensorLight(NamedTuple):
    """Wavelength of a sensor, and the air and water in the path of its light."""

    wavelength_nm: float
    extinction: float  # 1/m
    wet: float = 0.0  # fraction of upward-facing surfaces that is covered by water


class IlluminatedHits(NamedTuple):
    """Ray hits on surfaces, with the energies that the sensor receives."""

    normals: Floats  # (n, 3): unit normals in the scene frame, on either side of the surface
    cosines: Floats  # (n,): cosines of the angles between normals and directions, of either sign
    kinds: Ints32  # (n,): kinds of surfaces, which are rows of the material table
    energy: Floats  # (n,), as in `SceneSurfaces.energy`, but reduced by a film of water
    film: Bools | None = None  # (n,): whether there may be a film of water


def sensor_light_of(survey: Survey, sensor: Sensor) -> SensorLight:
    """Return the properties of a sensor's light in the weather of a survey.

    All values are floats, because an int would cause the compiled loops to be compiled again.
    """
    return SensorLight(sensor.optics.simulated_nm, survey.extinction(sensor), float(survey.wet))


def warn_of_gray(scene: Scene, survey: Survey) -> None:
    """Log a warning if materials use colors as reflectance but the scene has no colors."""
    if not scene.all_colors and any(m.reflectance == "texture" for m in survey.materials):
        _log.warning(
            "a material has reflectance: texture, but the scene has no colors, so all surfaces "
            "are gray. In Python, read colors with Scene.load(path, colors=True)"
        )


class SceneSurfaces:
    """Optical properties of the triangles in a scene.

    `StoredTriangles` numbers the triangles, and `TriangleKinds` maps them to kinds of surfaces,
    which are rows of the material table. `wavelengths` are the wavelengths of all sensors in
    nanometers.

    Raises
    ------
    LidarError
        If `materials` is not empty and an object has no material, or a name matches no object.
    """

    def __init__(
        self,
        scene: Scene,
        materials: tuple[Material, ...],
        wavelengths: Iterable[float] = (NEAR_NM,),
    ) -> None:
        self._scene = scene
        kinds = scene.surface_kinds
        self._tables = {
            nm: MaterialTable.build(materials, kinds, nm, scene.has_voxels) for nm in wavelengths
        }
        self.grids = Grids.from_instances(scene.instances)
        self.triangles = StoredTriangles(scene)
        self.on_actors = ActorSurfaces(self.triangles)
        self.triangle_kinds = TriangleKinds(scene, kinds, materials, self.triangles)
        self.media_bodies = MediaBodies(scene, self.triangle_kinds, self.materials)

    @property
    def materials(self) -> MaterialTable:
        """Materials, indexed by kind of surface. Only the reflectance depends on the wavelength."""
        return next(iter(self._tables.values()))

    def at_wavelength(self, wavelength_nm: float) -> MaterialTable:
        """Return the materials at the wavelength of a sensor, indexed by kind of surface."""
        return self._tables[wavelength_nm]

    def with_moved_instances(self, scene: Scene) -> SceneSurfaces:
        """Return a copy for a scene in which instances have moved."""
        assert scene.instances is not None
        surfaces = copy(self)
        surfaces._scene = scene
        # Nothing else depends on transforms.
        surfaces.triangles = self.triangles.with_moved_instances(scene)
        surfaces.grids = self.grids and self.grids.with_moved_instances(scene.instances)
        return surfaces

    def normals(
        self, triangle: Integers, times: Floats | Ints, trajectories: ActorTrajectories
    ) -> Floats:
        """Return the unit normals of triangles in the scene frame, as float64.

        The normals are accurate to single precision. Normals of actors are rotated by the actors'
        poses at `times` (n,) in nanoseconds.
        """
        directions = np.zeros((len(triangle), 3))
        incidence, _ = self._incidence(triangle, directions, self.materials, times, trajectories)
        return incidence.normals.T

    def _incidence(
        self,
        triangle: Integers,
        directions: Floats,
        table: MaterialTable,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> tuple[Incidence, Ints32]:
        """Return the incidence of rays on triangles, and the surface kinds of the triangles.

        `directions` (n, 3) are in the scene frame. `times` (n,) determine the poses of actors, in
        nanoseconds. `Incidence.back`, the energy received from 10 m, is valid for surfaces that are
        neither textured nor rough.
        """
        from . import surface_loops  # imported here because numba takes half a second to import

        poses = np.zeros((12, 0))
        run = np.zeros(0, np.int64)
        row, objects, instance = self.triangles.locate(triangle)
        kinds = self.triangle_kinds.of_rows(row, objects)
        deformed_normals = _NO_NORMALS
        if trajectories:
            actors = objects - np.int64(self.triangles.static_objects)
            poses, run = trajectories.pose_runs(actors, to_writable(times))
            if len(deforming := trajectories.deforming_rows(actors)):
                deformed = self.on_actors.deformed_corners(
                    row[deforming], actors[deforming], times[deforming], trajectories
                )
                deformed_normals = normals_of(deformed.corners)
                row[deforming] = ~np.arange(len(deforming))  # rows of `deformed_normals`
        cosines, back = np.empty((2, len(row)))
        incidence = surface_loops.Incidence(np.empty((3, len(row))), cosines, back)
        surface_loops.compute_incidence(
            surface_loops.HitSurfaces(row, kinds, instance, run),
            to_writable(directions.T),
            surface_loops.NormalTables(
                self.triangles.unit_normals, deformed_normals, self.triangles.normal_matrices, poses
            ),
            table.reflectance,
            table.retro,
            incidence,
        )
        return incidence, kinds

    def illuminate(
        self,
        triangle: Integers,
        directions: Floats,
        distance: Floats,
        sensor_light: SensorLight,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
        colors: UInts32 | None = None,
    ) -> IlluminatedHits:
        """Return the normals, cosines, surface kinds and received energies of hits.

        Parameters
        ----------
        triangle, distance
            (n,): triangles that the rays hit, and optical path lengths of the rays in meters.
        directions
            (n, 3): unit directions of the rays in the scene frame.
        sensor_light
            Light of the sensor.
        times
            (n,): firing times in nanoseconds, which determine the poses of actors.
        trajectories
            Trajectories of the actors.
        colors
            (n,): packed colors, which are required if materials have textures.
        """
        from . import surface_loops

        table = self.at_wavelength(sensor_light.wavelength_nm)
        incidence, kinds = self._incidence(triangle, directions, table, times, trajectories)
        normals, cosines, back = incidence
        bright = luminance(colors) if table.has_textures and colors is not None else None
        if table.has_textures or table.roughness.any():
            back = table.relative_energy(kinds, np.abs(cosines), bright)
        film = None
        if sensor_light.wet:
            film = np.empty(len(cosines), np.bool_)
            water = surface_loops.WaterFilm(LEVEL, sensor_light.wet, table.passes | table.leafy)
            shares = table.diffuse_reflectances(kinds, bright)
            surface_loops.apply_water_film(
                normals[2], cosines, kinds=kinds, shares=shares, water=water, film=film, back=back
            )
        surface_loops.attenuate_energies(to_writable(distance), sensor_light.extinction, back)
        return IlluminatedHits(normals.T, cosines, kinds, back, film)

    def colors(
        self,
        triangle: Integers,
        points: Floats,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> UInts32:
        """Return the packed colors at points on triangles.

        Points are in the scene frame in meters. If the scene has no colors, all points are gray.
        Actors have their poses at `times` (n,) in nanoseconds.
        """
        if self._lookup is None:
            return np.full(len(triangle), pack_colors(GRAY[0])[0])
        result = np.empty(len(triangle), np.uint32)
        for begin in range(0, len(triangle), BLOCK_HITS):
            block = slice(begin, begin + BLOCK_HITS)
            result[block] = self._block_colors(
                triangle[block], points[block], times[block], trajectories
            )
        return result

    def _block_colors(
        self, triangle: Integers, points: Floats, times: Any, trajectories: ActorTrajectories
    ) -> UInts32:
        assert self._lookup is not None
        stored_rows, _, instance = self.triangles.locate(triangle)
        on_instances = np.flatnonzero(instance >= 0)
        if len(on_instances) or trajectories:
            points = points.copy()
        if len(on_instances):
            assert self._scene.instances is not None
            instance_numbers = instance[on_instances]
            normal_matrices = self.triangles.normal_matrices[instance_numbers]
            from_origins = (
                points[on_instances] - self._scene.instances.transforms[instance_numbers, :, 3]
            )
            points[on_instances] = rotate_into_frames(from_origins, normal_matrices)
        self.on_actors.move_to_rest(points, triangle, stored_rows, times, trajectories)
        return self._lookup.colors_at(stored_rows, points)

    @cached_property
    def _lookup(self) -> Lookup | None:
        """Colors of the stored triangles, or None if the scene has no colors."""
        bodies = self.triangles.stored_bodies
        sizes = [len(faces) for _, faces, _ in bodies]
        colors = join_colors([colors for _, _, colors in bodies], sizes)
        if colors is None:
            return None
        corners = (
            vertices[faces[begin : begin + BLOCK_FACES]]
            for vertices, faces, _ in bodies
            for begin in range(0, len(faces), BLOCK_FACES)
        )
        return Lookup(colors, corners)

    def kinds(self, triangle: Integers) -> Ints32:
        """Return the surface kind of each triangle, or -1 for `NO_SURFACE`."""
        return self.triangle_kinds.of_triangles(triangle)

    def energy(
        self,
        triangle: Integers,
        cosine: Floats,
        distance: Floats,
        sensor_light: SensorLight,
        colors: UInts32 | None = None,
    ) -> Floats:
        """Return the energies received from triangles at the given distances in meters.

        The energy is ``reflectance * cosine * (10 m / distance)**2 * exp(-2 * extinction *
        distance)``. For a retroreflector, a gain replaces the cosine. Rough surfaces add gloss.
        Distances below `NEAREST_M` are treated as `NEAREST_M`. If materials have textures,
        `colors` (n,) is required.
        """
        table = self.at_wavelength(sensor_light.wavelength_nm)
        bright = luminance(colors) if table.has_textures and colors is not None else None
        scattered = table.relative_energy(self.kinds(triangle), cosine, bright)
        return np.asarray(scattered * normal_incidence_energy(distance, sensor_light.extinction))
