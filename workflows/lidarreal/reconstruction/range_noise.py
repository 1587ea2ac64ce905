"""Estimate the range noise of a sensor from neighboring returns on planes.

The residuals between recorded ranges and the reconstructed surfaces contain the errors of the map,
of the poses and of the calibration, which are often larger than the noise. These errors hardly
differ between neighboring pulses of a ring. The noise is therefore determined from how far each
range deviates from the ranges of the two neighboring pulses. On a plane, the inverse range is a
constant plus a sine of the azimuth.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats, Ints

from ..scan_patterns.lasers import RingLasers
from .alignment import AlignedSweep, AlignedSweeps
from .voxel_planes import VoxelPlanes

_MIN_COUNT = 200  # minimum number of deviations for an estimate
_STEPS = (0.5, 1.5)  # limits of the azimuth difference between neighbors, in steps
_MAX_VOXELS = 1.5  # maximum distance between a point and the center of its plane, in voxels
_MAX_SIGMAS = 4.0  # maximum distance between a point and its plane, in standard deviations
_MIN_PARALLEL = 0.95  # minimum cosine between the planes of neighbors
_MIN_COSINE = 0.5  # minimum cosine of incidence, because of errors of the azimuths
_MIN_RANGE_M = 0.5
_RANGES_M = (0, 5, 10, 20, 40, np.inf)  # boundaries of the range classes


class RangeNoise(NamedTuple):
    """Range noise of a sensor, as standard deviations in meters."""

    range_m: float
    by_ring_m: Floats  # (r,), NaN if there are too few deviations
    by_range_m: Floats  # for the range classes, NaN if there are too few deviations
    deviations: int  # number of deviations that were used

    def figures(self) -> dict[str, Any]:
        """Return the noise as a dictionary for the report."""
        classes = [
            {"from_m": low, "to_m": None if np.isinf(high) else high, "sigma_m": sigma_m}
            for (low, high), sigma_m in zip(
                pairwise(_RANGES_M), _known(self.by_range_m), strict=True
            )
        ]
        return {
            "sigma_m": round(self.range_m, 5),
            "deviations": self.deviations,
            "by_range": [row for row in classes if row["sigma_m"] is not None],
            "by_ring": _known(self.by_ring_m),
        }


class _Deviations(NamedTuple):
    """Deviations of ranges from those of the neighboring pulses, scaled to the range noise."""

    deviation_m: Floats  # (k,)
    ring: Ints  # (k,)
    range_m: Floats  # (k,)
    is_frontal: Bools  # (k,)

    def frontal(self) -> _Deviations:
        """Select the deviations on surfaces that are hardly inclined to the beams."""
        chosen = self.is_frontal
        return _Deviations(
            self.deviation_m[chosen], self.ring[chosen], self.range_m[chosen], chosen[chosen]
        )


def estimate_range_noise(sweeps: AlignedSweeps, numbers: Sequence[int]) -> RangeNoise | None:
    """Estimate the range noise of a sensor with rings from several sweeps.

    Return None if there are too few neighboring returns on planes.

    Raises
    ------
    LidarError
        If the recording cannot be read, or if its points are too far apart.
    """
    aligned = [sweeps.read(number) for number in numbers]
    points = np.concatenate([sweep.world for sweep in aligned])
    voxel_m = sweeps.alignment.voxel_m
    planes = VoxelPlanes.from_points(sweeps.name, points, voxel_m) if len(points) else None
    if planes is None:
        return None
    parts = [
        _deviations(sweeps, number, sweep, planes)
        for number, sweep in zip(numbers, aligned, strict=True)
    ]
    found = _Deviations(*map(np.concatenate, zip(*parts, strict=True)))
    # Errors of the azimuths affect the ranges of surfaces that are inclined to the beams. Use them
    # only if there are hardly any others.
    if found.is_frontal.sum() >= _MIN_COUNT:
        found = found.frontal()
    if len(found.ring) < _MIN_COUNT:
        return None
    ring_count = sweeps.recorded.ring_count
    classes = np.searchsorted(_RANGES_M, found.range_m, side="right") - 1
    return RangeNoise(
        _sigma(found.deviation_m),
        _sigmas(found.deviation_m, found.ring, ring_count),
        _sigmas(found.deviation_m, classes, len(_RANGES_M) - 1),
        len(found.ring),
    )


class RingNeighbors(NamedTuple):
    """Triples of returns of neighboring pulses in a ring, as indices of the returns of a sweep."""

    before: Ints  # (k,)
    at: Ints  # (k,)
    after: Ints  # (k,)
    span: Floats  # (k,), azimuth difference between the outer returns in radians
    share: Floats  # (k,), fraction of this difference at which the middle return is

    @classmethod
    def from_sweep(cls, sweep: Sweep, lasers: RingLasers) -> RingNeighbors:
        """Find the returns whose neighboring pulses in the ring return as well."""
        ring = sweep.columns["row"]
        azimuth, _ = lasers.angles(sweep.points, ring)
        order = np.lexsort((azimuth, ring))
        before, at, after = order[:-2], order[1:-1], order[2:]
        first, second = azimuth[at] - azimuth[before], azimuth[after] - azimuth[at]
        used = (ring[before] == ring[at]) & (ring[at] == ring[after])
        if used.any():
            lower, upper = np.multiply(_STEPS, np.median(first[used]))
            for step in (first, second):
                used &= (step > lower) & (step < upper)
        span = (first + second)[used]
        return cls(before[used], at[used], after[used], span, first[used] / span)

    def select(self, chosen: Bools) -> RingNeighbors:
        """Select triples with a mask."""
        return RingNeighbors(
            self.before[chosen],
            self.at[chosen],
            self.after[chosen],
            self.span[chosen],
            self.share[chosen],
        )

    def deviations(self, range_m: Floats, curved: Floats) -> Floats:
        """Return the deviations of the middle ranges on planes, scaled to the range noise.

        `curved` (k,) is the part of the inverse range that is a sine of the azimuth.
        """
        inverse = (1 - self.share) / range_m[self.before] + self.share / range_m[self.after]
        inverse *= 1 + curved * self.share * (1 - self.share) * self.span**2 / 2
        scale = np.sqrt(1 + self.share**2 + (1 - self.share) ** 2)
        return np.asarray((range_m[self.at] - 1 / inverse) / scale)


def _deviations(
    sweeps: AlignedSweeps, number: int, aligned: AlignedSweep, planes: VoxelPlanes
) -> _Deviations:
    """Return the deviations of the returns of a sweep that are on planes, like their neighbors."""
    sweep = sweeps.recorded.read(number)
    lasers = sweeps.recorded.lasers
    range_m = lasers.ranges(sweep.points, sweep.columns["row"])
    normals, on_plane = _normals(aligned.world, planes, sweeps.alignment.voxel_m)
    on_plane &= range_m > _MIN_RANGE_M
    triples = RingNeighbors.from_sweep(sweep, lasers)
    used = on_plane[triples.at]
    for neighbor in (triples.before, triples.after):
        parallel = np.abs(np.einsum("ij,ij->i", normals[triples.at], normals[neighbor]))
        used &= on_plane[neighbor] & (parallel > _MIN_PARALLEL)
    triples = triples.select(used)
    at = triples.at
    beams = (aligned.world - aligned.origins)[at]
    beams /= np.linalg.norm(beams, axis=1)[:, None]
    inward = np.einsum("ij,ij->i", beams, normals[at])
    up = sweeps.alignment.poses[number][:3, 2]
    # The upright part of a normal adds a constant to the inverse range.
    curved = 1 - (normals[at] @ up) * (beams @ up) / np.where(inward == 0, 1, inward)
    return _Deviations(
        triples.deviations(range_m, curved),
        sweep.columns["row"][at],
        range_m[at],
        np.abs(inward) > _MIN_COSINE,
    )


def _normals(world: Floats, planes: VoxelPlanes, voxel_m: float) -> tuple[Floats, Bools]:
    """Return the normals of the planes of points (n, 3), and a mask of the points on planes."""
    normals = np.zeros_like(world)
    distances, plane, rows = planes.distances(world, _MAX_VOXELS * voxel_m)
    on_plane = rows.copy()
    if len(distances):
        on_plane[rows] = np.abs(distances) <= _MAX_SIGMAS * _sigma(distances)
    normals[rows] = planes.normals[plane]
    return normals, on_plane


def _sigma(deviations: Floats) -> float:
    """Return a robust estimate of the standard deviation about 0."""
    return 1.4826 * float(np.median(np.abs(deviations)))


def _sigmas(deviations: Floats, group: Ints, count: int) -> Floats:
    """Return the standard deviation of each group, or NaN if it is too small."""
    sigmas = np.full(count, np.nan)
    for number in np.flatnonzero(np.bincount(group, minlength=count) >= _MIN_COUNT):
        sigmas[number] = _sigma(deviations[group == number])
    return sigmas


def _known(sigmas_m: Floats) -> list[float | None]:
    return [None if np.isnan(sigma_m) else round(float(sigma_m), 5) for sigma_m in sigmas_m]
