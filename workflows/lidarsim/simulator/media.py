"""Media within closed surfaces: refraction and attenuation, and leaves that light meets by chance.

Directions follow Snell's law, energies Fresnel's equations, Beer and Lambert's law, and the beam's
widening: ray differentials (Igehy 1999) say how large an area a cone of light is at its end. Leaves
are met after an exponentially distributed optical depth (Ross 1981).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, any_axes

from ..base.arrays import AnyArray, Bools, Floats, Indices, Integers, Ints, Ints32
from ..base.elementary import exp, log
from ..base.elementary_scalars import log_of
from ..base.errors import LidarError
from ..base.vectors import applied, products
from ..scene.scene import Scene
from ..sensor.leaves import brightness, projection
from ..sensor.materials import MaterialTable, fresnel
from ..sensor.random_numbers import Purpose
from .actor_trajectories import ActorTrajectories
from .motion import CastPoses, Clock
from .returns import selected
from .scene_caster import SceneCaster
from .surfaces import Surfaces

LEAF = Purpose(30, "depth of leaves that light gets through")
CROWN = Purpose(31, "crown of the leaf, of crowns that overlap")
DEPTH = 8  # media around a place that are known at most
PROBES_MOST = 256  # surfaces that a search for media around a place passes
UPWARDS = np.array([0.0123, 0.0345, 0.9993])  # of that search; along no edge of what people model

# Random bits of rays for a purpose: (n,).
Draw = Callable[[Purpose, Ints], NDArray[np.uint64]]


class Rays(NamedTuple):
    """Light of sub-rays that begins, and the trajectories of actors."""

    origins: Floats  # (n, 3)
    directions: Floats  # (n, 3)
    times: Floats  # (n,)
    ways: ActorTrajectories


@dataclass
class MediaStack:
    """Media around the light of sub-rays, the innermost first: (n, DEPTH) each; -1 for none."""

    kinds: Ints32  # of their surfaces
    triangles: Ints32  # where light came in

    @classmethod
    def none(cls, count: int) -> MediaStack:
        """Make them for light in the air."""
        return cls(*(np.full((count, DEPTH), -1, np.int32) for _ in range(2)))

    def __getitem__(self, rows: Integers) -> MediaStack:
        """Select those of some sub-rays."""
        return MediaStack(self.kinds[rows], self.triangles[rows])

    def enter(self, rows: Indices, kinds: Ints32, triangles: Ints32) -> None:
        """Enter a medium each."""
        for table, new in ((self.kinds, kinds), (self.triangles, triangles)):
            table[rows, 1:] = table[rows, :-1]
            table[rows, 0] = new

    def surround(self, rows: Indices, kinds: Ints32, triangles: Ints32) -> None:
        """Add a medium each around those that are known; nothing where there are too many."""
        place = (self.kinds[rows] >= 0).sum(axis=1)
        free = place < DEPTH
        self.kinds[rows[free], place[free]] = kinds[free]
        self.triangles[rows[free], place[free]] = triangles[free]

    def leave(self, rows: Indices, kinds: Ints32) -> Bools:
        """Leave a medium each; returns which were known."""
        same = self.kinds[rows] == kinds[:, None]
        known = same.any(axis=1)
        rows = rows[known]
        place = same[known].argmax(axis=1)
        column = np.arange(DEPTH)
        column = column + (column >= place[:, None])
        for table in (self.kinds, self.triangles):
            ended = np.pad(table[rows], ((0, 0), (0, 1)), constant_values=-1)
            table[rows] = np.take_along_axis(ended, column, axis=1)
        return known


@dataclass
class RayDifferentials:
    """How the light of sub-rays has been bent and weakened: arrays (n, …)."""

    index: Floats  # (n,): refractive index where it is
    first: Floats  # (n,): and where it began
    lost: Floats  # (n,): optical depth by attenuation, one way
    places: Floats  # (n, 2, 3): derivatives of where it is, by its first direction
    ways: Floats  # (n, 2, 3): and of where it goes

    @classmethod
    def of(cls, directions: Floats, index: Floats) -> RayDifferentials:
        """Make those of light that begins."""
        ways = np.stack([axis.T for axis in any_axes(directions.T)], axis=1)
        none = np.zeros(len(ways))
        return cls(index.copy(), index, none, np.zeros_like(ways), ways)

    def __getitem__(self, rows: Integers) -> RayDifferentials:
        """Select those of some sub-rays."""
        return RayDifferentials(*selected(vars(self).values(), rows))

    def go(self, step: Floats, attenuation: Floats) -> None:
        """Go straight on so many metres (n,), where so much is lost, 1/m (n,)."""
        self.places = self.places + step[:, None, None] * self.ways
        self.lost = self.lost + attenuation * step

    def factor(self, directions: Floats, distance: Floats, extinction: float) -> Floats:
        """Energy relative to that of light that went as far, straight through the air: (n,).

        Of light that is scattered at the end of a path, the receiver gets the share that its area
        has of the cone's area there. By reciprocity, that area is that of the cone of the outgoing
        light, times the square of the refractive index.
        """
        one, other = self.places.transpose(1, 2, 0)
        a, b, c = directions.T
        (x, y, z), (u, v, w) = one, other
        area = np.abs((y * w - z * v) * a + (z * u - x * w) * b + (x * v - y * u) * c)
        area *= (self.index / self.first) ** 2
        nearer = distance**2 / np.maximum(area, 1e-12)
        # Where the air takes so much more than the media, its own factor is 0.
        more = np.minimum(2 * (extinction * distance - self.lost), 700.0)
        return np.asarray(nearer * exp(more))

    def turn(
        self, before: Floats, after: Floats, normals: Floats, mirrored: Bools, index: Floats
    ) -> None:
        """Turn it at flat surfaces, from directions (n, 3) to others, into another index (n,)."""
        along, behind = (_aside(products(way.T, normals.T)) for way in (before, after))
        # Each ray of a differentials arrives where it meets the plane.
        shift = applied(self.places, normals) / along[:, None]
        self.places = self.places - shift[..., None] * before[:, None]
        ratio = np.where(mirrored, 1.0, self.index / index)
        bend = np.where(mirrored, 2.0, ratio - ratio**2 * along / behind)
        slope = bend[:, None] * applied(self.ways, normals)
        self.ways = ratio[:, None, None] * self.ways - slope[..., None] * normals[:, None]
        self.index = np.where(mirrored, self.index, index)


class Media:
    """The media of a scene."""

    def __init__(
        self, scene: Scene, surfaces: Surfaces, table: MaterialTable, air: float = 0.0
    ) -> None:
        # its extinction, 1/m
        self._surfaces = surfaces
        self.air = air
        self.filled = table.leafy | table.refracts  # whether surfaces hold a medium
        self.leafy = bool(table.leafy.any())
        self.bends = bool(table.refracts.any())
        self.mirrors = table.refracts & (table.specular > 0)  # and where it is refracted
        self.grids = surfaces.grids
        self.instances = surfaces.instances
        owners = surfaces.material_kinds.object
        self.gridded = np.append(scene.has_voxels[owners], False)
        self._angles = table.leaf_angles
        # Of no surface, which has the number -1, nothing.
        self._area, self._index, self._attenuation = (
            np.append(values, 0.0) for values in (table.leaf_area, table.refractive_index,
                                                  table.attenuation)
        )  # fmt: skip
        self._angle = np.append(table.leaf_angle, 0)
        closed, self._inwards = surfaces.solids
        for number in np.flatnonzero(table.leafy).tolist():
            if not closed[number]:
                raise LidarError(
                    f"materials: {surfaces.material_kinds.describe(number)} has a "
                    "leaf_area_density, but its surface has gaps: give a closed one, such as a box "
                    "or a sphere."
                )
        # Where sensors may be within media: an actor may be anywhere, and below a sheet is water.
        stands = owners < len(scene.object_bounds)
        standing = np.flatnonzero(self.filled & stands)
        bounds = scene.object_bounds[owners[standing]]
        bounds[~closed[standing], 0, 2] = -np.inf
        if self.filled[~stands].any():
            bounds = np.append(bounds, [[[-np.inf] * 3, [np.inf] * 3]], axis=0)
        self._bounds = bounds
        for angle in self._angles if self.leafy else ():
            projection(angle, np.ones(1))  # makes its table

    def sides(self, kinds: Ints32, along: Floats) -> Bools:
        """Whether light enters surfaces, whose normals have the cosines `along` with it: (n,)."""
        return np.asarray((along < 0) != self._inwards[kinds])

    def around(self, caster: SceneCaster, light: Rays) -> MediaStack:
        """Find the media around the origins of light."""
        found = MediaStack.none(len(light.origins))
        within = np.zeros(len(light.origins), np.bool_)
        if not len(within):
            return found
        least = light.origins.min(axis=0)
        most = light.origins.max(axis=0)
        near = ((self._bounds[:, 0] <= most) & (self._bounds[:, 1] >= least)).all(axis=1)
        for low, high in self._bounds[near]:
            within |= ((light.origins >= low) & (light.origins <= high)).all(axis=1)
        rows = np.flatnonzero(within)
        if not len(rows):
            return found
        # Most rays start where the one before did.
        origins = light.origins[rows]
        times = light.times[rows]
        new = np.ones(len(rows), np.bool_)
        new[1:] = (np.diff(origins, axis=0) != 0).any(axis=1) | (np.diff(times) != 0)
        there = self._search(caster, origins[new], times[new], light.ways)
        which = np.cumsum(new) - 1
        found.kinds[rows] = there.kinds[which]
        found.triangles[rows] = there.triangles[which]
        return found

    def _search(
        self, caster: SceneCaster, origins: Floats, times: Floats, ways: ActorTrajectories
    ) -> MediaStack:
        """Look upwards: a medium that light leaves without having entered it is around it."""
        surfaces = self._surfaces
        around = MediaStack.none(len(origins))
        entered = MediaStack.none(len(origins))
        up = UPWARDS / np.sqrt((UPWARDS**2).sum())
        rows = np.arange(len(origins))
        away = caster.clear_m / up[2]
        for _ in range(PROBES_MOST):
            if not len(rows):
                break
            light = Pattern(np.broadcast_to(up, origins.shape), origins)
            now = CastPoses(np.zeros(3), clock=Clock(times, np.zeros(1), ways))
            hits = caster.scan(light, now)
            rows = rows[hits.ray]
            times = times[hits.ray]
            origins = origins[hits.ray] + (hits.distance[:, None] + away) * up
            kinds = surfaces.kinds(hits.triangle)
            normals = surfaces.normals(hits.triangle, times, ways)
            media = self.filled[kinds]
            comes = self.sides(kinds, products(normals.T, up[:, None])) & media
            entered.enter(rows[comes], kinds[comes], hits.triangle[comes])
            goes = np.flatnonzero(media & ~comes)
            known = entered.leave(rows[goes], kinds[goes])
            goes = goes[~known]
            around.surround(rows[goes], kinds[goes], hits.triangle[goes])
        return around

    def within(self, caster: SceneCaster, light: Rays, depths: Floats | None) -> LightInMedia:
        """Return the state of light that begins; `depths` (n,) are those until a leaf."""
        around = self.around(caster, light)
        differentials = (
            RayDifferentials.of(light.directions, self.index(around)) if self.bends else None
        )
        return LightInMedia(self, around, differentials, depths)

    def index(self, around: MediaStack) -> Floats:
        """Refractive indices of the innermost media that have one: (n,)."""
        indices = self._index[around.kinds]
        return _first(indices, indices > 0, 1.0)

    def attenuation(self, around: MediaStack) -> Floats:
        """Extinction there, 1/m: (n,); outside of what refracts that of the air."""
        refracts = self._index[around.kinds] > 0
        return _first(self._attenuation[around.kinds], refracts, self.air)

    def behind(
        self, around: MediaStack, kinds: Ints32, triangles: Ints32, along: Floats
    ) -> MediaStack:
        """Media behind surfaces (n,), which light meets at the cosines `along`."""
        behind = around[np.arange(len(kinds))]
        enters = self.sides(kinds, along)
        filled = self.filled[kinds]
        comes = np.flatnonzero(filled & enters)
        goes = np.flatnonzero(filled & ~enters)
        behind.enter(comes, kinds[comes], triangles[comes])
        behind.leave(goes, kinds[goes])
        return behind

    def density(self, around: MediaStack, upright: Floats) -> Floats:
        """Optical depth of leaves for each metre, in each medium around light: (n, DEPTH)."""
        density = self._area[around.kinds]
        if density.any():
            for number, angle in enumerate(self._angles):
                crossing = projection(angle, upright)[:, None]
                density *= np.where(self._angle[around.kinds] == number, crossing, 1)
        return density

    def bright(self, kinds: Ints32, upright: Floats) -> Floats:
        """Mean cosine between light and the leaves of surfaces (n,) that it meets: (n,)."""
        out = np.ones(len(kinds))
        for number, angle in enumerate(self._angles):
            out = np.where(self._angle[kinds] == number, brightness(angle, upright), out)
        return out


class Leaves(NamedTuple):
    """Leaves that light meets: arrays (k,)."""

    rows: Indices  # of the light
    metres: Floats  # how far it gets
    triangles: Ints32  # where it came into the crown
    cosines: Floats  # mean ones between light and leaves


@dataclass
class LightInMedia:
    """Light on its way through media: those around it, and what they do to it."""

    media: Media
    around: MediaStack
    differentials: RayDifferentials | None  # None if nothing refracts
    left: Floats | None  # (n,): optical depth until a leaf; None if there are none

    def __getitem__(self, rows: Integers) -> LightInMedia:
        """Select that of some sub-rays."""
        return LightInMedia(
            self.media, *selected((self.around, self.differentials, self.left), rows)
        )

    @property
    def index(self) -> Floats | float:
        """Refractive index where it is."""
        return 1.0 if self.differentials is None else self.differentials.index

    def optical(self, step: Floats) -> Floats:
        """Optical paths of so many metres (n,)."""
        return step if self.differentials is None else step * self.differentials.index

    def meet(
        self,
        origins: Floats,
        directions: Floats,
        span: tuple[Floats, Floats],
        ray: Ints,
        draw: Draw,
    ) -> Leaves:
        """Find which light meets a leaf within a span of its way, metres from its origin (n,)."""
        if self.left is None:
            none = np.zeros(0, np.intp)
            return Leaves(none, np.zeros(0), np.zeros(0, np.int32), np.zeros(0))
        upright = np.minimum(np.abs(directions[:, 2]), 1)
        density = self.media.density(self.around, upright)
        length = span[1] - span[0]
        among = None
        if self.media.grids is not None:
            among = self._among_voxels(origins + span[0][:, None] * directions, directions, length,
                                       density)  # fmt: skip
        sums = np.cumsum(density, axis=1)
        total = sums[:, -1]
        depth = total * length
        if among is not None:
            there, far, rest = among
            depth[there] = self.left[there] - rest
        rows = np.flatnonzero(depth > self.left)
        metres = self.left[rows] / total[rows]
        if among is not None:
            ends = np.full(len(depth), np.nan)
            ends[there] = far
            metres = np.where(np.isnan(ends[rows]), metres, ends[rows])
        self.left = self.left - depth
        # Where crowns overlap, a leaf is of one of them in proportion to its density.
        share = (draw(CROWN, ray[rows]) >> np.uint64(11)).astype(np.float64) * 2.0**-53
        place = (sums[rows] <= (share * total[rows])[:, None]).sum(axis=1)
        cosines = self.media.bright(self.around.kinds[rows, place], upright[rows])
        return Leaves(rows, metres, self.around.triangles[rows, place], cosines)

    def _among_voxels(
        self, starts: Floats, directions: Floats, length: Floats, density: Floats
    ) -> tuple[Indices, Floats, Floats]:
        """Take light through grids, and put their optical depths for a metre into `density`.

        Those that it has are for a density of 1. Returns the rows of light in grids, how far it
        gets, and the optical depth that is left then, as of `Grids.through`.
        """
        grids = self.media.grids
        around = self.around
        assert grids is not None and self.left is not None
        gridded = self.media.gridded[around.kinds]
        rows = np.flatnonzero(gridded.any(axis=1))
        gridded = gridded[rows]
        place = np.argsort(~gridded, axis=1, kind="stable")
        place = place[:, : gridded.sum(axis=1).max(initial=1)]
        used = np.take_along_axis(gridded, place, axis=1)
        triangles = np.take_along_axis(around.triangles[rows], place, axis=1)
        which = np.where(used, self.media.instances(triangles), -1)
        crossing = np.take_along_axis(density[rows], place, axis=1)
        own = np.where(gridded, 0, density[rows])
        even = np.cumsum(own, axis=1)[:, -1]
        given = which, starts[rows], directions[rows], crossing, even, length[rows], self.left[rows]
        metres, rest, found = grids.through(*given)
        np.put_along_axis(own, place, np.where(used, found, np.take_along_axis(own, place, 1)), 1)
        density[rows] = own
        return rows, metres, rest

    def go(self, step: Floats) -> None:
        """Go straight on so many metres (n,)."""
        if self.differentials is not None:
            self.differentials.go(step, self.media.attenuation(self.around))

    def factor(self, directions: Floats, distance: Floats) -> Floats | float:
        """Energy relative to that of light that went as far, straight through the air: (n,)."""
        if self.differentials is None:
            return 1.0
        return self.differentials.factor(directions, distance, self.media.air)

    def cross(
        self,
        kinds: Ints32,
        triangles: Ints32,
        directions: Floats,
        normals: Floats,
        along: Floats,
        off: Bools,
    ) -> tuple[Floats, Floats | float, Bools]:
        """Take light through surfaces (n,), which it meets at the cosines `along`, or `off` them.

        Returns
        -------
        Directions behind them (n, 3), shares of light that pass, or are mirrored where light is
        refracted (n,), and whether all is reflected, with directions as if there were no surface.
        """
        before = self.around
        self.around = self.media.behind(self.around, kinds, triangles, along)
        if self.differentials is None:
            return directions, 1.0, np.zeros(len(kinds), np.bool_)
        ratio = self.media.index(self.around) / self.differentials.index
        ahead, passes, whole = refracted(directions, normals, along, ratio)
        stays = whole | off
        self.around.kinds[stays] = before.kinds[stays]
        self.around.triangles[stays] = before.triangles[stays]
        bends = self.media.mirrors[kinds]
        passes = np.where(whole & bends, 0.0, passes)
        passes = np.where(off, np.where(bends, 1 - passes, 1.0), passes)
        return np.where(off[:, None], directions, ahead), passes, whole

    def turn(self, before: Floats, after: Floats, normals: Floats, mirrored: Bools) -> None:
        """Turn the bundles at flat surfaces, from directions (n, 3) to others."""
        if self.differentials is not None:
            self.differentials.turn(before, after, normals, mirrored, self.media.index(self.around))


def refracted(
    directions: Floats, normals: Floats, along: Floats, ratio: Floats
) -> tuple[Floats, Floats, Bools]:
    """Take light through surfaces by Snell's law; `ratio` (n,) is the index behind over before.

    Returns
    -------
    Directions behind them (n, 3), shares of light that pass (n,), and whether all is reflected,
    with directions and shares as if there were no surface.
    """
    steep = np.maximum(np.abs(along), 1e-9)
    inside = 1 - (1 - steep**2) / ratio**2
    bends = ratio != 1
    whole = bends & (inside <= 0)
    bends &= ~whole
    against = np.where(along < 0, 1.0, -1.0)[:, None] * normals
    root = np.sqrt(np.maximum(inside, 0))
    bent = directions / ratio[:, None] + (steep / ratio - root)[:, None] * against
    passes = np.where(bends, 1 - fresnel(steep, ratio), 1.0)
    return np.where(bends[:, None], bent, directions), passes, whole


def depths(bits: NDArray[np.uint64]) -> Floats:
    """Exponentially distributed numbers of mean 1, from random bits: (n,).

    By the number of halvings and a table of 32,768 logarithms, which is fast.
    """
    share = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    part, halvings = np.frexp(share)
    row = ((part - 0.5) * (2 * len(_logs()))).astype(np.intp)
    return np.asarray(_logs()[row] - halvings * float(np.float32(log_of(2.0))))


@cache
def _logs() -> Floats:
    """Logarithms of equal steps from 1/2 to 1, with the sign changed, in single precision."""
    steps = (np.arange(1 << 15) + 0.5) / (1 << 16) + 0.5
    return -log(steps).astype(np.float32).astype(np.float64)


def _aside(cosine: Floats) -> Floats:
    """Keep cosines away from 0."""
    return np.where(np.abs(cosine) > 1e-9, cosine, 1e-9)


def _first(values: Floats, wanted: AnyArray, default: float) -> Floats:
    """Return the first wanted value of each row, or a default: (n,)."""
    place = wanted.argmax(axis=1)
    rows = np.arange(len(values))
    return np.where(wanted[rows, place], values[rows, place], default)
