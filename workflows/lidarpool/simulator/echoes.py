"""Returns of a pulse: sub-rays, materials, and noise.

Random numbers depend only on scan, ray and return, so the batches do not matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, ScanReturns

from ..columns.table import COLOURS
from ..scene.scene import Scene
from ..sensor import Sensor, Survey
from ..sensor.disc import disc, neighbours
from ..sensor.optics import Mode, spread
from .motion import Clock, Poses, products
from .surfaces import Surfaces, light_of
from .world import World

PATTERN_RAYS = 20_000_000  # sub-rays of a head's period that are kept; 24 bytes each
CHUNK_RAYS = 1 << 18  # sub-rays that are cast at a time
BLOCK_RAYS = 1 << 14  # rays whose sub-rays are made at a time, to fit a cache
PASSES_MOST = 16  # surfaces that light passes before it is dropped
SLOPE = 0.5  # of the distance between neighbouring hits: what the slopes of one surface may miss

Whole = NDArray[np.int64]
Rays = NDArray[np.integer[Any]]
Real = NDArray[np.float64]


class Hits(NamedTuple):
    """Points that light returned from, in the order of rays: arrays (n,)."""

    ray: Whole
    distance: Real
    triangle: NDArray[np.int32]
    energy: Real
    colour: NDArray[np.uint32] | None = None  # packed, see `Surfaces.colours`

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Hits:
        """Select some of them."""
        colour = None if self.colour is None else self.colour[rows]
        own = self.ray[rows], self.distance[rows], self.triangle[rows], self.energy[rows]
        return Hits(*own, colour)


# Normals of the surfaces of some hits, by row, as they are seen in mirrors, and directions of their
# rays: (n, 3) each.
Planes = Callable[[NDArray[np.intp]], tuple[Real, Real]]


def joined(parts: list[Hits]) -> Hits:
    """Concatenate hits."""
    *own, colours = zip(*parts, strict=True)
    colour = None if parts[0].colour is None else np.concatenate(colours)
    return Hits(*map(np.concatenate, own))._replace(colour=colour)


@dataclass(frozen=True)
class Echoes(ScanReturns):
    """Returns in the order of rays and distances, possibly several for a ray."""

    # (k,): received, see `Surfaces.energy`; None if it is that of the rays as reported.
    energy: Real | None
    number: NDArray[np.uint8]  # (k,): among the reported returns of its pulse, from 1
    returns: NDArray[np.uint8]  # (k,): how many these are
    reported: Real  # (k,): distance with noise; `distance` has none
    # (k,): packed, see `Surfaces.colours`; None if they are those of the rays' ends, or not needed.
    colour: NDArray[np.uint32] | None = None
    # (k,): radial velocities, m/s; None if they are those of the rays as reported, or not needed.
    velocity: Real | None = None


@dataclass(frozen=True)
class Keys:
    """Keys of the random numbers of rays."""

    scan: int  # number of the first scan
    begins: Whole  # rays at which scans begin

    def of(self, ray: Rays) -> tuple[Whole, Whole]:
        """Return the scans of rays, and their numbers within them."""
        number = np.searchsorted(self.begins, ray, side="right") - 1
        return self.scan + number, ray - self.begins[number]


class EchoCaster:
    """Casts the scans of a survey: each ray by itself, or with sub-rays, materials and noise."""

    def __init__(self, caster: World, scene: Scene, survey: Survey, surfaces: Surfaces) -> None:
        self._caster, self._survey, self._surfaces = caster, survey, surfaces
        self._noise = survey.noise
        # Whether each ray that hits something has one return.
        several = survey.returns.subrays > 1 or survey.noise.loses
        self._one_each = surfaces.materials.plain and not several
        shown = any(column.name in COLOURS for column in survey.stored_columns)
        self._textured = surfaces.materials.textured
        self._coloured = shown or self._textured
        # Whether its returns are the caster's hits.
        self.plain = self._one_each and not survey.noise.displaces
        # Light continues so far behind a surface, not to hit it again: Embree rounds to a quarter.
        reach = np.float32(np.abs(scene.bounds).max())
        self._clear_m = max(1e-5, 4 * float(np.spacing(reach)))

    def divided(self, sensor: Sensor, pattern: Pattern) -> Pattern | None:
        """Make the sub-rays of a repeated pattern, if they are few and always the same."""
        subrays = self._survey.returns.subrays
        if len(pattern) * subrays > PATTERN_RAYS or self._noise.angle_deg:
            return None
        if subrays == 1:
            return pattern
        keys = Keys(0, np.zeros(1, int))
        return self._beams(self._beam(sensor), pattern, 0, keys, 0, len(pattern))

    def _beam(self, sensor: Sensor) -> Real:
        divergence, _ = self._survey.returns.of(sensor.optics)
        return disc(self._survey.returns.subrays, divergence)

    def scan(
        self,
        sensor: Sensor,
        scan: int,
        pattern: Pattern,
        divided: Pattern | None,
        poses: Poses,
        window: tuple[int, int],
        groups: Whole,
        *,
        tally: bool = True,
    ) -> Echoes:
        """Cast scans from number `scan` on: hits in the sensor's range, counted and thinned out.

        `divided` are sub-rays of the pattern, if they were made before; the others are arguments
        of `RayCaster.scan`, where each group is a scan.
        """
        noise, first, rays = self._noise, window[0], window[1] - window[0]
        keys = Keys(scan, groups)
        if self._one_each:
            if noise.angle_deg:
                beams = self._beams(np.zeros((1, 2)), pattern, first, keys, 0, rays)
                pattern, first = beams, 0
            found = self._once(sensor, pattern, poses, (first, first + rays), groups, tally)
        else:
            _, gap_m = self._survey.returns.of(sensor.optics)
            beam = self._beam(sensor)
            if len(beam) == 1 and not noise.angle_deg:
                divided = pattern
            unit = poses.rays_per_pose or 1
            size = max(1, CHUNK_RAYS // (len(beam) * unit)) * unit
            chunks = []
            for start in range(0, rays, size):
                stop = min(start + size, rays)
                row = (first + start) * len(beam)
                if divided is None:
                    beams, row = self._beams(beam, pattern, first, keys, start, stop), 0
                else:
                    beams = divided
                window = (row, row + (stop - start) * len(beam))
                here = poses.part(start, stop, len(beam))
                hits, planes = self._hits(sensor, beams, here, window)
                returns = separated(hits, gap_m, len(beam), planes)
                returns = returns._replace(ray=start + returns.ray)
                chunks.append(self._reported(returns, keys))
            found = self._kept(joined(chunks), groups, tally)
        if noise.range_m or noise.range_per_m:
            reported = noise.ranges(found.distance, *keys.of(found.ray), found.number)
            found = replace(found, reported=reported)
        return found

    def _beams(
        self, beam: Real, pattern: Pattern, first: int, keys: Keys, start: int, stop: int
    ) -> Pattern:
        """Make the sub-rays of rays `start` to `stop`, with noise of angles, ray by ray."""
        rays = np.arange(start, stop)
        rows = (first + rays) % len(pattern)
        directions = np.empty((len(rays), len(beam), 3))
        for begin in range(0, len(rays), BLOCK_RAYS):
            block = slice(begin, begin + BLOCK_RAYS)
            across, up = beam.T[:, None]
            if self._noise.angle_deg:
                off_across, off_up = self._noise.angles(*keys.of(rays[block]))
                across, up = across + off_across[:, None], up + off_up[:, None]
            directions[block] = spread(pattern.directions[rows[block]], across, up)
        origins = pattern.origins
        if origins is not None:
            origins = np.repeat(origins[rows], len(beam), axis=0)
        return Pattern(directions.reshape(-1, 3), origins)

    def _once(
        self,
        sensor: Sensor,
        pattern: Pattern,
        poses: Poses,
        window: tuple[int, int],
        groups: Whole,
        tally: bool,
    ) -> Echoes:
        """Cast rays with one return each; compute energies only for kept ones, and if needed."""
        found = self._caster.scan(
            pattern,
            poses,
            window=window,
            t_min=sensor.min_range_m,
            t_max=sensor.max_range_m,
            keep_every=self._survey.keep_every,
            groups=groups,
            tally=tally,
        )
        energy = colour = None
        if self._noise.angle_deg:
            origins, directions = poses.rays(pattern, found.ray, window[0])
            times = poses.times(found.ray)
            if self._textured:
                ends = directions * found.distance[:, None]
                ends += origins
                colour = self._surfaces.colours(found.triangle, ends, times, poses.ways)
                del ends  # which takes as much memory as the normals
            normals = self._surfaces.normals(found.triangle, times, poses.ways)
            along = products(normals.T, directions.T)
            energy = self._energy(sensor, found.triangle, np.abs(along), found.distance, colour)
        one = np.ones(len(found), np.uint8)
        return Echoes(
            **vars(found),
            energy=energy,
            number=one,
            returns=one,
            reported=found.distance,
            colour=colour,
        )

    def _energy(
        self,
        sensor: Sensor,
        triangle: NDArray[np.int32],
        cosine: Real,
        distance: Real,
        colour: NDArray[np.uint32] | None,
    ) -> Real:
        light = light_of(self._survey, sensor)
        return self._surfaces.energy(triangle, cosine, distance, light, colour)

    def _hits(
        self, sensor: Sensor, beams: Pattern, poses: Poses, window: tuple[int, int]
    ) -> tuple[Hits, Planes]:
        """Cast sub-rays, and follow the light through glass and off mirrors."""
        surfaces = self._surfaces
        materials = surfaces.at(sensor.optics.wavelength_nm)
        farthest = sensor.max_range_m
        found = self._caster.scan(
            beams, poses, window=window, t_min=sensor.min_range_m, t_max=farthest
        )
        ray, step, triangle = found.ray.astype(np.int64), found.distance, found.triangle
        origins, directions = poses.rays(beams, ray, window[0])
        origins = np.broadcast_to(origins, directions.shape)
        times = poses.times(ray)
        share, before = np.ones(len(ray)), np.zeros(len(ray))
        # What mirrors did to the directions so far: (n, 3, 3), if there are any.
        turns = np.broadcast_to(np.eye(3), (len(ray), 3, 3)) if materials.mirrors.any() else None
        parts: list[Hits] = []
        seen: list[Real] = []  # normals as the sensor sees them
        for _ in range(PASSES_MOST):
            normals = surfaces.normals(triangle, times, poses.ways)
            along = products(normals.T, directions.T)
            distance = before + step
            colour = None
            if self._coloured:
                points = origins + step[:, None] * directions
                colour = surfaces.colours(triangle, points, times, poses.ways)
            energy = share * self._energy(sensor, triangle, np.abs(along), distance, colour)
            parts.append(Hits(ray, distance, triangle, energy, colour))
            seen.append(normals if turns is None else np.einsum("nji,nj->ni", turns, normals))
            rows = surfaces.objects(triangle)
            on = np.flatnonzero(materials.passes[rows] | materials.mirrors[rows])
            if not len(on):
                break
            rows, along, distance, ahead = rows[on], along[on], distance[on], directions[on]
            share = share[on] * materials.goes_on(rows, np.abs(along)) ** 2  # and back again
            ends = origins[on] + step[on, None] * ahead
            mirrored = 2 * materials.mirrors[rows, None] * normals[on]
            ahead = ahead - along[:, None] * mirrored
            if turns is not None:
                turns = turns[on]
                along_turns = np.einsum("ni,nij->nj", normals[on], turns)
                turns = turns - mirrored[:, :, None] * along_turns[:, None]
            away = self._clear_m / np.maximum(np.abs(along), 1e-3)
            light = Pattern(ahead, ends + away[:, None] * ahead)
            # Light takes no time: it travels 300 m in a microsecond.
            now = Poses(np.zeros(3), clock=Clock(times[on], np.zeros(1), poses.ways))
            found = self._caster.scan(light, now, t_max=farthest)
            before = distance + away
            near = before[found.ray] + found.distance <= farthest
            which, step, triangle = found.ray[near], found.distance[near], found.triangle[near]
            ray, share, before = ray[on][which], share[which], before[which]
            times = times[on][which]
            turns = None if turns is None else turns[which]
            directions = light.directions[which]
            origins = light.origins[which]  # type: ignore[index]  # it has some
        hits, normals = joined(parts), seen[0]
        if parts[1:]:
            order = np.argsort(hits.ray, kind="stable")
            hits, normals = hits.take(order), np.concatenate(seen)[order]

        def planes(rows: NDArray[np.intp]) -> tuple[Real, Real]:
            return normals[rows], poses.rays(beams, hits.ray[rows], window[0])[1]

        return hits, planes

    def _tally(self, triangle: NDArray[np.int32]) -> Whole:
        surfaces = self._surfaces
        return np.bincount(surfaces.counter(triangle), minlength=surfaces.counters)

    def _reported(self, returns: Hits, keys: Keys) -> Hits:
        """Select detected returns, and among them those that the mode reports."""
        if self._noise.loses:
            seen = self._noise.detected(returns.energy, *keys.of(returns.ray), numbers(returns.ray))
            returns = returns.take(seen)
        return returns.take(chosen(returns, self._survey.returns.mode))

    def _kept(self, returns: Hits, groups: Whole, tally: bool) -> Echoes:
        """Count the returns of each scan and thin them out."""
        ray = returns.ray
        cuts = np.searchsorted(ray, np.append(groups, np.iinfo(np.int64).max))
        number = numbers(ray)
        each = number + numbers(ray[::-1])[::-1] + 1
        place = np.arange(len(ray)) - np.repeat(cuts[:-1], np.diff(cuts))
        kept = place % self._survey.keep_every == 0
        thinned = returns.take(kept)
        return Echoes(
            ray=thinned.ray.astype(np.uint32),
            distance=thinned.distance,
            triangle=thinned.triangle,
            hits=np.diff(cuts),
            tally=self._tally(returns.triangle) if tally else None,
            instance=np.zeros(len(thinned.ray), np.int32),
            energy=thinned.energy,
            number=np.minimum(number[kept] + 1, 255).astype(np.uint8),
            returns=np.minimum(each[kept], 255).astype(np.uint8),
            reported=thinned.distance,
            colour=thinned.colour,
        )


def numbers(ray: Whole) -> Whole:
    """Count the entries of each ray, which are consecutive, from 0: (n,)."""
    return np.arange(len(ray)) - np.repeat(*_runs(ray))


def _runs(ray: Whole) -> tuple[Whole, Whole]:
    """Find starts and lengths of runs of equal numbers."""
    begins = np.flatnonzero(np.diff(ray, prepend=-1))
    return begins, np.diff(begins, append=len(ray))


def separated(hits: Hits, gap_m: float, each: int = 1, planes: Planes | None = None) -> Hits:
    """Make returns of hits: those of a beam within a distance of the next are one return.

    So are hits of neighbouring sub-rays on one surface, however far apart they are: a beam that
    grazes a road illuminates all of the road between them. A return's energy is the sum over its
    hits, its distance their mean weighted by energy, its triangle and colour those of the
    strongest. Hits without energy are dropped.

    The hits of all sub-rays, `each` of a beam, are in the order of rays; `gap_m` is half of the
    pulse's length. Returns are in the order of beams and distances; their `ray` is the beam.
    """
    rows = np.arange(len(hits.ray))
    some = hits.energy > 0
    if not some.all():
        rows, hits = rows[some], hits.take(some)
    if not len(rows):
        return hits
    beam = hits.ray // each
    begins, counts = _runs(beam)
    width = np.maximum.reduceat(hits.distance, begins) - np.minimum.reduceat(hits.distance, begins)
    new = np.zeros(len(rows), np.bool_)
    new[begins] = True
    # Few beams hit an edge or graze a surface, and only their hits are sorted.
    wide = np.flatnonzero(np.repeat(width > gap_m, counts))
    if len(wide):
        order = np.arange(len(rows))
        order[wide] = wide[np.lexsort((hits.distance[wide], beam[wide]))]
        rows, hits = rows[order], hits.take(order)
        new[1:] |= np.diff(hits.distance) > gap_m
        if planes is not None and each > 1:
            # Of those, the beams that fall into several returns.
            begins, counts = _runs(beam[wide])
            several = np.add.reduceat(new[wide], begins, dtype=np.int64) > 1
            falls = wide[np.repeat(several, counts)]
            if len(falls):
                part, marks = hits.take(falls), new[falls]
                normal, direction = planes(rows[falls])
                new[falls] &= ~_continued(part, marks, gap_m, each, normal, direction)
    begins = np.flatnonzero(new)
    which = np.cumsum(new) - 1
    energy = np.bincount(which, hits.energy).astype(np.float64)
    distance = np.bincount(which, hits.energy * hits.distance) / energy
    strongest = np.flatnonzero(hits.energy == np.maximum.reduceat(hits.energy, begins)[which])
    first = strongest[numbers(which[strongest]) == 0]
    colour = None if hits.colour is None else hits.colour[first]
    return Hits(beam[begins], distance, hits.triangle[first], energy / each, colour)


def _continued(
    hits: Hits, new: NDArray[np.bool_], gap_m: float, each: int, normal: Real, direction: Real
) -> NDArray[np.bool_]:
    """Whether a surface continues from before each hit to behind it: no return begins, (n,).

    Two neighbouring sub-rays hit one surface if the planes through the two hits meet half-way
    between them, within the gap or half of the distance between the hits. The inverse range of a
    plane is linear in the ray's direction, so two hits on one plane always meet, whatever the
    angle; half of the distance allows for rough ground.

    The hits of each beam are sorted by distance; `new` are the returns by distances alone.
    """
    beam = hits.ray // each
    # The hit of each sub-ray, after so many panes of glass: a row for each beam and number of them.
    order = np.argsort(hits.ray, kind="stable")
    panes = np.empty(len(beam), np.int64)
    panes[order] = numbers(hits.ray[order])
    most = int(panes.max()) + 1
    row = (np.cumsum(np.diff(beam, prepend=beam[0]) != 0)) * most + panes
    table = np.full((int(row.max()) + 1, each), -1)
    table[row, hits.ray % each] = np.arange(len(beam))
    one, other = table[:, neighbours(each)].reshape(-1, 2).T
    number = np.cumsum(new)
    pair = (one >= 0) & (other >= 0) & (number[one] != number[other])
    one, other = one[pair], other[pair]
    near = 1 / hits.distance

    def half_way(this: Whole, that: Whole) -> Real:
        """Ranges half-way to another hit, on the plane of the first."""
        plane, looks = normal[this].T, direction.T
        slope = products(plane, looks[:, that]) / products(plane, looks[:, this])
        return np.asarray(2 / (near[this] * np.maximum(1 + slope, 1e-9)))

    step = np.abs(half_way(one, other) - half_way(other, one))
    apart = np.abs(hits.distance[one] - hits.distance[other])
    meet = step <= np.maximum(gap_m, SLOPE * apart)
    low, high = np.sort([one[meet], other[meet]], axis=0)
    begin, end = (np.bincount(hit + 1, minlength=len(beam) + 1) for hit in (low, high))
    return np.asarray(np.cumsum(begin - end)[:-1] > 0)


def chosen(returns: Hits, mode: Mode) -> NDArray[np.bool_]:
    """Whether a mode reports each return: (n,)."""
    ray = returns.ray
    begins, counts = _runs(ray)
    first, last = np.zeros((2, len(ray)), np.bool_)
    first[begins], last[begins + counts - 1] = True, True
    if mode == "all" or len(begins) == len(ray):
        return np.ones(len(ray), np.bool_)
    if mode in ("first", "last"):
        return first if mode == "first" else last
    # The strongest has rank 0; of equally strong ones the nearest.
    rank = np.empty(len(ray), np.int64)
    rank[np.lexsort((-returns.energy, ray))] = np.arange(len(ray)) - np.repeat(begins, counts)
    if mode == "strongest":
        return np.asarray(rank == 0)
    strongest_is_last = np.repeat(rank[last] == 0, counts)
    return np.asarray((rank == 0) | last | ((rank == 1) & strongest_is_last))
