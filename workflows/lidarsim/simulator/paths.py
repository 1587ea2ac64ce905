"""Paths of light: casts sub-rays, and follows their light through glass and off mirrors.

Where a surface does both, or scatters light as well, the light is divided, and each part goes on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern

from ..base.arrays import Bools, Bytes, Floats, Integers, Ints, Ints32, owned
from ..base.vectors import into_axes, products
from ..columns.table import COLOURS
from ..scene.colours import luminance
from ..sensor.noise import Purpose, raw
from ..sensor.weather import FAINTEST
from .doppler import approach, velocities_of_ends
from .media import LightInMedia, Media, Rays, depths
from .motion import Clock, Poses, along_rings
from .returns import GHOST, OF_RETURNS, SURFACE, PulseReturns, joined, selected
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes
from .surfaces import Surfaces, light_of

PASSES_MOST = 16  # surfaces that light passes before it is dropped
LEAFY_PASSES_MOST = 64  # where there are crowns, whose surfaces it passes twice
MIRRORED_MOST = 2  # times that light is mirrored, of which each may divide it


@dataclass
class _Light:
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

    def on(self, rows: Integers) -> _Light:
        """Select that of some sub-rays."""
        return _Light(*selected(vars(self).values(), rows))


class CastStep(PulseStep):
    """Finds where the light of sub-rays returns from."""

    effects = (
        "Ghosts", "Wet ground", "Gaussian and oval beams", "Refraction", "Vegetation",
        "Rays without a return",
    )  # fmt: skip
    writes = *OF_RETURNS, "velocity"
    purposes = Purpose.LEAF, Purpose.WHICH

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        super().__init__(setup, caster, surfaces)
        survey, sensor = setup.survey, setup.sensor
        self._light, self._seed = light_of(survey, sensor), setup.noise.seed
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
        from . import surface_loops  # not before: numba takes half a second to import

        beams, poses, window, each = batch.beams, batch.here, batch.window, batch.each
        surfaces, media = self.surfaces, self._media
        materials = surfaces.at(self._light.wavelength_nm)
        nearest, farthest = self.setup.sensor.min_range_m, self.setup.sensor.max_range_m
        leafy = media is not None and media.leafy
        # How far light goes in a crown depends on its other side, however far that is.
        reach = np.inf if leafy else farthest
        rays = np.empty((6 if self._placed or poses.ways else 3, window[1] - window[0]))
        found = self.caster.scan(beams, poses, window=window, t_min=nearest, t_max=reach, room=rays)
        ray = found.ray.astype(np.int64)
        directions = rays[-3:].take(ray, axis=1).T
        origins = np.broadcast_to(np.zeros(3), directions.shape)
        if self._placed:
            origins = rays[:3].take(ray, axis=1).T
        light = _Light(
            ray, poses.times(ray), origins, directions, np.ones(len(ray)), np.zeros(len(ray))
        )

        def draw(purpose: Purpose, ray: Ints) -> NDArray[np.uint64]:
            scan, number = batch.keys.of(batch.start + ray // each)
            return raw(self._seed, purpose, scan, number, ray % each)

        if self.setup.moving:
            light.range_rate = approach(poses, ray, origins, directions)
        if self.setup.mirroring:
            light.mirrored = np.zeros(len(ray), np.uint8)
        if each > 1 and (self.setup.mirroring or (media is not None and media.bends)):
            light.turns = np.broadcast_to(np.eye(3), (len(ray), 3, 3))
        if media is not None:
            left = depths(draw(Purpose.LEAF, ray)) if leafy else None
            given = Rays(origins, directions, light.times, poses.ways)
            light.within = media.within(self.caster, given, left)
        step, triangle = found.distance, found.triangle
        parts: list[PulseReturns] = []
        seen: list[Floats] = []  # normals as the sensor sees them
        clear = np.full(len(ray), nearest)  # where light is first, metres from the origin
        for _ in range(LEAFY_PASSES_MOST if leafy else PASSES_MOST):
            within, leaves = light.within, np.zeros(0, np.intp)
            if within is not None:
                met = within.meet(light.origins, light.directions, (clear, step), light.ray, draw)
                step, triangle, leaves = step.copy(), triangle.copy(), met.rows
                step[leaves], triangle[leaves] = clear[leaves] + met.metres, met.triangles
            distance = light.before + (step if within is None else within.optical(step))
            colour = None
            if self._coloured:
                points = light.origins + step[:, None] * light.directions
                colour = surfaces.colours(triangle, points, light.times, poses.ways)
            normals, along, kinds, energy, film = surfaces.lit(
                triangle, light.directions, distance, self._light, light.times, poses.ways, colour
            )
            if len(leaves):
                normals[leaves] = light.directions[leaves]  # no leaf continues another
                own = None if colour is None else colour[leaves]
                energy[leaves] = surfaces.energy(
                    triangle[leaves], met.cosines, distance[leaves], self._light, own
                )
            energy *= light.share
            if within is not None:
                within.go(step)
                energy *= within.factor(light.directions, distance)
            velocity, moved = None, np.zeros((0, 3))
            if light.range_rate is not None:
                way = light.origins, light.directions
                moved = velocities_of_ends(surfaces, poses.ways, way, step, triangle, light.times)
                index = 1.0 if within is None else within.index
                velocity = light.range_rate + index * products(moved.T, light.directions.T)
            cause, mirrored = None, light.mirrored
            if mirrored is not None:
                cause = np.where(mirrored > 0, np.uint8(GHOST), np.uint8(SURFACE))
            hits = PulseReturns(light.ray, distance, triangle, energy, colour, cause, velocity)
            turns = light.turns
            looks = normals if turns is None else into_axes(normals, turns)
            goes, mirrors = materials.passes[kinds], np.zeros(len(kinds), np.bool_)
            if mirrored is not None:
                smooth = (materials.specular > 0)[kinds] | (False if film is None else film)
                mirrors = smooth & (mirrored < MIRRORED_MOST)
            if within is not None:  # optical paths are longer than what was cast
                crowns = materials.leafy[kinds]  # whose surfaces send nothing back
                crowns[leaves] = False
                near = distance <= farthest
                goes, mirrors = (goes | crowns) & near, mirrors & near
                there = np.flatnonzero(near & ~crowns)
                hits, looks = hits.take(there), looks[there]
            parts.append(hits)
            seen.append(looks)
            if not self.setup.passing:
                break
            through = np.flatnonzero(goes)
            on = np.concatenate([through, np.flatnonzero(mirrors)])
            if not len(on):
                break
            off = np.arange(len(on)) >= len(through)
            order = along_rings(light.ray[on] // each, self.setup.sensor.channels)
            on, off = on[order], off[order]
            bright = luminance(colour[on]) if materials.textured and colour is not None else None
            seeks = mirrored is not None and not (within is not None and within.differentials)
            share, water = np.empty(len(on)), np.zeros(0, np.bool_) if film is None else film
            count = surface_loops.onward(
                on, off, kinds, along, materials.shares(kinds[on], bright),
                self._light.wet, water, light.share, distance, materials.specular,
                materials.passes, ~materials.refracts, materials.leafy, self._brightest,
                self._light.extinction, self._faintest if seeks else -1.0, share,
            )  # fmt: skip
            on, off, share = on[:count], off[:count], share[:count]
            light = light.on(on)
            light.share = share
            rate = None if light.range_rate is None else moved[on]
            ends = (*selected((step, distance, triangle, normals, along), on), off, rate)
            light, clear, path = self._behind(light, *ends)
            # Light takes no time: it travels 300 m in a microsecond.
            now = Poses(np.zeros(3), clock=Clock(light.times, np.zeros(1), poses.ways))
            found = self.caster.scan(path, now, t_max=reach)
            which, step, triangle = found.ray, found.distance, found.triangle
            light, clear = light.on(which), clear[which]
            if not leafy and farthest < np.inf:
                within = light.within
                end = light.before + (step if within is None else within.optical(step))
                here = np.flatnonzero(end <= farthest)
                if len(here) < len(end):
                    light, clear = light.on(here), clear[here]
                    step, triangle = step[here], triangle[here]
        hits, normals = joined(parts), seen[0]
        if parts[1:]:
            order = np.argsort(hits.ray, kind="stable")
            hits = hits.take(order)
            normals = normals if each == 1 else np.concatenate(seen)[order]
        batch.hits = hits
        if each > 1:
            if parts[1:] or len(hits.ray) != len(ray):  # some light ends beyond the range
                directions = rays[3:].take(hits.ray, axis=1).T
            batch.planes = normals, directions
        return hits

    def _behind(
        self,
        light: _Light,
        step: Floats,
        distance: Floats,
        triangle: Ints32,
        normals: Floats,
        along: Floats,
        off: Bools,
        moved: Floats | None,
    ) -> tuple[_Light, Floats, Pattern]:
        """Take light (n,) through the surfaces at its end, or `off` them.

        Returns it behind them, where the surfaces are from there, metres, at or below 0, and its
        rays.
        `moved` (n, 3) are the velocities of the surfaces: where one bends light, its path grows.
        """
        from . import surface_loops

        cosine, within = np.abs(along), light.within
        share, ahead, mirrors = light.share, light.directions, off
        index = 1.0 if within is None else within.index
        if within is not None:
            kinds = self.surfaces.kinds(triangle)
            ahead, passes, whole = within.cross(kinds, triangle, ahead, normals, along, off)
            share = share * passes**2
            mirrors = mirrors | whole
        mirrored = 2 * mirrors[:, None] * normals
        ahead = ahead - along[:, None] * mirrored
        turns = light.turns
        if turns is not None:
            along_turns = into_axes(normals, turns)
            turns = turns - mirrored[:, :, None] * along_turns[:, None]
        if within is not None:
            within.turn(light.directions, ahead, normals, mirrors)
            cosine = np.abs(products(normals.T, ahead.T))
        range_rate = light.range_rate
        if range_rate is not None and moved is not None:  # a mirror that moves makes it longer, too
            there, back = products(moved.T, light.directions.T), products(moved.T, ahead.T)
            range_rate = (
                range_rate + index * there - (1.0 if within is None else within.index) * back
            )
        away = self.caster.clear_m / np.maximum(cosine, 1e-3)
        starts, ahead = np.empty((3, len(away))), owned(ahead.T)
        given = owned(light.origins.T), owned(light.directions.T), owned(step)
        surface_loops.set_off(*given, away, starts, ahead)
        path = Pattern(ahead.T, starts.T)
        before = distance + (away if within is None else within.optical(away))
        if within is not None:
            within.go(away)
        own = light.ray, light.times, starts.T, path.directions, share, before
        bounces = None if light.mirrored is None else light.mirrored + off
        return _Light(*own, turns, bounces, within, range_rate), -away, path
