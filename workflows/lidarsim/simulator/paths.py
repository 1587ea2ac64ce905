"""Paths of light: casts sub-rays, and follows their light through glass and off mirrors.

Where a surface does both, or scatters light as well, the light is divided, and each part goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern

from ..base.arrays import Bools, Bytes, Floats, Indices, Integers, Ints, Ints32, UInts32, owned
from ..base.vectors import into_axes, products
from ..columns.table import CAUSES, COLOURS
from ..scene.colours import luminance
from ..sensor.random_numbers import Purpose, raw
from ..sensor.weather import FAINTEST
from .actor_trajectories import ActorTrajectories
from .doppler import approach, velocities_of_ends
from .media import CROWN, LEAF, Draw, LightInMedia, Media, Rays, depths
from .motion import CastPoses, Clock, along_rings
from .returns import RETURN_COLUMNS, SURFACE, PulseReturns, joined, selected
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes
from .surfaces import Surfaces, light_of

GHOST = CAUSES.index("ghost")
PASSES_MOST = 16  # surfaces that light passes before it is dropped
LEAFY_PASSES_MOST = 64  # where there are crowns, whose surfaces it passes twice
MIRRORED_MOST = 2  # times that light is mirrored, of which each may divide it


@dataclass
class LightPaths:
    """The light of sub-rays on its way: arrays (n,), vectors (n, 3)."""

    ray: Ints  # number of the sub-ray
    times: Floats
    origins: Floats
    directions: Floats
    share: Floats  # that comes back, but for what the last surface scatters
    before: Floats  # optical path up to the origin
    # What mirrors did to the directions so far, (n, 3, 3), if there are any.
    turns: Floats | None = None
    mirrored: Bytes | None = None  # how many times it was, if there are mirrors
    within: LightInMedia | None = None  # if there are media
    # How fast its optical path grows, m/s, but for the motion of its end, if that is asked for.
    range_rate: Floats | None = None

    def take(self, rows: Integers) -> LightPaths:
        """Return the light of some rows."""
        return LightPaths(*selected(vars(self).values(), rows))

    def optical_end(self, step: Floats) -> Floats:
        """Return the optical paths up to so many metres from the origins: (n,)."""
        return self.before + (step if self.within is None else self.within.optical(step))

    @property
    def index(self) -> Floats | float:
        """Refractive index around the light."""
        return 1.0 if self.within is None else self.within.index


class CastLight(NamedTuple):
    """Light, and the surfaces that end it: arrays (n,)."""

    light: LightPaths
    clear: Floats  # where light is first, metres from the origin
    step: Floats  # where the surface is, metres from the origin
    triangle: Ints32


class MetSurfaces(NamedTuple):
    """How light meets surfaces and leaves: arrays (n,), vectors (n, 3)."""

    step: Floats  # metres from the origin
    triangle: Ints32
    distance: Floats  # optical path
    colour: UInts32 | None
    normals: Floats
    along: Floats  # cosines of the angles between normals and directions, of either sign
    kinds: Ints32  # rows of the table of materials
    energy: Floats  # received
    film: Bools | None  # whether there may be a film of water
    leaves: Indices  # rows where light meets a leaf within a crown
    moved: Floats  # velocities of the surfaces; (0, 3) if they are not asked for


class SeenHits(NamedTuple):
    """Hits that light makes at the surfaces that it meets, and where the light goes on."""

    hits: PulseReturns
    normals: Floats  # (k, 3): of the hits, as the sensor sees them
    passes: Bools  # (n,): whether light goes on through a surface
    mirrors: Bools  # (n,): whether light goes on off a surface


class LightEnds(NamedTuple):
    """Surfaces that light goes through, or off: arrays (n,), vectors (n, 3)."""

    step: Floats  # metres from the origin
    distance: Floats  # optical path
    triangle: Ints32
    normals: Floats
    along: Floats  # cosines of the angles between normals and directions, of either sign
    off: Bools  # whether the light goes off the surface
    moved: Floats | None  # velocities of the surfaces: where one bends light, its path grows


class OnwardLight(NamedTuple):
    """Light behind the surfaces that it met: arrays (n,)."""

    light: LightPaths
    clear: Floats  # where the surfaces are, metres from the origins, at or below 0
    path: Pattern


class CastStep(PulseStep):
    """Finds where the light of sub-rays returns from."""

    role = Role.FRAME
    effects = (
        "Ghosts", "Wet ground", "Gaussian and oval beams", "Refraction", "Vegetation",
        "Rays without a return",
    )  # fmt: skip
    writes = *RETURN_COLUMNS, "velocity"
    causes = (GHOST,)
    purposes = LEAF, CROWN

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        super().__init__(setup, caster, surfaces)
        survey = setup.survey
        sensor = setup.sensor
        self._light = light_of(survey, sensor)
        self._seed = setup.noise.seed
        table = surfaces.at(sensor.optics.wavelength_nm)
        filled = table.leafy.any() or table.refracts.any()
        air = self._light.extinction
        self._media = Media(setup.scene, surfaces, table, air) if filled else None
        # Ghosts that can return less are left out.
        self._faintest = FAINTEST * setup.noise.threshold
        white = np.ones(len(table.reflectance))
        self._brightest = float(table.scattered(np.arange(len(white)), white, white).max())
        shown = any(column.name in COLOURS for column in survey.stored_columns)
        self._coloured = shown or surfaces.materials.textured
        # Whether it matters where rays start, and not only where they go.
        self._placed = self._coloured or setup.moving or setup.passing or self._media is not None

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.several

    @staticmethod
    def added(setup: Setup) -> float:
        """See `PulseStep.added`: ghosts, if all around is there to be mirrored."""
        return MIRRORED_MOST * setup.mirroring

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: sub-rays, more where light goes on or is bent, and returns."""
        subray = 200 if not setup.passing else 1350 if setup.refracting else 650
        casting = (subray + 200 * setup.moving) * sizes.subrays + 30 * sizes.returns
        return Memory(casting=casting, counting=75 * sizes.returns + 40 * sizes.points)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        cast, rays = self._cast_first(batch)
        first_light = cast.light
        parts: list[SeenHits] = []
        for _ in range(LEAFY_PASSES_MOST if self._leafy else PASSES_MOST):
            met = self._meet(cast, batch)
            parts.append(self._see(cast.light, met))
            onward = self._go_on(cast.light, met, parts[-1], batch.each)
            if onward is None:
                break
            cast = self._cast_again(onward, batch.here.ways)
        return self._join(batch, parts, rays, first_light)

    @property
    def _leafy(self) -> bool:
        """Whether there are crowns."""
        return self._media is not None and self._media.leafy

    @property
    def _reach(self) -> float:
        """How far rays are cast, metres.

        How far light goes in a crown depends on the other side of the crown, however far that is.
        """
        return np.inf if self._leafy else self.setup.sensor.max_range_m

    def _draw(self, batch: PulseBatch) -> Draw:
        """Return the function that draws random bits of sub-rays for a purpose."""

        def draw(purpose: Purpose, ray: Ints) -> NDArray[np.uint64]:
            scan, number = batch.keys.scan_and_number(batch.start + ray // batch.each)
            return raw(self._seed, purpose, scan, number, ray % batch.each)

        return draw

    def _cast_first(self, batch: PulseBatch) -> tuple[CastLight, Floats]:
        """Cast the sub-rays of a batch; returns the light that meets something, and all rays.

        The rays are origins, if these matter, and directions, (6, n) or (3, n).
        """
        setup = self.setup
        poses = batch.here
        first, stop = batch.window
        nearest_m = setup.sensor.min_range_m
        rays = np.empty((6 if self._placed or poses.ways else 3, stop - first))
        hits = self.caster.scan(
            batch.beams, poses, window=batch.window, t_min=nearest_m, t_max=self._reach, room=rays
        )
        ray = hits.ray.astype(np.int64)
        directions = rays[-3:].take(ray, axis=1).T
        origins = np.broadcast_to(np.zeros(3), directions.shape)
        if self._placed:
            origins = rays[:3].take(ray, axis=1).T
        count = len(ray)
        times = poses.times(ray)
        light = LightPaths(ray, times, origins, directions, np.ones(count), np.zeros(count))
        media = self._media
        if setup.moving:
            light.range_rate = approach(poses, ray, origins, directions)
        if setup.mirroring:
            light.mirrored = np.zeros(count, np.uint8)
        if batch.each > 1 and (setup.mirroring or (media is not None and media.bends)):
            light.turns = np.broadcast_to(np.eye(3), (count, 3, 3))
        if media is not None:
            left = depths(self._draw(batch)(LEAF, ray)) if media.leafy else None
            media_rays = Rays(origins, directions, times, poses.ways)
            light.within = media.within(self.caster, media_rays, left)
        clear = np.full(count, nearest_m)
        return CastLight(light, clear, hits.distance, hits.triangle), rays

    def _meet(self, cast: CastLight, batch: PulseBatch) -> MetSurfaces:
        """Find how light meets surfaces, or leaves and media before them."""
        surfaces = self.surfaces
        ways = batch.here.ways
        light, clear, step, triangle = cast
        within = light.within
        leaves = np.zeros(0, np.intp)
        if within is not None:
            span = (clear, step)
            met = within.meet(light.origins, light.directions, span, light.ray, self._draw(batch))
            leaves = met.rows
            step = step.copy()
            step[leaves] = clear[leaves] + met.metres
            triangle = triangle.copy()
            triangle[leaves] = met.triangles
        distance = light.optical_end(step)
        colour = None
        if self._coloured:
            points = light.origins + step[:, None] * light.directions
            colour = surfaces.colours(triangle, points, light.times, ways)
        normals, along, kinds, energy, film = surfaces.lit(
            triangle, light.directions, distance, self._light, light.times, ways, colour
        )
        if len(leaves):
            normals[leaves] = light.directions[leaves]  # no leaf continues another
            leaf_colour = None if colour is None else colour[leaves]
            energy[leaves] = surfaces.energy(
                triangle[leaves], met.cosines, distance[leaves], self._light, leaf_colour
            )
        energy *= light.share
        if within is not None:
            within.go(step)
            energy *= within.factor(light.directions, distance)
        moved = np.zeros((0, 3))
        if light.range_rate is not None:
            rays = light.origins, light.directions
            moved = velocities_of_ends(surfaces, ways, rays, step, triangle, light.times)
        return MetSurfaces(
            step, triangle, distance, colour, normals, along, kinds, energy, film, leaves, moved
        )

    def _see(self, light: LightPaths, met: MetSurfaces) -> SeenHits:
        """Return the hits of light at surfaces, and where the light goes on."""
        materials = self.surfaces.at(self._light.wavelength_nm)
        velocity = None
        if light.range_rate is not None:
            velocity = light.range_rate + light.index * products(met.moved.T, light.directions.T)
        cause = None
        mirrored = light.mirrored
        if mirrored is not None:
            cause = np.where(mirrored > 0, np.uint8(GHOST), np.uint8(SURFACE))
        hits = PulseReturns(
            light.ray, met.distance, met.triangle, met.energy, met.colour, cause, velocity
        )
        normals = met.normals if light.turns is None else into_axes(met.normals, light.turns)
        passes = materials.passes[met.kinds]
        mirrors = np.zeros(len(met.kinds), np.bool_)
        if mirrored is not None:
            smooth = (materials.specular > 0)[met.kinds] | (False if met.film is None else met.film)
            mirrors = smooth & (mirrored < MIRRORED_MOST)
        if light.within is None:
            return SeenHits(hits, normals, passes, mirrors)
        crowns = materials.leafy[met.kinds]  # whose surfaces send nothing back
        crowns[met.leaves] = False
        # Optical paths are longer than what was cast.
        in_range = met.distance <= self.setup.sensor.max_range_m
        rows = np.flatnonzero(in_range & ~crowns)
        return SeenHits(
            hits.take(rows), normals[rows], (passes | crowns) & in_range, mirrors & in_range
        )

    def _go_on(
        self, light: LightPaths, met: MetSurfaces, seen: SeenHits, each: int
    ) -> OnwardLight | None:
        """Return the light that goes on through surfaces or off them; None if there is none."""
        from . import surface_loops  # not before: numba takes half a second to import

        if not self.setup.passing:
            return None
        materials = self.surfaces.at(self._light.wavelength_nm)
        through = np.flatnonzero(seen.passes)
        rows = np.concatenate([through, np.flatnonzero(seen.mirrors)])
        if not len(rows):
            return None
        off = np.arange(len(rows)) >= len(through)
        order = along_rings(light.ray[rows] // each, self.setup.sensor.channels)
        rows = rows[order]
        off = off[order]
        bright = None
        if materials.textured and met.colour is not None:
            bright = luminance(met.colour[rows])
        within = light.within
        drops_faint = light.mirrored is not None and not (
            within is not None and within.differentials
        )
        share = np.empty(len(rows))
        film = np.zeros(0, np.bool_) if met.film is None else met.film
        count = surface_loops.onward(
            rows, off, met.kinds, met.along, materials.shares(met.kinds[rows], bright),
            self._light.wet, film, light.share, met.distance, materials.specular,
            materials.passes, ~materials.refracts, materials.leafy, self._brightest,
            self._light.extinction, self._faintest if drops_faint else -1.0, share,
        )  # fmt: skip
        rows = rows[:count]
        onward = light.take(rows)
        onward.share = share[:count]
        moved = None if light.range_rate is None else met.moved[rows]
        ends = LightEnds(
            met.step[rows],
            met.distance[rows],
            met.triangle[rows],
            met.normals.T.take(rows, axis=-1).T,  # twice as fast as by rows
            met.along[rows],
            off[:count],
            moved,
        )
        return self._behind(onward, ends)

    def _cast_again(self, onward: OnwardLight, ways: ActorTrajectories) -> CastLight:
        """Cast the light behind surfaces; returns what meets something in the sensor's range."""
        light, clear, path = onward
        farthest_m = self.setup.sensor.max_range_m
        # Light takes no time: it travels 300 m in a microsecond.
        now = CastPoses(np.zeros(3), clock=Clock(light.times, np.zeros(1), ways))
        hits = self.caster.scan(path, now, t_max=self._reach)
        rows = hits.ray
        cast = CastLight(light.take(rows), clear[rows], hits.distance, hits.triangle)
        if self._leafy or farthest_m == np.inf:
            return cast
        in_range = np.flatnonzero(cast.light.optical_end(cast.step) <= farthest_m)
        if len(in_range) == len(cast.step):
            return cast
        return CastLight(
            cast.light.take(in_range),
            cast.clear[in_range],
            cast.step[in_range],
            cast.triangle[in_range],
        )

    def _join(
        self, batch: PulseBatch, parts: list[SeenHits], rays: Floats, first_light: LightPaths
    ) -> PulseReturns:
        """Leave all hits to the steps behind, in the order of sub-rays, with their planes.

        `rays` are those of all sub-rays, and `first_light` that of the rays that met something.
        """
        hits = joined([part.hits for part in parts])
        normals = parts[0].normals
        if parts[1:]:
            order = np.argsort(hits.ray, kind="stable")
            hits = hits.take(order)
            if batch.each > 1:
                normals = np.concatenate([part.normals for part in parts])[order]
        batch.hits = hits
        if batch.each > 1:
            directions = first_light.directions
            if parts[1:] or len(hits.ray) != len(first_light.ray):  # some ends beyond the range
                directions = rays[-3:].take(hits.ray, axis=1).T
            batch.planes = normals, directions
        return hits

    def _behind(self, light: LightPaths, ends: LightEnds) -> OnwardLight:
        """Take light through the surfaces at its end, or off them."""
        from . import surface_loops

        within = light.within
        normals = ends.normals
        ahead = light.directions
        share = light.share
        mirrors = ends.off
        index = light.index
        if within is not None:
            kinds = self.surfaces.kinds(ends.triangle)
            ahead, transmitted, totally_reflected = within.cross(
                kinds, ends.triangle, ahead, normals, ends.along, ends.off
            )
            share = share * transmitted**2
            mirrors = mirrors | totally_reflected
        mirrored = 2 * mirrors[:, None] * normals
        ahead = ahead - ends.along[:, None] * mirrored
        turns = light.turns
        if turns is not None:
            normals_as_seen = into_axes(normals, turns)
            turns = turns - mirrored[:, :, None] * normals_as_seen[:, None]
        cosine = np.abs(ends.along)
        if within is not None:
            within.turn(light.directions, ahead, normals, mirrors)
            cosine = np.abs(products(normals.T, ahead.T))
        range_rate = light.range_rate
        if range_rate is not None and ends.moved is not None:  # a mirror that moves, too
            arrives = products(ends.moved.T, light.directions.T)
            leaves = products(ends.moved.T, ahead.T)
            range_rate = range_rate + index * arrives - light.index * leaves
        away = self.caster.clear_m / np.maximum(cosine, 1e-3)
        starts = np.empty((3, len(away)))
        units = owned(ahead.T)
        surface_loops.set_off(
            owned(light.origins.T), owned(light.directions.T), owned(ends.step), away, starts, units
        )
        path = Pattern(units.T, starts.T)
        before = ends.distance + (away if within is None else within.optical(away))
        if within is not None:
            within.go(away)
        behind = LightPaths(
            light.ray,
            light.times,
            starts.T,
            path.directions,
            share,
            before,
            turns,
            None if light.mirrored is None else light.mirrored + ends.off,
            within,
            range_rate,
        )
        return OnwardLight(behind, -away, path)
