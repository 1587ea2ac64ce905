"""Build a map of surfels that represents the static surfaces of a recording.

Initial surfels extend beyond edges, and single points on moving objects remain. Ray casting
corrects both. A ray of the recording that passes through a surfel that should have blocked it
counts against the surfel. A ray that ends on a surfel supports it. Lost pulses count against
surfels, too.

At the end, surfels are trimmed at the outlines of objects (`outlines.py`), and the gaps in
vegetation and fences are estimated (`porosity.py`).

Windows and black cars return few pulses, and hide the surfaces behind them. Where pulses are lost
between returns of the same surface, candidates for dark surfels are created. Lost pulses that hit a
candidate support it. Pulses that return from it or from behind it count against it.

Surfels overlap, and a ray hits the nearest one, so the visible surface lies above the mean of the
points, by 5 to 10 mm on a road. Each surfel is therefore moved along its normal until the median of
its rays ends on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, AnyFloats, Bools, Floats, Integers, Ints
from lidarsim.numerics.even_samples import even_indices
from raybeam import RayCaster

from .alignment import AlignedSweep, AlignedSweeps
from .outlines import Extents, crossed_cells
from .porosity import Crossings, Porosity
from .surfels import Surfels
from .voxel_planes import cell_keys, smallest_by_cell

_ROUNDS = 3  # iterations of casting rays, and of removing and moving surfels
_MAX_SHIFT_M = 0.3  # Rays with a larger range difference do not move a surfel.
_SHIFT_PRIOR = 1.0  # weight of the current position of a surfel, in rays
_VOTING_SWEEPS = 40  # maximum number of evenly spaced sweeps per submap that vote
_ON_SURFEL_M = 0.06  # maximum distance between a point on a surfel and its plane
_VIEW_CELL_M = 0.5  # edge length of the cells in which ranges of points are compared
_MAX_VIEW_FACTOR = 1.5  # Points are omitted beyond this multiple of the shortest range in a cell.
_ON_RAY_M = 0.15  # maximum range difference of a ray that ends on a surfel
# Votes of a ray that ends on a surfel. A surfel remains if at least a fifth of its rays end on it,
# because vegetation and the outlines of objects have gaps.
_END_VOTES = 4
# Pulses that are lost at a dark surfel, per pulse that returns from it or from behind it. With a
# lower limit, the surfel would hide more returns at long range than it explains lost pulses.
_MIN_LOST_RATIO = 2
_POROSITY_SWEEPS = 24  # maximum number of sweeps from which gaps are determined
_MAX_CROSSINGS = 6  # maximum number of surfels that a ray crosses
# Distance between an edge and the center of a beam that still returns from it, relative to the
# diameter of the beam.
_BEAM_SHARE = 0.3
_BEHIND_M = 1e-5  # distance behind a surfel from which a ray is cast again, as in simulations


class Observations(NamedTuple):
    """Recorded rays that end on surfels."""

    surfel: Integers  # (k,)
    ring: Integers  # (k,)
    range_m: AnyFloats  # (k,)
    cosine: AnyFloats  # (k,), cosine of the incidence angle
    intensity: AnyFloats  # (k,), NaN if unknown

    @classmethod
    def concatenate(cls, parts: Sequence[Observations]) -> Observations:
        """Concatenate observations of different surfels, renumbering the surfels consecutively."""
        counts = [int(part.surfel.max(initial=-1)) + 1 for part in parts]
        starts = np.cumsum(counts) - counts
        shifted = [
            part._replace(surfel=part.surfel + start)
            for part, start in zip(parts, starts, strict=True)
        ]
        return cls(*map(np.concatenate, zip(*shifted, strict=True)))

    def select_surfels(self, chosen: Bools) -> Observations:
        """Select the rays of some surfels, and renumber these surfels."""
        numbers = (np.cumsum(chosen) - 1).astype(np.int32)
        rays = self.select(chosen[self.surfel])
        return rays._replace(surfel=numbers[rays.surfel])

    def select(self, rays: Bools) -> Observations:
        """Select rays with a mask."""
        return Observations(
            self.surfel[rays],
            self.ring[rays],
            self.range_m[rays],
            self.cosine[rays],
            self.intensity[rays],
        )


class SurfelHits(NamedTuple):
    """Surfels that the rays of a sweep hit. The arrays describe the k rays with a hit."""

    rays: Ints  # indices of the points of the sweep
    surfel: Ints
    distance_m: Floats  # distance to the surfel along the ray
    range_m: Floats  # recorded range
    off_plane_m: Floats  # distance of the recorded point from the plane of the surfel
    cosine: Floats  # cosine of the incidence angle
    inward: Floats  # cosine between the ray and the normal, negative at the front

    @property
    def ends(self) -> Bools:
        """Mask of the rays whose recorded return lies on the surfel that they hit.

        The array has shape (k,).
        """
        near = np.abs(self.farther_m) < _ON_RAY_M
        return np.asarray(near | (self.off_plane_m < _ON_SURFEL_M))

    @property
    def farther_m(self) -> Floats:
        """Distance by which each ray continues behind the surfel, in meters. Shape (k,)."""
        return self.range_m - self.distance_m

    @property
    def passes(self) -> Bools:
        """Mask of the rays that return from behind the surfel. Shape (k,)."""
        return np.asarray(~self.ends & (self.farther_m > _ON_RAY_M))

    @property
    def votes(self) -> Ints:
        """Votes for a surfel that returns pulses, negative for rays that pass through it."""
        return _END_VOTES * self.ends - self.passes.astype(np.int64)

    @property
    def dark_votes(self) -> Ints:
        """Votes for a surfel that returns no pulses, at most 0. Shape (k,)."""
        return -_MIN_LOST_RATIO * (self.ends | self.passes)


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Surfels with a ray caster."""

    surfels: Surfels
    caster: RayCaster
    porosity: Porosity

    @classmethod
    def from_surfels(cls, surfels: Surfels) -> SurfaceMap:
        """Create a map with a ray caster for opaque surfels."""
        caster = RayCaster(surfels.mesh.vertices, surfels.mesh.faces)
        return cls(surfels, caster, Porosity.opaque(len(surfels)))

    def cast(self, sweep: AlignedSweep, chosen: Bools | None = None) -> SurfelHits:
        """Cast the rays of a sweep, or only those that `chosen` marks."""
        rows = np.arange(len(sweep.world)) if chosen is None else np.flatnonzero(chosen)
        directions = sweep.world[rows] - sweep.origins[rows]
        ray_hits = self.caster.cast(sweep.origins[rows], directions)
        met = np.flatnonzero(ray_hits.hit)
        surfel = ray_hits.triangle[met].astype(np.int64) // 2
        return self._hits(sweep, rows[met], surfel, ray_hits.distance[met])

    def cast_likely(self, sweep: AlignedSweep) -> SurfelHits:
        """Cast the rays of a sweep, and return the surfels from which they most likely return."""
        crossings = self.crossings(sweep)
        layer = self.porosity.likely_crossings(crossings, self.surfels.dark)
        rows = np.flatnonzero(crossings.present[:, 0])
        surfel = crossings.surfel[rows, layer[rows]].astype(np.int64)
        distance_m = crossings.distance_m[rows, layer[rows]].astype(np.float64)
        return self._hits(sweep, rows, surfel, distance_m)

    def crossings(self, sweep: AlignedSweep) -> Crossings:
        """Return the surfels that the rays of a sweep cross."""
        return self._crossings(sweep, np.arange(len(sweep.world)), is_whole=True)

    def crossings_to_returns(self, sweep: AlignedSweep, chosen: Bools) -> Crossings:
        """Return the surfels that the rays `chosen` cross up to their returns.

        Surfels farther behind a return than the range tolerance may be missing.
        """
        return self._crossings(sweep, np.flatnonzero(chosen), is_whole=False)

    def _crossings(self, sweep: AlignedSweep, rows: Ints, *, is_whole: bool) -> Crossings:
        """Return the surfels that some rays cross, or only those up to their returns."""
        origins = sweep.origins[rows]
        directions = sweep.world[rows] - origins
        range_m = np.linalg.norm(directions, axis=1)
        directions /= range_m[:, None]
        surfel = np.full((len(rows), _MAX_CROSSINGS), -1, np.int32)
        distance_m = np.full(surfel.shape, np.inf, np.float32)
        cell = np.zeros(surfel.shape, np.uint8)
        stop_m = np.full(len(rows), np.inf) if is_whole else range_m + _ON_RAY_M
        active = np.arange(len(rows))
        start_m = np.zeros(len(rows))
        for layer in range(_MAX_CROSSINGS):
            starts = origins[active] + start_m[:, None] * directions[active]
            hits = self.caster.cast(starts, directions[active])
            met = hits.hit
            active = active[met]
            start_m = start_m[met] + hits.distance[met]
            surfel[active, layer] = hits.triangle[met] // 2
            distance_m[active, layer] = start_m
            points = origins[active] + start_m[:, None] * directions[active]
            cell[active, layer] = crossed_cells(self.surfels, surfel[active, layer], points)
            start_m += _BEHIND_M
            reached = start_m < stop_m[active]
            active, start_m = active[reached], start_m[reached]
        return Crossings(surfel, distance_m, cell, range_m)

    def _hits(
        self, sweep: AlignedSweep, rows: Ints, surfel: Ints, distance_m: Floats
    ) -> SurfelHits:
        """Return the given hits with their recorded ranges and incidence angles."""
        directions = sweep.world[rows] - sweep.origins[rows]
        range_m = np.linalg.norm(directions, axis=1)
        normals = self.surfels.normals[surfel]
        offsets = sweep.world[rows] - self.surfels.centers[surfel]
        off_plane_m = np.abs(np.einsum("ij,ij->i", offsets, normals))
        inward = np.einsum("ij,ij->i", directions, normals) / range_m
        return SurfelHits(rows, surfel, distance_m, range_m, off_plane_m, np.abs(inward), inward)

    def trimmed(
        self, sweeps: AlignedSweeps, stationary: Mapping[int, Bools], beam_rad: float
    ) -> SurfaceMap:
        """Trim the surfels at outlines and estimate their gaps, from the rays of several sweeps.

        Beams with a divergence return from an object even if their centers miss it. The surfels are
        trimmed such that beams with the divergence `beam_rad` in radians have the recorded returns.
        """
        crossings = []
        lost_crossings = []
        for number in _evenly_chosen(stationary, _POROSITY_SWEEPS):
            sweep, lost = sweeps.read_with_lost(number)
            crossings.append(self.crossings_to_returns(sweep, stationary[number]))
            lost_crossings.append(self.crossings(lost).as_lost())
        dark = self.surfels.dark
        extents = Extents.from_crossings([*crossings, *lost_crossings], dark, _ON_RAY_M)
        inset_m = _BEAM_SHARE * beam_rad * _mean_ranges(crossings, len(dark))
        surfels = extents.trim(self.surfels, inset_m)
        crossings = [extents.crossings(one) for one in crossings]
        porosity = Porosity.from_crossings(crossings, surfels.centers, dark, _ON_RAY_M)
        return replace(SurfaceMap.from_surfels(surfels), porosity=porosity)

    def refine(self, sweeps: AlignedSweeps, stationary: Mapping[int, Bools]) -> Surfels:
        """Remove surfels that more rays contradict than support, and adjust the other surfels.

        A ray that contradicts a dark surfel counts `_MIN_LOST_RATIO` times. Each surfel that is not
        dark moves along its normal to the median of the rays that end on it.

        Raises
        ------
        LidarError
            If no surfel remains.
        """
        count = len(self.surfels)
        votes = np.zeros(count, np.int64)
        sign = np.where(self.surfels.dark, 1, -1)  # sign of the votes of lost pulses
        surfel = []
        offset_m = []
        for number in _evenly_chosen(stationary):
            sweep, lost = sweeps.read_with_lost(number)
            hits = self.cast(sweep, stationary[number])
            dark = self.surfels.dark[hits.surfel]
            np.add.at(votes, hits.surfel, np.where(dark, hits.dark_votes, hits.votes))
            votes += sign * np.bincount(self.cast(lost).surfel, minlength=count)
            moving = ~dark & (hits.ends | (np.abs(hits.farther_m) < _MAX_SHIFT_M))
            surfel.append(hits.surfel[moving])
            offset_m.append((hits.farther_m * hits.inward)[moving])
        shifts_m = median_shifts(np.concatenate(surfel), np.concatenate(offset_m), count)
        supported = votes >= self.surfels.dark  # a dark surfel requires at least one lost pulse
        if not supported.any():
            raise LidarError(
                f"The sweeps of {sweeps.name} are inconsistent with each other. Check their poses."
            )
        return self.surfels.shift_along_normals(shifts_m).select(supported)

    def observations(self, sweeps: AlignedSweeps, stationary: Mapping[int, Bools]) -> Observations:
        """Return the rays that end on surfels, excluding surfels that return no pulses."""
        parts: list[Observations] = []
        for number in _evenly_chosen(stationary):
            sweep = sweeps.read(number)
            hits = self.cast(sweep, stationary[number])
            ends = hits.ends & ~self.surfels.dark[hits.surfel]
            rays = hits.rays[ends]
            parts.append(
                Observations(
                    hits.surfel[ends].astype(np.int32),
                    sweep.ring[rays].astype(np.int32),
                    hits.range_m[ends].astype(np.float32),
                    hits.cosine[ends].astype(np.float32),
                    np.full(len(rays), np.nan, np.float32)
                    if sweep.intensities is None
                    else sweep.intensities[rays].astype(np.float32),
                )
            )
        return Observations(*map(np.concatenate, zip(*parts, strict=True)))


def build_surface_map(
    sweeps: AlignedSweeps,
    stationary: Mapping[int, Bools],
    voxel_m: float,
    beam_rad: float = 0.0,
) -> SurfaceMap:
    """Build a surface map from the stationary points.

    The map has the recorded returns if it is simulated with beams of the divergence `beam_rad` in
    radians, 0 for thin rays.

    Raises
    ------
    LidarError
        If there are too few stationary points.
    """
    points, outward, labels = _stationary_points(sweeps, stationary)
    if not len(points):
        raise LidarError(
            f"{sweeps.name} contains no stationary points, so the reconstruction is empty."
        )
    name = Path(sweeps.name).name
    gap_rad = sweeps.recorded.gap_rad
    surfels = Surfels.from_points(name, points, outward, voxel_m, gap_rad, labels)
    del points, outward, labels  # before other arrays are created, to save memory
    dark_points, dark_outward = _lost_positions(sweeps, stationary)
    if Surfels.are_enough(dark_points, voxel_m):
        dark = Surfels.from_points(name, dark_points, dark_outward, voxel_m, gap_rad)
        surfels = surfels.with_dark(dark)
    for _ in range(_ROUNDS):  # Keep only one ray caster at a time, to save memory.
        surfels = SurfaceMap.from_surfels(surfels).refine(sweeps, stationary)
    return SurfaceMap.from_surfels(surfels).trimmed(sweeps, stationary, beam_rad)


def _mean_ranges(sweeps: Sequence[Crossings], count: int) -> Floats:
    """Return the mean range in meters at which rays cross each of `count` surfels, or 0."""
    total_m, rays = np.zeros((2, count))
    for one in sweeps:
        surfel = one.surfel[one.present]
        total_m += np.bincount(surfel, one.distance_m[one.present], count)
        rays += np.bincount(surfel, minlength=count)
    return np.asarray(total_m / np.maximum(rays, 1))


def _lost_positions(
    sweeps: AlignedSweeps, stationary: Mapping[int, Bools]
) -> tuple[Floats, Floats]:
    """Estimate the positions at which pulses were lost, from gaps within surfaces.

    Return the positions and the vectors to the sensor, both of shape (n, 3).
    """
    positions = []
    outward = []
    for number in _evenly_chosen(stationary):
        _, lost = sweeps.read_with_lost(number)
        assert lost.gap_range_m is not None
        known = np.isfinite(lost.gap_range_m)
        vectors = (lost.world - lost.origins)[known]
        vectors *= (lost.gap_range_m[known] / np.linalg.norm(vectors, axis=1))[:, None]
        positions.append(lost.origins[known] + vectors)
        outward.append(-vectors)
    return np.concatenate(positions), np.concatenate(outward)


def median_shifts(surfel: Ints, offset_m: Floats, count: int) -> Floats:
    """Return how far to shift each surfel, using the median of the offsets of its rays.

    The shift is reduced for surfels with few rays.
    """
    shifts_m = np.zeros(count)
    order = np.lexsort((offset_m, surfel))
    surfel = surfel[order]
    offset_m = offset_m[order]
    starts = np.flatnonzero(np.diff(surfel, prepend=-1))
    counts = np.diff(np.append(starts, len(surfel)))
    medians_m = (offset_m[starts + (counts - 1) // 2] + offset_m[starts + counts // 2]) / 2
    shifts_m[surfel[starts]] = medians_m * counts / (counts + _SHIFT_PRIOR)
    return shifts_m


def _evenly_chosen(stationary: Mapping[int, Bools], count: int = _VOTING_SWEEPS) -> list[int]:
    numbers = np.fromiter(stationary, np.int64)
    chosen: list[int] = numbers[even_indices(len(numbers), count)].tolist()
    return chosen


def _stationary_points(
    sweeps: AlignedSweeps, stationary: Mapping[int, Bools]
) -> tuple[Floats, AnyFloats, Ints | None]:
    """Return the stationary points in world coordinates.

    The other arrays are the vectors to the sensor and the labels, which are None if there are none.
    Points that were observed from a much shorter range elsewhere are omitted. Rays from a long
    range are far apart, and their angular errors cause large position errors.
    """
    cells, closest_m = _closest_ranges(sweeps, stationary)
    positions = []
    outward = []
    labels = []
    for number, mask in stationary.items():
        sweep = sweeps.read(number)
        rows = np.flatnonzero(mask)
        occupied = cell_keys(sweep.world[rows], _VIEW_CELL_M)
        limit_m = _MAX_VIEW_FACTOR * closest_m[np.searchsorted(cells, occupied)]
        kept = rows[sweep.range_m[rows] <= limit_m]
        positions.append(sweep.world[kept])
        outward.append((sweep.origins[kept] - sweep.world[kept]).astype(np.float32))
        if sweep.labels is not None:
            labels.append(sweep.labels[kept])
    world = _join(positions)
    # A sweep without points may lack columns.
    labeled = sum(map(len, labels)) == len(world)
    return world, _join(outward), _join(labels) if labels and labeled else None


def _join(parts: list[AnyArray]) -> AnyArray:
    """Concatenate arrays and empty the list, so that only one copy is in memory."""
    joined = np.empty((sum(map(len, parts)), *parts[0].shape[1:]), parts[0].dtype)
    stop = len(joined)
    while parts:
        part = parts.pop()
        joined[stop - len(part) : stop] = part
        stop -= len(part)
    return joined


def _closest_ranges(sweeps: AlignedSweeps, stationary: Mapping[int, Bools]) -> tuple[Ints, Floats]:
    """Return the occupied cells in ascending order, and the shortest range in each of them."""
    cells = []
    shortest_m = []
    for number, mask in stationary.items():
        sweep = sweeps.read(number)
        occupied = cell_keys(sweep.world[mask], _VIEW_CELL_M)
        found, closest_m = smallest_by_cell(occupied, sweep.range_m[mask])
        cells.append(found)
        shortest_m.append(closest_m)
    return smallest_by_cell(np.concatenate(cells), np.concatenate(shortest_m))
