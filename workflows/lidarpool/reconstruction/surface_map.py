"""The place of a recording: surfels of all that stands, and what the sensor saw of each.

Surfels reach beyond edges, and single points of things that moved are left. The caster decides:
rays of the recording that pass a surfel, although it should have stopped them, count against the
surfel, and rays that end on it count for it. Lost pulses count against it, too.

Windows and black cars return few pulses, and hide what is behind. Where pulses are lost between
returns of the same surface, dark surfels are tried: lost pulses that meet one count for it, and
pulses that return from there or from behind against it.

Surfels overlap, and a ray meets the nearest. So the surface that rays see is above the means of the
points: by 5 to 10 mm on a road. Each surfel is moved until its rays end on it, in the median.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyFloats, Bools, Floats, Integers, Ints
from lidarsim.numerics.even_samples import even_indices
from raybeam import RayCaster

from .alignment import AlignedSweep, AlignedSweeps
from .surfels import Surfels

_ROUNDS = 3  # of casting, leaving surfels out, and moving them
_MAX_SHIFT_M = 0.3  # difference of ranges beyond which a ray moves no surfel
_SHIFT_PRIOR = 1.0  # rays that would leave a surfel where it is
_VOTING_SWEEPS = 40  # of a submap at most, evenly chosen
_ON_SURFEL_M = 0.06  # distance to the plane of a surfel within which a point is on it
_VIEW_CELL_M = 0.5  # edge of the cells in which ranges of points are compared
_CELL_BITS = 21  # of a coordinate of a cell: places repeat every million meters
_CELL_MASK = (1 << _CELL_BITS) - 1
_MAX_VIEW_FACTOR = 1.5  # of the shortest range in a cell, beyond which points are left out
_ON_RAY_M = 0.15  # difference of ranges within which a ray ends on a surfel


class Observations(NamedTuple):
    """Rays of the recording that end on surfels."""

    surfel: Integers  # (k,)
    ring: Integers  # (k,)
    range_m: AnyFloats  # (k,)
    cosine: AnyFloats  # (k,): of the incidence
    intensity: AnyFloats  # (k,): NaN where the recording has none

    @classmethod
    def concatenate(cls, parts: Sequence[Observations]) -> Observations:
        """Join rays at different surfels, which are numbered in turn."""
        counts = [int(part.surfel.max(initial=-1)) + 1 for part in parts]
        starts = np.cumsum(counts) - counts
        shifted = [
            part._replace(surfel=part.surfel + start)
            for part, start in zip(parts, starts, strict=True)
        ]
        return cls(*map(np.concatenate, zip(*shifted, strict=True)))

    def select_surfels(self, chosen: Bools) -> Observations:
        """Return the rays of chosen surfels (m,), which are numbered anew."""
        numbers = (np.cumsum(chosen) - 1).astype(np.int32)
        rays = self.select(chosen[self.surfel])
        return rays._replace(surfel=numbers[rays.surfel])

    def select(self, rays: Bools) -> Observations:
        """Return selected rays."""
        return Observations(
            self.surfel[rays],
            self.ring[rays],
            self.range_m[rays],
            self.cosine[rays],
            self.intensity[rays],
        )


class SurfelHits(NamedTuple):
    """Surfels that the rays of a sweep meet, as arrays of the k rays that meet a surfel."""

    rays: Ints  # (k,): indices of the points of the sweep
    surfel: Ints
    distance_m: Floats  # to the surfel, along the ray
    range_m: Floats  # as recorded
    off_plane_m: Floats  # distance of the recorded point from the plane of the surfel
    cosine: Floats  # of the incidence
    inward: Floats  # cosine between the ray and the normal: negative from the front

    @property
    def ends(self) -> Bools:
        """Mask (k,) of the rays that end on their surfels."""
        near = np.abs(self.distance_m - self.range_m) < _ON_RAY_M
        return np.asarray(near | (self.off_plane_m < _ON_SURFEL_M))


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Surfels, and the caster of rays at these."""

    surfels: Surfels
    caster: RayCaster

    @classmethod
    def from_surfels(cls, surfels: Surfels) -> SurfaceMap:
        """Make the caster of some surfels."""
        return cls(surfels, RayCaster(surfels.mesh.vertices, surfels.mesh.faces))

    def cast(self, sweep: AlignedSweep, chosen: Bools | None = None) -> SurfelHits:
        """Cast the rays of a sweep, or the rays of its points that `chosen` (n,) marks."""
        rows = np.arange(len(sweep.world)) if chosen is None else np.flatnonzero(chosen)
        directions = sweep.world[rows] - sweep.origins[rows]
        ray_hits = self.caster.cast(sweep.origins[rows], directions)
        met = np.flatnonzero(ray_hits.hit)
        surfel = ray_hits.triangle[met].astype(np.int64) // 2
        range_m = np.linalg.norm(directions[met], axis=1)
        normals = self.surfels.normals[surfel]
        offsets = sweep.world[rows[met]] - self.surfels.centers[surfel]
        off_plane_m = np.abs(np.einsum("ij,ij->i", offsets, normals))
        inward = np.einsum("ij,ij->i", directions[met], normals) / range_m
        return SurfelHits(
            rows[met], surfel, ray_hits.distance[met], range_m, off_plane_m, np.abs(inward), inward
        )

    def refine(self, sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> Surfels:
        """Return the surfels without those that more rays contradict than support.

        Each surfel that is not dark moves along its normal to the median of the rays that end on
        it. LidarError if no surfel is left.
        """
        count = len(self.surfels)
        votes = np.zeros(count, np.int64)
        sign = np.where(self.surfels.dark, 1, -1)  # of the votes of lost pulses
        surfel = []
        offset_m = []
        for number in _some(standing):
            sweep, lost = sweeps.read_with_lost(number)
            hits = self.cast(sweep, standing[number])
            ends = hits.ends
            farther_m = hits.range_m - hits.distance_m
            dark = self.surfels.dark[hits.surfel]
            passing = ~ends & (farther_m > _ON_RAY_M)
            votes += np.bincount(hits.surfel[ends & ~dark], minlength=count)
            votes -= np.bincount(
                hits.surfel[np.where(dark, ends | passing, passing)], minlength=count
            )
            votes += sign * np.bincount(self.cast(lost).surfel, minlength=count)
            moving = ~dark & (ends | (np.abs(farther_m) < _MAX_SHIFT_M))
            surfel.append(hits.surfel[moving])
            offset_m.append((farther_m * hits.inward)[moving])
        shifts_m = _shifts(np.concatenate(surfel), np.concatenate(offset_m), count)
        supported = votes >= self.surfels.dark  # a dark surfel needs a pulse that is lost
        if not supported.any():
            raise LidarError(
                f"The sweeps of {sweeps.name} are inconsistent with each other. Check their poses."
            )
        return self.surfels.shift_along_normals(shifts_m).select(supported)

    def observations(self, sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> Observations:
        """Return the rays that end on surfels."""
        parts: list[Observations] = []
        for number in _some(standing):
            sweep = sweeps.read(number)
            hits = self.cast(sweep, standing[number])
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
    sweeps: AlignedSweeps, standing: Mapping[int, Bools], voxel_m: float
) -> SurfaceMap:
    """Build the place of the points that stand, or raise LidarError if too few stand."""
    points, outward, labels = _standing(sweeps, standing)
    if not len(points):
        raise LidarError(
            f"{sweeps.name} contains no stationary points, so the reconstruction is empty."
        )
    name = Path(sweeps.name).name
    gap_rad = sweeps.recorded.gap_rad
    surfels = Surfels.from_points(name, points, outward, voxel_m, gap_rad, labels)
    dark_points, dark_outward = _dark(sweeps, standing)
    if Surfels.are_enough(dark_points, voxel_m):
        dark = Surfels.from_points(name, dark_points, dark_outward, voxel_m, gap_rad)
        surfels = surfels.with_dark(dark)
    for _ in range(_ROUNDS):  # of two trees, the second would take as much memory again
        surfels = SurfaceMap.from_surfels(surfels).refine(sweeps, standing)
    return SurfaceMap.from_surfels(surfels)


def _dark(sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> tuple[Floats, Floats]:
    """Return where lost pulses were lost (n, 3), if surfaces go on in their gaps.

    The second array (n, 3) has the vectors to the sensor.
    """
    positions = []
    outward = []
    for number in _some(standing):
        _, lost = sweeps.read_with_lost(number)
        assert lost.gap_range_m is not None
        known = np.isfinite(lost.gap_range_m)
        vectors = (lost.world - lost.origins)[known]
        vectors *= (lost.gap_range_m[known] / np.linalg.norm(vectors, axis=1))[:, None]
        positions.append(lost.origins[known] + vectors)
        outward.append(-vectors)
    return np.concatenate(positions), np.concatenate(outward)


def _shifts(surfel: Ints, offset_m: Floats, count: int) -> Floats:
    """Return the shifts (count,) of surfels: medians of the offsets (k,) of their rays."""
    shifts_m = np.zeros(count)
    order = np.lexsort((offset_m, surfel))
    surfel = surfel[order]
    offset_m = offset_m[order]
    starts = np.flatnonzero(np.diff(surfel, prepend=-1))
    counts = np.diff(np.append(starts, len(surfel)))
    medians_m = (offset_m[starts + (counts - 1) // 2] + offset_m[starts + counts // 2]) / 2
    shifts_m[surfel[starts]] = medians_m * counts / (counts + _SHIFT_PRIOR)
    return shifts_m


def _some(standing: Mapping[int, Bools]) -> list[int]:
    """Return the numbers of some sweeps, evenly chosen."""
    numbers = np.fromiter(standing, np.int64)
    chosen: list[int] = numbers[even_indices(len(numbers), _VOTING_SWEEPS)].tolist()
    return chosen


def _standing(
    sweeps: AlignedSweeps, standing: Mapping[int, Bools]
) -> tuple[Floats, AnyFloats, Ints | None]:
    """Return the points (n, 3) that stand in the world, with the vectors (n, 3) to the sensor.

    The third array has the labels (n,) of the points, or is None without labels.

    Points that were seen from much closer elsewhere are left out: rays that come from far away are
    far apart, and their errors of direction are large.
    """
    cells, closest_m = _closest(sweeps, standing)
    positions = []
    outward = []
    labels = []
    for number, mask in standing.items():
        sweep = sweeps.read(number)
        rows = np.flatnonzero(mask)
        limit_m = (
            _MAX_VIEW_FACTOR * closest_m[np.searchsorted(cells, _view_cells(sweep.world[rows]))]
        )
        kept = rows[sweep.range_m[rows] <= limit_m]
        positions.append(sweep.world[kept])
        outward.append((sweep.origins[kept] - sweep.world[kept]).astype(np.float32))
        if sweep.labels is not None:
            labels.append(sweep.labels[kept])
    world = np.concatenate(positions)
    # A sweep without points may have no columns.
    labeled = sum(map(len, labels)) == len(world)
    return world, np.concatenate(outward), np.concatenate(labels) if labels and labeled else None


def _closest(sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> tuple[Ints, Floats]:
    """Return cells (c,), ascending, and the shortest range (c,) of the points in each."""
    cells = []
    shortest_m = []
    for number, mask in standing.items():
        sweep = sweeps.read(number)
        found, closest_m = _shortest(_view_cells(sweep.world[mask]), sweep.range_m[mask])
        cells.append(found)
        shortest_m.append(closest_m)
    return _shortest(np.concatenate(cells), np.concatenate(shortest_m))


def _shortest(cells: Ints, range_m: Floats) -> tuple[Ints, Floats]:
    """Return the distinct cells, ascending, and the shortest of the ranges (n,) in each."""
    order = np.lexsort((range_m, cells))
    found, firsts = np.unique(cells[order], return_index=True)
    return found, range_m[order][firsts]


def _view_cells(points: Floats) -> Ints:
    """Return the numbers (n,) of the cells of points, in which ranges are compared."""
    cells = np.floor(points / _VIEW_CELL_M).astype(np.int64) & _CELL_MASK
    return np.asarray((cells[:, 0] << 2 * _CELL_BITS) | (cells[:, 1] << _CELL_BITS) | cells[:, 2])
