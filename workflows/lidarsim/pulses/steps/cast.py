"""Cast sub-rays, and follow their light through glass and off mirrors.

A surface can reflect, transmit and scatter parts of the light. Each part continues separately.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern

from ...casting.actor_trajectories import ActorTrajectories
from ...casting.motion import CastPoses, FiringClock, order_along_rings
from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces, sensor_light_of
from ...casting.visibility import unseen_objects
from ...columns.table import CAUSES, COLORS
from ...media.weather import FAINTEST
from ...numerics.arrays import (
    Bools,
    Bytes,
    Floats,
    Indices,
    Integers,
    Ints,
    Ints32,
    UInts32,
    to_writable,
)
from ...numerics.random_numbers import Purpose, normal, raw, uniform
from ...numerics.vectors import dot, rotate_into_frames
from ...scene.colors import luminance
from ..returns import RETURN_COLUMNS, SURFACE, PulseReturns, concatenate_returns, select_rows
from .doppler import range_rates_of_origins, velocities_of_ends
from .light_in_media import CROWN, LEAF, Draw, Leaves, LightInMedia, Media, MediaRays, random_depths
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

GAP = Purpose(32, "gaps in surfaces that light passes")
SPREAD = Purpose(33, "depth of a return in a porous surface")
REFLECTANCE = Purpose(34, "reflectance of a surface for a sub-ray")
GHOST = CAUSES.index("ghost")
_TINY = 1e-300  # avoids division by zero for surfaces without gaps
_MIN_FACTOR = 0.02  # minimum factor of a reflectance with a spread
MAX_PASSES = 16  # number of surfaces that light can pass before it is dropped
MAX_LEAFY_PASSES = 64  # limit with crowns, whose surface light passes twice
MAX_REFLECTIONS = 2  # number of times that light can be reflected; each may divide the light


@dataclass
class LightPaths:
    """Straight segments of the light paths of sub-rays.

    All arrays have shape (n,), and vectors have shape (n, 3) in the scene frame. The first segment
    of a path starts at the sensor. Each later segment starts just behind a surface that transmits
    or reflects the light.
    """

    ray: Ints  # number of the sub-ray, counted from the start of the batch
    times: Floats  # firing times, nanoseconds since the start of the survey; 0 without actors
    origins: Floats  # start points of the segments, meters
    directions: Floats  # unit vectors
    # Fraction of the energy left by the earlier surfaces, on the way out and back; 1 at the sensor.
    share: Floats
    optical_start: Floats  # optical path length from the sensor to the origins, meters
    # (n, 3, 3): product of the reflections so far, which maps fired directions to the directions of
    # the segments. None if no light is reflected, and for beams with a single sub-ray.
    mirror_matrices: Floats | None = None
    mirrored: Bytes | None = None  # number of reflections so far, if there are mirrors
    in_media: LightInMedia | None = None  # None without media
    # Rate of change of the optical path length caused by the motion of the sensor and of the
    # earlier surfaces, in m/s, as if the next surface were static; None if no column stores
    # velocities.
    range_rate: Floats | None = None
    # Uniform random number in [0, 1). The light passes through a porous surface if the number is
    # less than the gap fraction. The number divided by the gap fraction is then uniformly
    # distributed as well, and applies to the next surface. None if no surface is porous.
    gap_number: Floats | None = None

    def take(self, row_indices: Integers) -> LightPaths:
        """Return the light paths in the given rows."""
        return LightPaths(*select_rows(vars(self).values(), row_indices))

    def optical_end(self, step_m: Floats) -> Floats:
        """Return the optical path lengths from the sensor to points `step_m` from the origins."""
        return self.optical_start + (
            step_m if self.in_media is None else self.in_media.optical_length(step_m)
        )

    @property
    def index(self) -> Floats | float:
        """Refractive index of the medium around the light, or 1.0 if the scene has no media."""
        return 1.0 if self.in_media is None else self.in_media.index


class CastLight(NamedTuple):
    """Light that hits surfaces, and the triangles that it hits.

    All arrays have shape (n,).
    """

    light: LightPaths
    # Distance in meters from which on the light can hit leaves: the sensor's minimum range or, for
    # later segments, the position of the last surface, which is at or slightly below 0.
    start_m: Floats
    step_m: Floats  # distance of the hit from the origin, meters
    triangle: Ints32  # number of the triangle (`SceneCaster`)


class SurfaceHits(NamedTuple):
    """Hits on surfaces. Each row belongs to the same row of the light.

    Arrays have shape (n,), and arrays of vectors have shape (n, 3).
    """

    step_m: Floats  # distance from the origin of the last segment, meters
    triangle: Ints32  # for a hit on a leaf, the triangle where the light entered the crown
    distance: Floats  # optical path length from the sensor, meters
    color: UInts32 | None  # packed (`SceneSurfaces.colors`); None if not needed
    normals: Floats  # unit vectors in the scene frame; for a leaf, the direction of the light
    cosines: Floats  # cosines of the angles between normals and directions, of either sign
    kinds: Ints32  # kinds of surfaces, rows of the material table
    energy: Floats  # received energy, in the unit of `SceneSurfaces.energy`
    film: Bools | None  # whether there may be a film of water; None if no surface is wet
    leaves: Indices  # (l,): rows where light hits a leaf within a crown
    gaps: Bools | None  # whether light passes through a gap; None if no surface is porous
    velocities: Floats  # velocities of the surfaces; shape (0, 3) if they are not needed


class VisibleHits(NamedTuple):
    """Hits that the sensor can see, and masks of the hits at which light continues.

    The sensor sees k of the n hits.
    """

    hits: PulseReturns  # k rows; these are all hits if there are no media
    normals: Floats  # (k, 3): normals of the hits, reflected back to match the fired directions
    transmits: Bools  # (n,): whether light continues through the surface
    mirrors: Bools  # (n,): whether the surface reflects part of the light specularly


class SurfaceCrossings(NamedTuple):
    """Surfaces that transmit or reflect light.

    A surface that does both has two rows. Arrays have shape (n,), and arrays of vectors have shape
    (n, 3).
    """

    step_m: Floats  # distance from the origin, meters
    distance: Floats  # optical path length from the sensor, meters
    triangle: Ints32
    normals: Floats
    cosines: Floats  # cosines of the angles between normals and directions, of either sign
    reflected: Bools  # True if the light of the row is reflected, False if it is transmitted
    # Velocities of the surfaces in m/s. Refraction at a moving surface changes the range rate.
    velocities: Floats | None


class OnwardRows(NamedTuple):
    """Rows of light that continues.

    All arrays have shape (k,). Light that is divided has two rows.
    """

    row_indices: Indices
    reflected: Bools  # True if the light of the row is reflected, False if it is transmitted
    share: Floats  # fraction of the energy behind the surface, as in `LightPaths.share`


class Deflection(NamedTuple):
    """Light behind surfaces that refract or reflect it.

    Arrays have shape (n,), and arrays of vectors have shape (n, 3).
    """

    directions: Floats
    share: Floats  # fraction of the energy behind the surface, as in `LightPaths.share`
    mirrored: Bools  # whether light is reflected, including total internal reflection
    twice_normals: Floats  # twice the normal where light is reflected, otherwise 0


class OnwardLight(NamedTuple):
    """Light just behind the surfaces that it last hit, ready for the next cast.

    All arrays have shape (n,).
    """

    light: LightPaths
    start_m: Floats  # positions of these surfaces along the light, meters, at or below 0
    pattern: Pattern  # rays to cast, which are the origins and directions of `light`


def has_bodies(setup: Setup) -> bool:
    """Return whether the sensor sees any object of the scene."""
    unseen = unseen_objects(setup.scene, setup.survey)[setup.number]
    return unseen is None or not unseen.all()


class CastStep(PulseStep):
    """Simulation step that casts sub-rays and records their hits on surfaces and leaves.

    Light that a surface transmits or reflects is cast again and can produce further hits.
    """

    role = Role.FRAME
    effects = (
        "Ghosts",
        "Wet ground",
        "Gaussian and elliptical beams",
        "Refraction",
        "Vegetation",
        "Porous surfaces",
        "Rays without a return",
    )
    writes = *RETURN_COLUMNS, "velocity"
    causes = (GHOST,)
    purposes = LEAF, CROWN, GAP, SPREAD, REFLECTANCE

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: SceneSurfaces) -> None:
        super().__init__(setup, caster, surfaces)
        survey = setup.survey
        sensor = setup.sensor
        self._sensor_light = sensor_light_of(survey, sensor)
        self._seed = setup.noise.seed
        table = surfaces.at_wavelength(sensor.optics.simulated_nm)
        filled = table.leafy.any() or table.refracts.any()
        air = self._sensor_light.extinction
        self._media = Media(setup.scene, surfaces, table, air) if filled else None
        # If there are mirrors, light that can return no more energy than this is not cast again.
        self._faintest = FAINTEST * setup.noise.threshold
        white = np.ones(len(table.reflectance))
        # Largest energy that any kind of surface returns from a distance of 10 m.
        self._brightest = float(table.relative_energy(np.arange(len(white)), white, white).max())
        shown = any(column.name in COLORS for column in survey.stored_columns)
        self._colored = shown or surfaces.materials.has_textures
        # Whether the origins of rays are needed in addition to their directions.
        self._needs_origins = (
            self._colored
            or setup.has_velocities
            or setup.has_onward_light
            or self._media is not None
        )

    def with_moved_instances(self, setup: Setup, surfaces: SceneSurfaces) -> PulseStep:
        """Return a copy for a scene in which instances have moved, with updated bounds of media."""
        if self._media is not None:
            return super().with_moved_instances(setup, surfaces)
        return self.with_setup(setup, surfaces)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether rays are cast, and may have several returns or none."""
        return setup.return_count_varies and (not setup.is_recorded or has_bodies(setup))

    @staticmethod
    def added_returns(setup: Setup) -> float:
        """Return the maximum number of ghosts per pulse, as an upper bound for the mean."""
        return MAX_REFLECTIONS * setup.has_mirrors

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of sub-rays and hits in bytes.

        The memory is larger if light continues beyond hits. It consists of the memory used while
        rays are cast and while returns are counted (`Memory`).
        """
        subray = 200 if not setup.has_onward_light else 1350 if setup.refracts else 650
        casting = (subray + 200 * setup.has_velocities) * sizes.subrays + 30 * sizes.return_count
        return Memory(casting=casting, counting=75 * sizes.return_count + 40 * sizes.points)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the hits of a batch's sub-rays.

        The argument `returns` is not used.

        A pass casts light and determines what happens to it at the hits:

        1. `_cast_first` casts all sub-rays from the sensor. `CastLight` has a row for each sub-ray
           that hits a surface, with the path of its light (`LightPaths`) and the triangle.
        2. `_surface_hits` determines whether each row hits the surface or a leaf in front of it.
           `SurfaceHits` has the color, the normal and the energy of each row.
        3. `_visible_hits` selects the rows that the sensor can see, as `PulseReturns`, and marks
           rows whose light continues (`VisibleHits`).
        4. `_continue` takes the marked rows (`OnwardRows`), twice if light is both transmitted and
           reflected, and refracts or reflects the light (`Deflection`). The result is
           `OnwardLight`. If no rows are marked, this was the last pass.
        5. `_cast_again` casts this light and returns the `CastLight` for step 2 of the next pass.
        6. `_join` sorts the hits of all passes by sub-ray.

        For example, two sub-rays hit a pane of glass at 4 m with a wall behind it at 9 m. Pass 1
        has two rows, the hits on the pane, and the light of both continues. Pass 2 has two rows,
        the hits on the wall, where no light continues. The joined hits have the sub-rays 0, 0, 1, 1
        and the distances 4, 9, 4, 9. Hits on clear glass have no energy and do not become returns.
        """
        cast, rays = self._cast_first(batch)
        first_light = cast.light
        hits_by_pass: list[VisibleHits] = []
        for _ in range(MAX_LEAFY_PASSES if self._leafy else MAX_PASSES):
            surface_hits = self._surface_hits(cast, batch)
            hits_by_pass.append(self._visible_hits(cast.light, surface_hits))
            onward = self._continue(
                cast.light, surface_hits, hits_by_pass[-1], batch.subrays_per_beam
            )
            if onward is None:
                break
            cast = self._cast_again(onward, batch.subray_poses.actor_trajectories)
        return self._join(batch, hits_by_pass, rays, first_light)

    @property
    def _leafy(self) -> bool:
        return self._media is not None and self._media.leafy

    @property
    def _reach_m(self) -> float:
        """Maximum length of a cast ray in meters, or inf if there are crowns.

        A path through a crown ends at the surface on the far side, which can be at any distance.
        """
        return np.inf if self._leafy else self.setup.sensor.max_range_m

    def _draw(self, batch: PulseBatch) -> Draw:
        """Return a function `draw(purpose, ray)` that returns random bits for sub-rays."""

        def draw(purpose: Purpose, ray: Ints) -> NDArray[np.uint64]:
            return raw(self._seed, purpose, *self._random_key(batch, ray))

        return draw

    @staticmethod
    def _random_key(batch: PulseBatch, ray: Ints) -> tuple[Ints, Ints, Ints]:
        """Return the scans, beams and sub-rays of rays, as keys of random numbers."""
        scan, beam = batch.keys.scan_and_number(batch.start + ray // batch.subrays_per_beam)
        return scan, beam, ray % batch.subrays_per_beam

    # -- the first cast ----------------------------------------------------------------------

    def _cast_first(self, batch: PulseBatch) -> tuple[CastLight, Floats]:
        """Cast a batch's sub-rays. Return the light that hits surfaces, and all rays.

        The rays are an array of shape (6, s) with origins and unit directions of all s sub-rays in
        the scene frame, or of shape (3, s) if the origins are not needed. The light has one row for
        each sub-ray that hits a surface.
        """
        poses = batch.subray_poses
        first, stop = batch.window
        nearest_m = self.setup.sensor.min_range_m
        row_count = 6 if self._needs_origins or poses.actor_trajectories else 3
        rays = np.empty((row_count, stop - first))
        hits = self.caster.scan(
            batch.beams,
            poses,
            window=batch.window,
            t_min=nearest_m,
            t_max=self._reach_m,
            out=rays,
        )
        light = self._light_of_rays(hits.ray.astype(np.int64), rays, batch)
        start_m = np.full(len(light.ray), nearest_m)
        return CastLight(light, start_m, hits.distance, hits.triangle), rays

    def _light_of_rays(self, ray: Ints, rays: Floats, batch: PulseBatch) -> LightPaths:
        """Return the light of the sub-rays that hit a surface, as it leaves the sensor.

        `rays` has all sub-rays of the batch (`_cast_first`).
        """
        setup = self.setup
        poses = batch.subray_poses
        directions = rays[-3:].take(ray, axis=1).T
        origins = np.broadcast_to(np.zeros(3), directions.shape)
        if self._needs_origins:
            origins = rays[:3].take(ray, axis=1).T
        count = len(ray)
        times = poses.times(ray)
        light = LightPaths(ray, times, origins, directions, np.ones(count), np.zeros(count))
        media = self._media
        if setup.has_velocities:
            light.range_rate = range_rates_of_origins(poses, ray, origins, directions)
        if setup.has_mirrors:
            light.mirrored = np.zeros(count, np.uint8)
        if setup.porous:
            light.gap_number = uniform(self._seed, GAP, *self._random_key(batch, ray))
        deflected = setup.has_mirrors or (media is not None and media.refracts)
        if batch.subrays_per_beam > 1 and deflected:
            light.mirror_matrices = np.broadcast_to(np.eye(3), (count, 3, 3))
        if media is not None:
            leaf_depths = random_depths(self._draw(batch)(LEAF, ray)) if media.leafy else None
            media_rays = MediaRays(origins, directions, times, poses.actor_trajectories)
            light.in_media = media.initial_state(self.caster, media_rays, leaf_depths)
        return light

    # -- hits --------------------------------------------------------------------------------

    def _surface_hits(self, cast: CastLight, batch: PulseBatch) -> SurfaceHits:
        """Return the hits of light on surfaces, or on leaves in front of the surfaces.

        This advances `cast.light.in_media`, the state of the light in media, to the hits.
        """
        actor_trajectories = batch.subray_poses.actor_trajectories
        light = cast.light
        cast, leaves = self._meet_leaves(cast, batch)
        step_m = cast.step_m
        triangle = cast.triangle
        distance = light.optical_end(step_m)
        color = None
        if self._colored:
            points = light.origins + step_m[:, None] * light.directions
            color = self.surfaces.colors(triangle, points, light.times, actor_trajectories)
        distance, gaps = self._meet_gaps(light, triangle, distance, batch)
        normals, cosines, kinds, energy, film = self.surfaces.illuminate(
            triangle,
            light.directions,
            distance=distance,
            sensor_light=self._sensor_light,
            times=light.times,
            trajectories=actor_trajectories,
            colors=color,
        )
        if leaves is not None and len(leaves.row_indices):
            # Leaves face the light, so that two leaves in a row are never taken for one surface.
            normals[leaves.row_indices] = light.directions[leaves.row_indices]
            energy[leaves.row_indices] = self._leaf_energy(leaves, triangle, distance, color)
        energy *= light.share
        self._vary_reflectances(energy, kinds, light.ray, batch)
        if light.in_media is not None:
            light.in_media.advance(step_m)
            energy *= light.in_media.energy_factor(light.directions, distance)
        return SurfaceHits(
            step_m=step_m,
            triangle=triangle,
            distance=distance,
            color=color,
            normals=normals,
            cosines=cosines,
            kinds=kinds,
            energy=energy,
            film=film,
            leaves=np.zeros(0, np.intp) if leaves is None else leaves.row_indices,
            gaps=gaps,
            velocities=self._velocities(light, step_m, triangle, actor_trajectories),
        )

    def _meet_gaps(
        self, light: LightPaths, triangle: Ints32, distance: Floats, batch: PulseBatch
    ) -> tuple[Floats, Bools | None]:
        """Determine where light passes through gaps, and the depths of the other returns.

        This advances `light.gap_number` to the next surface. Return the optical path lengths of the
        hits in meters, and whether light passes through a gap. The second is None if no surface is
        porous. All arrays have shape (n,).
        """
        if light.gap_number is None:
            return distance, None
        kinds = self.surfaces.kinds(triangle)
        table = self.surfaces.at_wavelength(self._sensor_light.wavelength_nm)
        gap_fraction = table.gap_fraction[kinds]
        gaps = light.gap_number < gap_fraction
        light.gap_number = np.where(
            gaps, light.gap_number / np.maximum(gap_fraction, _TINY), light.gap_number
        )
        spread_m = table.range_spread_m[kinds]
        rows = np.flatnonzero((spread_m > 0) & ~gaps)
        depth_m = normal(self._seed, SPREAD, *self._random_key(batch, light.ray[rows]))
        distance = distance.copy()
        distance[rows] = np.maximum(
            distance[rows] + spread_m[rows] * depth_m, self.setup.sensor.min_range_m
        )
        return distance, gaps

    def _vary_reflectances(
        self, energy: Floats, kinds: Ints32, ray: Ints, batch: PulseBatch
    ) -> None:
        """Multiply energies by random factors if the reflectances of their surfaces have a spread.

        The factors are normally distributed with mean 1, and clipped symmetrically so that they are
        positive. All arrays have shape (n,).
        """
        if not self.setup.has_reflectance_spread:
            return
        table = self.surfaces.at_wavelength(self._sensor_light.wavelength_nm)
        spread = table.reflectance_spread[kinds]
        rows = np.flatnonzero(spread > 0)
        deviation = normal(self._seed, REFLECTANCE, *self._random_key(batch, ray[rows]))
        factors = 1 + spread[rows] * deviation
        energy[rows] *= np.minimum(np.maximum(factors, _MIN_FACTOR), 2 - _MIN_FACTOR)

    def _meet_leaves(self, cast: CastLight, batch: PulseBatch) -> tuple[CastLight, Leaves | None]:
        """Shorten light paths at the leaves that they hit. Return the paths and the leaves.

        The leaves are None without media.
        """
        light = cast.light
        if light.in_media is None:
            return cast, None
        leaves = light.in_media.meet_leaves(
            light.origins,
            light.directions,
            cast.start_m,
            cast.step_m,
            light.ray,
            self._draw(batch),
        )
        step_m = cast.step_m.copy()
        step_m[leaves.row_indices] = cast.start_m[leaves.row_indices] + leaves.meters
        triangle = cast.triangle.copy()
        triangle[leaves.row_indices] = leaves.triangles
        return cast._replace(step_m=step_m, triangle=triangle), leaves

    def _leaf_energy(
        self, leaves: Leaves, triangle: Ints32, distance: Floats, color: UInts32 | None
    ) -> Floats:
        """Return the energies received from leaves.

        `triangle`, `distance` (meters) and `color` belong to all hits (n,), including hits on
        leaves.
        """
        row_indices = leaves.row_indices
        leaf_color = None if color is None else color[row_indices]
        return self.surfaces.energy(
            triangle[row_indices],
            leaves.cosines,
            distance[row_indices],
            self._sensor_light,
            leaf_color,
        )

    def _velocities(
        self,
        light: LightPaths,
        step_m: Floats,
        triangle: Ints32,
        actor_trajectories: ActorTrajectories,
    ) -> Floats:
        """Return the velocities of the surfaces at hits in m/s, or an empty array if not needed."""
        if light.range_rate is None:
            return np.zeros((0, 3))
        return velocities_of_ends(
            self.surfaces,
            actor_trajectories,
            (light.origins, light.directions),
            step_m,
            triangle,
            light.times,
        )

    def _visible_hits(self, light: LightPaths, surface_hits: SurfaceHits) -> VisibleHits:
        """Return the hits that the sensor can see, and masks of the hits at which light continues.

        With media, hits on the surfaces of crowns and hits beyond the sensor's range are omitted.
        """
        materials = self.surfaces.at_wavelength(self._sensor_light.wavelength_nm)
        velocity = None
        if light.range_rate is not None:
            along_ray = dot(surface_hits.velocities.T, light.directions.T)
            velocity = light.range_rate + light.index * along_ray
        cause = None
        mirrored = light.mirrored
        if mirrored is not None:
            cause = np.where(mirrored > 0, np.uint8(GHOST), np.uint8(SURFACE))
        hits = PulseReturns(
            ray=light.ray,
            distance=surface_hits.distance,
            triangle=surface_hits.triangle,
            energy=surface_hits.energy,
            color=surface_hits.color,
            cause=cause,
            velocity=velocity,
        )
        normals = surface_hits.normals
        if light.mirror_matrices is not None:
            normals = rotate_into_frames(normals, light.mirror_matrices)
        transmits = materials.passes[surface_hits.kinds]
        mirrors = np.zeros(len(surface_hits.kinds), np.bool_)
        if mirrored is not None:
            film = False if surface_hits.film is None else surface_hits.film
            smooth = (materials.specular > 0)[surface_hits.kinds] | film
            mirrors = smooth & (mirrored < MAX_REFLECTIONS)
        if light.in_media is None and surface_hits.gaps is None:
            return VisibleHits(hits, normals, transmits, mirrors)
        # Optical path lengths exceed the lengths of the cast rays, and ranges can have a spread.
        in_range = surface_hits.distance <= self.setup.sensor.max_range_m
        passed = materials.leafy[surface_hits.kinds]  # surfaces of crowns reflect no light
        passed[surface_hits.leaves] = False
        if surface_hits.gaps is not None:
            passed |= surface_hits.gaps
            mirrors &= ~surface_hits.gaps
        row_indices = np.flatnonzero(in_range & ~passed)
        return VisibleHits(
            hits.take(row_indices),
            normals[row_indices],
            (transmits | passed) & in_range,
            mirrors & in_range,
        )

    # -- light that continues ----------------------------------------------------------------

    def _continue(
        self,
        light: LightPaths,
        surface_hits: SurfaceHits,
        visible: VisibleHits,
        subrays_per_beam: int,
    ) -> OnwardLight | None:
        """Return the light that surfaces transmit or reflect, or None if there is none.

        Light that is both transmitted and reflected has two rows. Rows are ordered by ring.
        """
        if not self.setup.has_onward_light:
            return None
        transmitted = np.flatnonzero(visible.transmits)
        row_indices = np.concatenate([transmitted, np.flatnonzero(visible.mirrors)])
        if not len(row_indices):
            return None
        reflected = np.arange(len(row_indices)) >= len(transmitted)
        order = order_along_rings(
            light.ray[row_indices] // subrays_per_beam, self.setup.sensor.channels
        )
        row_indices, reflected, fraction = self._divide(
            light, surface_hits, row_indices[order], reflected[order]
        )
        onward = light.take(row_indices)
        onward.share = fraction
        crossings = SurfaceCrossings(
            step_m=surface_hits.step_m[row_indices],
            distance=surface_hits.distance[row_indices],
            triangle=surface_hits.triangle[row_indices],
            normals=surface_hits.normals.T.take(row_indices, axis=-1).T,  # twice as fast as rows
            cosines=surface_hits.cosines[row_indices],
            reflected=reflected,
            velocities=None if light.range_rate is None else surface_hits.velocities[row_indices],
        )
        return self._cross(onward, crossings)

    def _divide(
        self, light: LightPaths, surface_hits: SurfaceHits, row_indices: Indices, reflected: Bools
    ) -> OnwardRows:
        """Compute the fractions of light that surfaces transmit or reflect, and drop faint light.

        `surface_hits` has a row for each row of `light`. `row_indices` (k,) are the rows whose
        light continues. `reflected` (k,) is True for reflected light, and False for transmitted
        light. Both arrays are overwritten.

        Light is dropped only if there are mirrors and no medium refracts. Refraction can increase
        the energy beyond the limit that is computed here.
        """
        from ...casting import surface_loops  # imported here: numba takes half a second to import

        materials = self.surfaces.at_wavelength(self._sensor_light.wavelength_nm)
        bright = None
        if materials.has_textures and surface_hits.color is not None:
            bright = luminance(surface_hits.color[row_indices])
        in_media = light.in_media
        drops_faint = light.mirrored is not None and not (
            in_media is not None and in_media.differentials
        )
        fraction = np.empty(len(row_indices))
        film = np.zeros(0, np.bool_) if surface_hits.film is None else surface_hits.film
        shares = materials.diffuse_reflectances(surface_hits.kinds[row_indices], bright)
        if surface_hits.gaps is not None:  # nothing scatters or reflects light in a gap
            shares = np.where(surface_hits.gaps[row_indices], 0.0, shares)
            film = film & ~surface_hits.gaps if len(film) else film
        count = surface_loops.divide_light(
            row_indices,
            reflected,
            hits=surface_loops.OnwardHits(
                surface_hits.kinds,
                surface_hits.cosines,
                film,
                light.share,
                surface_hits.distance,
            ),
            shares=shares,
            optics=surface_loops.OnwardOptics(
                materials.specular, materials.passes, ~materials.refracts, materials.leafy
            ),
            limits=surface_loops.OnwardLimits(
                self._sensor_light.wet,
                self._brightest,
                self._sensor_light.extinction,
                self._faintest if drops_faint else -1.0,
            ),
            onward_share=fraction,
        )
        return OnwardRows(row_indices[:count], reflected[:count], fraction[:count])

    def _cast_again(self, onward: OnwardLight, actor_trajectories: ActorTrajectories) -> CastLight:
        """Cast light onward from surfaces, and return the light that hits another surface in range.

        With crowns, hits beyond the range are returned too, because there may be leaves before
        them.
        """
        light, start_m, pattern = onward
        max_range_m = self.setup.sensor.max_range_m
        # The travel time of light is neglected: it travels 300 m in a microsecond.
        clock = FiringClock(light.times, np.zeros(1), actor_trajectories)
        poses = CastPoses(np.zeros(3), clock=clock)
        hits = self.caster.scan(pattern, poses, t_max=self._reach_m)
        row_indices = hits.ray
        cast = CastLight(
            light.take(row_indices), start_m[row_indices], hits.distance, hits.triangle
        )
        if self._leafy or max_range_m == np.inf:
            return cast
        in_range = np.flatnonzero(cast.light.optical_end(cast.step_m) <= max_range_m)
        if len(in_range) == len(cast.step_m):
            return cast
        return CastLight(
            cast.light.take(in_range),
            cast.start_m[in_range],
            cast.step_m[in_range],
            cast.triangle[in_range],
        )

    def _join(
        self,
        batch: PulseBatch,
        hits_by_pass: list[VisibleHits],
        rays: Floats,
        first_light: LightPaths,
    ) -> PulseReturns:
        """Combine the hits of all passes, sorted by sub-ray, and store them in the batch.

        `hits_by_pass` has the hits of each pass. This sets `batch.hits`, and `batch.planes` if
        beams have several sub-rays. `rays` has all sub-rays (`_cast_first`), and `first_light` is
        the light of the sub-rays that hit a surface.
        """
        hits = concatenate_returns([visible.hits for visible in hits_by_pass])
        normals = hits_by_pass[0].normals
        if hits_by_pass[1:]:
            order = np.argsort(hits.ray, kind="stable")
            hits = hits.take(order)
            if batch.subrays_per_beam > 1:
                normals = np.concatenate([visible.normals for visible in hits_by_pass])[order]
        batch.hits = hits
        if batch.subrays_per_beam > 1:
            directions = first_light.directions
            # The rows differ from `first_light` after several passes or if hits were omitted.
            if hits_by_pass[1:] or len(hits.ray) != len(first_light.ray):
                directions = rays[-3:].take(hits.ray, axis=1).T
            batch.planes = normals, directions
        return hits

    def _cross(self, light: LightPaths, crossings: SurfaceCrossings) -> OnwardLight:
        """Return the light behind surfaces that transmit or reflect it.

        The new origins are a small distance behind the surfaces, so that the light does not hit
        them again.
        """
        incoming_index = light.index
        deflection = self._deflect(light, crossings)
        outgoing = deflection.directions
        normals = crossings.normals
        mirror_matrices = light.mirror_matrices
        if mirror_matrices is not None:
            normals_as_seen = rotate_into_frames(normals, mirror_matrices)
            reflections = deflection.twice_normals[:, :, None] * normals_as_seen[:, None]
            mirror_matrices = mirror_matrices - reflections
        cosines = np.abs(crossings.cosines)
        in_media = light.in_media
        if in_media is not None:
            in_media.deflect(light.directions, outgoing, normals, deflection.mirrored)
            cosines = np.abs(dot(normals.T, outgoing.T))
        range_rate = _range_rate_behind(light, incoming_index, crossings.velocities, outgoing)
        clear_m = self.caster.clear_m / np.maximum(cosines, 1e-3)
        pattern, origins = _pattern_behind(light, crossings.step_m, clear_m, outgoing)
        optical_m = clear_m if in_media is None else in_media.optical_length(clear_m)
        if in_media is not None:
            in_media.advance(clear_m)
        behind = LightPaths(
            ray=light.ray,
            times=light.times,
            origins=origins,
            directions=pattern.directions,
            share=deflection.share,
            optical_start=crossings.distance + optical_m,
            mirror_matrices=mirror_matrices,
            mirrored=None if light.mirrored is None else light.mirrored + crossings.reflected,
            in_media=in_media,
            range_rate=range_rate,
            gap_number=light.gap_number,
        )
        return OnwardLight(behind, -clear_m, pattern)

    def _deflect(self, light: LightPaths, crossings: SurfaceCrossings) -> Deflection:
        """Return the directions and fractions of light behind surfaces that refract or reflect it.

        This moves the light into the media behind the surfaces.
        """
        outgoing = light.directions
        fraction = light.share
        mirrored = crossings.reflected
        if light.in_media is not None:
            refraction = light.in_media.cross(
                self.surfaces.kinds(crossings.triangle),
                crossings.triangle,
                outgoing,
                crossings.normals,
                crossings.cosines,
                crossings.reflected,
            )
            outgoing = refraction.directions
            fraction = (
                fraction * refraction.shares**2
            )  # light passes on the way out and on the way back
            mirrored = mirrored | refraction.totally_reflected
        twice_normals = 2 * mirrored[:, None] * crossings.normals
        outgoing = outgoing - crossings.cosines[:, None] * twice_normals
        return Deflection(outgoing, fraction, mirrored, twice_normals)


def _range_rate_behind(
    light: LightPaths,
    incoming_index: Floats | float,
    velocities: Floats | None,
    outgoing: Floats,
) -> Floats | None:
    """Return `LightPaths.range_rate` behind moving surfaces that refract or reflect light.

    `light` has the directions in front of the surfaces, and `outgoing` (n, 3) are the directions
    behind them. `velocities` (n, 3) are the velocities of the surfaces in m/s. `incoming_index` is
    the refractive index in front of the surfaces, and `light.index` the index behind them.
    """
    if light.range_rate is None or velocities is None:
        return light.range_rate
    incoming_speed = dot(velocities.T, light.directions.T)
    outgoing_speed = dot(velocities.T, outgoing.T)
    return light.range_rate + incoming_index * incoming_speed - light.index * outgoing_speed


def _pattern_behind(
    light: LightPaths, step_m: Floats, clear_m: Floats, outgoing: Floats
) -> tuple[Pattern, Floats]:
    """Return rays that start `clear_m` beyond the ends of light paths, and their origins.

    The light ends at distances `step_m` (n,) in meters from its origins. `outgoing` (n, 3) are the
    directions of the rays, whose lengths must be close to 1.
    """
    from ...casting import surface_loops

    origins = np.empty((3, len(clear_m)))
    directions = to_writable(outgoing.T)
    surface_loops.start_behind(
        to_writable(light.origins.T),
        to_writable(light.directions.T),
        to_writable(step_m),
        clear_m,
        origins,
        directions,
    )
    return Pattern(directions.T, origins.T), origins.T
