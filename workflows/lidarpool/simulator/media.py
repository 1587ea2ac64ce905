"""Media within closed surfaces: refraction and attenuation, and leaves that light meets by chance.

Directions follow Snell's law, energies Fresnel's equations, Beer and Lambert's law, and the beam's
widening: ray differentials (Igehy 1999) say how large an area a cone of light is at its end. Leaves
are met after an exponentially distributed optical depth (Ross 1981).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern

from ..base.errors import LidarpoolError
from ..scene.scene import Scene
from ..sensor.leaves import brightness, projection
from ..sensor.materials import MaterialTable, fresnel
from ..sensor.optics import any_axes
from .hits import Real, Whole
from .motion import Clock, Poses, products
from .surfaces import Surfaces
from .world import World

DEPTH = 8  # media around a place that are known at most
PROBES_MOST = 256  # surfaces that a search for media around a place passes
LEAF, WHICH = 30, 31  # purposes of random numbers: see `Leaves`
UPWARDS = np.array([0.0123, 0.0345, 0.9993])  # of that search; along no edge of what people model

Bools = NDArray[np.bool_]
Numbers = NDArray[np.int32]
# Random bits of rays for a purpose: (n,).
Draw = Callable[[int, Whole], NDArray[np.uint64]]


@dataclass
class Around:
    """Media around the light of sub-rays, the innermost first: (n, DEPTH) each; -1 for none."""

    objects: Numbers
    triangles: Numbers  # where light came in

    @classmethod
    def none(cls, count: int) -> Around:
        """Make them for light in the air."""
        return cls(*(np.full((count, DEPTH), -1, np.int32) for _ in range(2)))

    def take(self, rows: NDArray[np.intp]) -> Around:
        """Select those of some sub-rays."""
        return Around(self.objects[rows], self.triangles[rows])

    def restore(self, rows: NDArray[np.intp], before: Around) -> None:
        """Undo what happened to some."""
        self.objects[rows], self.triangles[rows] = before.objects[rows], before.triangles[rows]

    def enter(self, rows: NDArray[np.intp], objects: Numbers, triangles: Numbers) -> None:
        """Enter a medium each."""
        for table, new in ((self.objects, objects), (self.triangles, triangles)):
            table[rows, 1:] = table[rows, :-1]
            table[rows, 0] = new

    def surround(self, rows: NDArray[np.intp], objects: Numbers, triangles: Numbers) -> None:
        """Add a medium each around those that are known; nothing where there are too many."""
        place = (self.objects[rows] >= 0).sum(axis=1)
        free = place < DEPTH
        self.objects[rows[free], place[free]] = objects[free]
        self.triangles[rows[free], place[free]] = triangles[free]

    def leave(self, rows: NDArray[np.intp], objects: Numbers) -> Bools:
        """Leave a medium each; returns which were known."""
        same = self.objects[rows] == objects[:, None]
        known = same.any(axis=1)
        rows, place = rows[known], same[known].argmax(axis=1)
        column = np.arange(DEPTH)
        column = column + (column >= place[:, None])
        for table in (self.objects, self.triangles):
            ended = np.pad(table[rows], ((0, 0), (0, 1)), constant_values=-1)
            table[rows] = np.take_along_axis(ended, column, axis=1)
        return known


@dataclass
class Bundle:
    """How the light of sub-rays has been bent and weakened: arrays (n, …)."""

    index: Real  # (n,): refractive index where it is
    first: Real  # (n,): and where it began
    lost: Real  # (n,): optical depth by attenuation, one way
    places: Real  # (n, 2, 3): derivatives of where it is, by its first direction
    ways: Real  # (n, 2, 3): and of where it goes

    @classmethod
    def of(cls, directions: Real, index: Real) -> Bundle:
        """Make those of light that begins."""
        ways = np.stack(any_axes(directions), axis=1)
        none = np.zeros(len(ways))
        return cls(index.copy(), index, none, np.zeros_like(ways), ways)

    def take(self, rows: NDArray[np.intp]) -> Bundle:
        """Select those of some sub-rays."""
        return Bundle(*(getattr(self, field.name)[rows] for field in fields(self)))

    def go(self, step: Real, attenuation: Real) -> None:
        """Go straight on so many metres (n,), where so much is lost, 1/m (n,)."""
        self.places = self.places + step[:, None, None] * self.ways
        self.lost = self.lost + attenuation * step

    def factor(self, directions: Real, distance: Real, extinction: float) -> Real:
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
        return np.asarray(nearer * np.exp(2 * (extinction * distance - self.lost)))

    def turn(
        self, before: Real, after: Real, normals: Real, mirrored: Bools, index: float | Real
    ) -> None:
        """Turn it at flat surfaces, from directions (n, 3) to others, into another index (n,)."""
        along, behind = (_aside(_dots(way, normals)) for way in (before, after))
        # Each ray of a bundle arrives where it meets the plane.
        shift = _dots(self.places, normals[:, None]) / along[:, None]
        self.places = self.places - shift[..., None] * before[:, None]
        ratio = np.where(mirrored, 1.0, self.index / index)
        bend = np.where(mirrored, 2.0, ratio - ratio**2 * along / behind)
        slope = bend[:, None] * _dots(self.ways, normals[:, None])
        self.ways = ratio[:, None, None] * self.ways - slope[..., None] * normals[:, None]
        self.index = np.array(index)


class Media:
    """The media of a scene."""

    def __init__(self, scene: Scene, surfaces: Surfaces, table: MaterialTable) -> None:
        self._surfaces = surfaces
        self.filled = table.leafy | table.refracts  # whether objects hold a medium
        self.leafy = bool(table.leafy.any())
        self.bends = bool(table.refracts.any())
        self._table = table
        # Of no object, which has the number -1, nothing.
        self._area, self._index, self._attenuation = (
            np.append(values, 0.0) for values in (table.leaf_area, table.refractive_index,
                                                  table.attenuation)
        )  # fmt: skip
        self._angle = np.append(table.leaf_angle, 0)
        closed, self._inwards = surfaces.solids
        for number in np.flatnonzero(table.leafy):
            if not closed[number]:
                raise LidarpoolError(
                    f"materials: {scene.all_names[number]!r} has a leaf_area_density, but its "
                    "surface has gaps: give a closed one, such as a box or a sphere."
                )
        # Where sensors may be within media: an actor may be anywhere, and below a sheet is water.
        standing = np.flatnonzero(self.filled[: len(scene.object_bounds)])
        bounds = scene.object_bounds[standing]
        bounds[~closed[standing], 0, 2] = -np.inf
        if self.filled[len(scene.object_bounds) :].any():
            bounds = np.append(bounds, [[[-np.inf] * 3, [np.inf] * 3]], axis=0)
        self._bounds = bounds
        for angle in table.leaf_angles if self.leafy else ():
            projection(angle, np.ones(1))  # makes its table

    def sides(self, objects: Numbers, along: Real) -> Bools:
        """Whether light enters objects, whose normals have the cosines `along` with it: (n,)."""
        return np.asarray((along < 0) != self._inwards[objects])

    def around(
        self, world: World, origins: Real, times: Real, poses: Poses, clear_m: float
    ) -> Around:
        """Find the media around the origins (n, 3) of light, at the times (n,)."""
        found = Around.none(len(origins))
        within = np.zeros(len(origins), np.bool_)
        for low, high in self._bounds:
            within |= ((origins >= low) & (origins <= high)).all(axis=1)
        rows = np.flatnonzero(within)
        if not len(rows):
            return found
        # Most rays start where the one before did.
        new = np.ones(len(rows), np.bool_)
        new[1:] = (np.diff(origins[rows], axis=0) != 0).any(axis=1)
        if poses.ways:
            new[1:] |= np.diff(times[rows]) != 0
        first = rows[new]
        there = self._search(world, origins[first], times[first], poses, clear_m)
        which = np.cumsum(new) - 1
        found.objects[rows], found.triangles[rows] = there.objects[which], there.triangles[which]
        return found

    def _search(
        self, world: World, origins: Real, times: Real, poses: Poses, clear_m: float
    ) -> Around:
        """Look upwards: a medium that light leaves without having entered it is around it."""
        surfaces = self._surfaces
        around, entered = Around.none(len(origins)), Around.none(len(origins))
        up = UPWARDS / np.sqrt((UPWARDS**2).sum())
        rows, away = np.arange(len(origins)), clear_m / up[2]
        for _ in range(PROBES_MOST):
            if not len(rows):
                break
            light = Pattern(np.broadcast_to(up, origins.shape), origins)
            now = Poses(np.zeros(3), clock=Clock(times, np.zeros(1), poses.ways))
            hits = world.scan(light, now)
            rows, times = rows[hits.ray], times[hits.ray]
            origins = origins[hits.ray] + (hits.distance[:, None] + away) * up
            objects = surfaces.objects(hits.triangle)
            normals = surfaces.normals(hits.triangle, times, poses.ways)
            media = self.filled[objects]
            comes = self.sides(objects, products(normals.T, up[:, None])) & media
            entered.enter(rows[comes], objects[comes], hits.triangle[comes])
            goes = np.flatnonzero(media & ~comes)
            known = entered.leave(rows[goes], objects[goes])
            goes = goes[~known]
            around.surround(rows[goes], objects[goes], hits.triangle[goes])
        return around

    # -- refraction --------------------------------------------------------------------------

    def index(self, around: Around) -> Real:
        """Refractive indices of the innermost media that have one: (n,)."""
        indices = self._index[around.objects]
        return _first(indices, indices > 0, 1.0)

    def attenuation(self, around: Around, air: float) -> Real:
        """Extinction there, 1/m: (n,); outside of what refracts that of the air."""
        return _first(self._attenuation[around.objects], self._index[around.objects] > 0, air)

    def behind(
        self, around: Around, objects: Numbers, triangles: Numbers, along: Real
    ) -> Around:
        """Media behind surfaces (n,), which light meets at the cosines `along`."""
        behind = around.take(np.arange(len(objects)))
        enters, filled = self.sides(objects, along), self.filled[objects]
        comes, goes = np.flatnonzero(filled & enters), np.flatnonzero(filled & ~enters)
        behind.enter(comes, objects[comes], triangles[comes])
        behind.leave(goes, objects[goes])
        return behind

    # -- leaves ------------------------------------------------------------------------------

    def density(self, around: Around, directions: Real) -> Real:
        """Optical depth of leaves for each metre, in each medium around light: (n, DEPTH)."""
        density = self._area[around.objects]
        if density.any():
            upright = np.minimum(np.abs(directions[:, 2]), 1)
            for number, angle in enumerate(self._table.leaf_angles):
                crossing = projection(angle, upright)[:, None]
                density *= np.where(self._angle[around.objects] == number, crossing, 1)
        return density

    def bright(self, objects: Numbers, directions: Real) -> Real:
        """Mean cosine between light and the leaves of objects (n,) that it meets: (n,)."""
        upright, out = np.minimum(np.abs(directions[:, 2]), 1), np.ones(len(objects))
        for number, angle in enumerate(self._table.leaf_angles):
            out = np.where(self._angle[objects] == number, brightness(angle, upright), out)
        return out

    def meet(
        self, around: Around, left: Real, directions: Real, length: Real, ray: Whole, draw: Draw
    ) -> tuple[NDArray[np.intp], Real, Numbers, Real]:
        """Find which light (n,) meets a leaf within its next metres (n,).

        `left` (n,) are the optical depths that are left until a leaf; they become less.

        Returns
        -------
        Rows of those (k,), how far they get (k,), triangles where they came in (k,), and mean
        cosines of the leaves (k,).
        """
        each = self.density(around, directions)
        sums = np.cumsum(each, axis=1)
        total = sums[:, -1]
        depth = total * length
        rows = np.flatnonzero(depth > left)
        reached = left[rows] / total[rows]
        left -= depth
        # Where crowns overlap, a leaf is of one in proportion to its density.
        share = (draw(WHICH, ray[rows]) >> np.uint64(11)).astype(np.float64) * 2.0**-53
        place = (sums[rows] <= (share * total[rows])[:, None]).sum(axis=1)
        objects = around.objects[rows, place]
        return rows, reached, around.triangles[rows, place], self.bright(objects, directions[rows])


def refracted(
    directions: Real, normals: Real, along: Real, ratio: Real
) -> tuple[Real, Real, Bools]:
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


def depths(bits: NDArray[np.uint64]) -> Real:
    """Exponentially distributed numbers of mean 1, from random bits: (n,).

    The number of halvings and a table of 32,768 logarithms give the same on every machine.
    """
    share = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    part, halvings = np.frexp(share)
    row = ((part - 0.5) * (2 * len(_LOGS))).astype(np.intp)
    return np.asarray(_LOGS[row] - halvings * float(np.float32(np.log(2))))


_LOGS = -np.log((np.arange(1 << 15) + 0.5) / (1 << 16) + 0.5).astype(np.float32).astype(np.float64)


def _dots(one: Real, other: Real) -> Real:
    """Scalar products along the last axis, in one order of rounding."""
    return np.asarray(
        (one[..., 0] * other[..., 0] + one[..., 1] * other[..., 1]) + one[..., 2] * other[..., 2]
    )


def _aside(cosine: Real) -> Real:
    """Keep cosines away from 0."""
    return np.where(np.abs(cosine) > 1e-9, cosine, 1e-9)


def _first(values: Real, wanted: NDArray[Any], default: float) -> Real:
    """Return the first wanted value of each row, or a default: (n,)."""
    place = wanted.argmax(axis=1)
    rows = np.arange(len(values))
    return np.where(wanted[rows, place], values[rows, place], default)
