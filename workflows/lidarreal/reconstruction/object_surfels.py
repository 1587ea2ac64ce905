"""Surfels of moving objects in their own axes, and rays that are cast to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from raybeam import RayCaster

from .alignment import AlignedSweep
from .moving_rays import MovingRays, box_distances
from .object_tracks import ObjectTrack
from .surface_map import Observations, SurfaceMap, median_shifts
from .surfels import Surfels

_VOXEL_SHARES = (0.5, 0.25)  # voxel edges that are tried, relative to those of the scene
_ROUNDS = 3  # iterations of casting rays, and of removing and moving surfels
_MAX_RAYS = 200_000  # evenly chosen rays that form an object
_MAX_SHIFT_M = 0.15  # Rays with a larger range difference do not move a surfel.
_PASSING_VOTES = 3  # votes of a ray that passes a surfel, relative to one that ends on it
_ON_RAY_M = 0.1  # A ray passes a surfel if it ends this far behind it.
_GROUND_M = 0.2  # maximum height of points on the ground above the underside of the box
_REACH_M = 0.5  # margin around a box within which rays are cast


@dataclass(frozen=True, eq=False)
class RecordedObject:
    """A moving object of a recording."""

    track: ObjectTrack
    surfels: Surfels  # in the object frame
    observations: Observations  # of its surfels
    label: int  # most frequent class and object of its points, 0 if unknown
    sweeps: int  # number of sweeps in which the object was observed


def reconstruct_objects(
    tracks: Sequence[ObjectTrack], rays: MovingRays, voxel_m: float, gap_rad: float
) -> list[RecordedObject]:
    """Reconstruct objects from the rays that end on them. Objects with few points are omitted."""
    found = []
    for track in tracks:
        recorded = _reconstruct(track, rays, voxel_m, gap_rad)
        if recorded is not None:
            found.append(recorded)
    return found


def _reconstruct(
    track: ObjectTrack, rays: MovingRays, voxel_m: float, gap_rad: float
) -> RecordedObject | None:
    near = rays.select(_near(track, rays))
    sweep = _in_object_frame(track, near)
    inside = near.returned & track.contains(sweep.world) & ~_are_on_ground(sweep.world, near.moved)
    points = sweep.world[inside]
    outward = (sweep.origins - sweep.world)[inside]
    for share in _VOXEL_SHARES:
        if Surfels.are_enough(points, share * voxel_m):
            break
    else:
        return None
    surfels = Surfels.from_points(
        track.kind, points, outward.astype(np.float32), share * voxel_m, gap_rad
    )
    for _ in range(_ROUNDS):
        refined = _refine(surfels, sweep, near.returned)
        if refined is None:
            return None
        surfels = refined
    labels, counts = np.unique(near.label[inside], return_counts=True)
    return RecordedObject(
        track,
        surfels,
        _observe(surfels, sweep, near.returned),
        int(labels[counts.argmax()]),
        len(np.unique(near.sweep[inside])),
    )


def _are_on_ground(points: Floats, moved: Bools) -> Bools:
    """Mark points in the object frame that are close to the ground and did not move."""
    return (points[:, 2] < _GROUND_M) & ~moved


def _near(track: ObjectTrack, rays: MovingRays) -> Ints:
    """Return the rays that pass through the surroundings of an object at their times."""
    rows = track.rows_toward(rays.origins, rays.ends, rays.time_s, _reach_m(track))
    origins = track.to_object(rays.origins[rows], rays.time_s[rows])
    ends = track.to_object(rays.ends[rows], rays.time_s[rows])
    rows = rows[_enters_box(track, origins, ends - origins)]
    return np.asarray(rows[even_indices(len(rows), _MAX_RAYS)])


def _reach_m(track: ObjectTrack) -> float:
    """Return the horizontal radius in meters of the surroundings of an object."""
    return float(np.hypot(*(track.size[:2] / 2 + _REACH_M)))


def _enters_box(track: ObjectTrack, origins: Floats, directions: Floats) -> Bools:
    """Mark the rays in the object frame that pass through the surroundings of its box."""
    high = np.append(track.size[:2] / 2 + _REACH_M, track.size[2] + _REACH_M)
    low = np.append(-high[:2], -_REACH_M)
    enter, leave = box_distances(low, high, origins, directions)
    return np.asarray(leave >= np.maximum(enter, 0))


def _in_object_frame(track: ObjectTrack, rays: MovingRays) -> AlignedSweep:
    """Return the rays as a sweep in the object frame."""
    ends = track.to_object(rays.ends, rays.time_s)
    origins = track.to_object(rays.origins, rays.time_s)
    return AlignedSweep(ends, ends, origins, rays.ring, rays.intensity, None)


def _refine(surfels: Surfels, sweep: AlignedSweep, returned: Bools) -> Surfels | None:
    """Remove surfels that too many rays pass, and move the others to the points.

    Return None if none remains.
    """
    count = len(surfels)
    hits = SurfaceMap.from_surfels(surfels).cast(sweep)
    is_return = returned[hits.rays]
    farther_m = np.where(is_return, hits.range_m - hits.distance_m, np.inf)
    ends = is_return & (np.abs(farther_m) < _ON_RAY_M)
    passing = farther_m >= _ON_RAY_M
    votes = np.bincount(hits.surfel[ends], minlength=count)
    votes -= _PASSING_VOTES * np.bincount(hits.surfel[passing], minlength=count)
    moving = is_return & (np.abs(farther_m) < _MAX_SHIFT_M)
    shifts_m = median_shifts(hits.surfel[moving], (farther_m * hits.inward)[moving], count)
    kept = votes >= 0
    return surfels.shift_along_normals(shifts_m).select(kept) if kept.any() else None


def _observe(surfels: Surfels, sweep: AlignedSweep, returned: Bools) -> Observations:
    """Return the rays that end on surfels."""
    hits = SurfaceMap.from_surfels(surfels).cast(sweep)
    ends = returned[hits.rays] & (np.abs(hits.range_m - hits.distance_m) < _ON_RAY_M)
    rays = hits.rays[ends]
    assert sweep.intensities is not None
    return Observations(
        hits.surfel[ends].astype(np.int32),
        sweep.ring[rays].astype(np.int32),
        hits.range_m[ends].astype(np.float32),
        hits.cosine[ends].astype(np.float32),
        sweep.intensities[rays].astype(np.float32),
    )


class ObjectHits(NamedTuple):
    """First hits of n rays on moving objects."""

    distance_m: Floats  # (n,), inf without a hit
    object: Ints  # (n,), index of the object, -1 without a hit
    surfel: Ints  # (n,), index of its surfel
    cosine: Floats  # (n,), cosine of the incidence angle


def cast_to_objects(
    objects: Sequence[RecordedObject], origins: Floats, ends: Floats, times_s: Floats
) -> ObjectHits:
    """Cast rays to moving objects at the times of the rays.

    `origins` and `ends` are positions on the rays in the world frame, of shape (n, 3), and the
    times have shape (n,).
    """
    count = len(origins)
    hits = ObjectHits(
        np.full(count, np.inf), np.full(count, -1), np.full(count, -1), np.zeros(count)
    )
    for index, one in enumerate(objects):
        rows = one.track.rows_toward(origins, ends, times_s, _reach_m(one.track))
        local_origins = one.track.to_object(origins[rows], times_s[rows])
        directions = one.track.to_object(ends[rows], times_s[rows]) - local_origins
        inside = _enters_box(one.track, local_origins, directions)
        rows, directions = rows[inside], directions[inside]
        mesh = one.surfels.mesh
        found = RayCaster(mesh.vertices, mesh.faces).cast(local_origins[inside], directions)
        nearer = found.hit & (found.distance < hits.distance_m[rows])
        rays = rows[nearer]
        hits.distance_m[rays] = found.distance[nearer]
        hits.object[rays] = index
        hits.surfel[rays] = found.triangle[nearer].astype(np.int64) // 2
        normals = one.surfels.normals[hits.surfel[rays]]
        units = directions[nearer] / np.linalg.norm(directions[nearer], axis=1)[:, None]
        hits.cosine[rays] = np.abs(np.einsum("ij,ij->i", units, normals))
    return hits
