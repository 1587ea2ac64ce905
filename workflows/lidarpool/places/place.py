"""The place of a recording: surfels of all that stands, and what the sensor saw of each.

Surfels reach beyond edges, and single points of things that moved are left. The caster decides:
rays of the recording that pass a surfel, although it should have stopped them, count against the
surfel, and rays that end on it count for it. Lost pulses count against it, too: windows and black
cars return few pulses.

Surfels overlap, and a ray meets the nearest. So the surface that rays see is above the means of the
points: by 5 to 10 mm on a road. Each surfel is moved until its rays end on it, in the median.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.even_samples import even_indices
from raybeam import RayCaster

from ..scenario.point_files import ScannedPoints
from ..scenario.point_scene import Voxels
from .alignment import AlignedSweep, AlignedSweeps
from .surfels import Surfels

_ROUNDS = 3  # of casting, leaving surfels out, and moving them
_MAX_SHIFT_M = 0.3  # difference of ranges beyond which a ray moves no surfel
_SHIFT_PRIOR = 1.0  # rays that would leave a surfel where it is
_VOTING_SWEEPS = 48  # at most, evenly chosen
_ON_SURFEL_M = 0.06  # distance to the plane of a surfel within which a point is on it
_VIEW_CELL_M = 0.5  # edge of the cells in which ranges of points are compared
_MAX_VIEW_FACTOR = 1.5  # of the shortest range in a cell, beyond which points are left out
_ON_RAY_M = 0.15  # difference of ranges within which a ray ends on a surfel


class Observations(NamedTuple):
    """Rays of the recording that end on surfels."""

    surfel: Ints  # (k,)
    ring: Ints  # (k,)
    range_m: Floats  # (k,)
    cosine: Floats  # (k,): of the incidence
    intensity: Floats  # (k,): NaN where the recording has none

    def part(self, rays: Bools) -> Observations:
        """Return selected rays."""
        return Observations(
            self.surfel[rays],
            self.ring[rays],
            self.range_m[rays],
            self.cosine[rays],
            self.intensity[rays],
        )


class Seen(NamedTuple):
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
class Place:
    """Surfels, and the caster of rays at these."""

    surfels: Surfels
    caster: RayCaster

    @classmethod
    def of_surfels(cls, surfels: Surfels) -> Place:
        """Make the caster of some surfels."""
        return cls(surfels, RayCaster(surfels.mesh.vertices, surfels.mesh.faces))

    def see(self, sweep: AlignedSweep, chosen: Bools | None = None) -> Seen:
        """Cast the rays of a sweep, or the rays of its points that `chosen` (n,) marks."""
        rows = np.arange(len(sweep.world)) if chosen is None else np.flatnonzero(chosen)
        directions = sweep.world[rows] - sweep.origins[rows]
        hits = self.caster.cast(sweep.origins[rows], directions)
        met = np.flatnonzero(hits.hit)
        surfel = hits.triangle[met].astype(np.int64) // 2
        range_m = np.linalg.norm(directions[met], axis=1)
        normals = self.surfels.normals[surfel]
        offsets = sweep.world[rows[met]] - self.surfels.centres[surfel]
        off_plane_m = np.abs(np.einsum("ij,ij->i", offsets, normals))
        inward = np.einsum("ij,ij->i", directions[met], normals) / range_m
        return Seen(
            rows[met], surfel, hits.distance[met], range_m, off_plane_m, np.abs(inward), inward
        )

    def refined(self, sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> Place:
        """Return the place without surfels that more rays pass, or are lost on, than meet.

        Each surfel moves along its normal to the median of the rays that end on it. LidarError if
        no surfel is left.
        """
        count = len(self.surfels)
        votes = np.zeros(count, np.int64)
        surfel = []
        offset_m = []
        for number in _some(standing):
            sweep, lost = sweeps.read_with_lost(number)
            seen = self.see(sweep, standing[number])
            ends = seen.ends
            farther_m = seen.range_m - seen.distance_m
            votes += np.bincount(seen.surfel[ends], minlength=count)
            votes -= np.bincount(seen.surfel[~ends & (farther_m > _ON_RAY_M)], minlength=count)
            votes -= np.bincount(self.see(lost).surfel, minlength=count)
            moving = ends | (np.abs(farther_m) < _MAX_SHIFT_M)
            surfel.append(seen.surfel[moving])
            offset_m.append((farther_m * seen.inward)[moving])
        shifts_m = _shifts(np.concatenate(surfel), np.concatenate(offset_m), count)
        supported = votes >= 0
        if not supported.any():
            raise LidarError(f"{sweeps.name}: its sweeps contradict each other.")
        return Place.of_surfels(self.surfels.moved(shifts_m).part(supported))

    def observations(self, sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> Observations:
        """Return the rays that end on surfels."""
        parts: list[Observations] = []
        for number in _some(standing):
            sweep = sweeps.read(number)
            seen = self.see(sweep, standing[number])
            ends = seen.ends
            rays = seen.rays[ends]
            parts.append(
                Observations(
                    seen.surfel[ends],
                    sweep.ring[rays],
                    seen.range_m[ends],
                    seen.cosine[ends],
                    np.full(len(rays), np.nan)
                    if sweep.intensities is None
                    else sweep.intensities[rays],
                )
            )
        return Observations(*map(np.concatenate, zip(*parts, strict=True)))


def build_place(sweeps: AlignedSweeps, standing: Mapping[int, Bools], voxel_m: float) -> Place:
    """Build the place of the points that stand, or raise LidarError if too few stand."""
    points = _standing(sweeps, standing)
    if not len(points):
        raise LidarError(f"{sweeps.name} has no points that stand: nothing is left.")
    name = Path(sweeps.name).name
    surfels = Surfels.of_points(name, points, voxel_m, sweeps.recorded.gap_rad)
    place = Place.of_surfels(surfels)
    for _ in range(_ROUNDS):
        place = place.refined(sweeps, standing)
    return place


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


def _standing(sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> ScannedPoints:
    """Return the points that stand in the world, with the directions to the sensor."""
    positions = []
    outward = []
    labels = []
    for number, mask in standing.items():
        sweep = sweeps.read(number)
        positions.append(sweep.world[mask])
        outward.append(sweep.origins[mask] - sweep.world[mask])
        if sweep.labels is not None:
            labels.append(sweep.labels[mask])
    world = np.concatenate(positions)
    # A sweep without points may have no columns.
    labelled = sum(map(len, labels)) == len(world)
    points = ScannedPoints(
        world, np.concatenate(outward), np.concatenate(labels) if labels and labelled else None
    )
    return points.take(_nearest_views(sweeps.name, points))


def _nearest_views(name: str, points: ScannedPoints) -> Ints:
    """Return the indices of points that were not seen from much closer elsewhere.

    Rays that come from far away are far apart, and their errors of direction are large.
    """
    assert points.outward is not None
    range_m = np.linalg.norm(points.outward, axis=1)
    cells = Voxels.of_points(Path(name), points.positions, _VIEW_CELL_M)
    ordered_m = range_m[cells.order]
    closest_m = np.minimum.reduceat(ordered_m, cells.starts).repeat(cells.counts)
    return np.sort(cells.order[ordered_m <= _MAX_VIEW_FACTOR * closest_m])
