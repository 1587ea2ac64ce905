"""Pairs of rays and moving bodies, and the closest hits of rays on moving bodies.

Moving bodies are not part of a caster's scene. Instead, the rays that may hit a body are
transformed to the frame of the body at the firing time of each ray, and cast at the body's shape
there. A shape is a `RayCaster` or a `DeformingMesh`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .arrays import Floats, Indices, Ints, Ints32
from .hits import HitColumns
from .rays import Rays


class RayBodyPairs(NamedTuple):
    """Pairs of a ray and a body whose bounding box the ray intersects.

    All bodies have the same shape.

    Attributes
    ----------
    rays
        float64 (6, n): origins in meters and directions of all rays of the cast.
    row
        int64 (m,): column in `rays` of each pair's ray. The pairs of a body are consecutive.
    body
        int64 (m,): index of each pair's body.
    pose
        int64 (m,): column in `poses` that contains the pose of the body at the firing time of the
        ray.
    poses
        float64 (12, p): positions in meters, and rotation matrices from the body frame, row by row.
    box
        float64 (6,): lower and upper corner of the shape's bounding box in the body frame, in
        meters.
    limits
        Minimum and maximum distance of a hit in meters.
    frame
        float64 (m,): frame number of a deforming shape at the firing time of the ray. Empty for a
        rigid shape.
    """

    rays: Floats
    row: Ints
    body: Ints
    pose: Ints
    poses: Floats
    box: Floats
    limits: tuple[float, float]
    frame: Floats

    def contiguous(self) -> RayBodyPairs:
        """Return a copy whose integer arrays are contiguous, as the compiled loops require."""
        return self._replace(
            row=np.ascontiguousarray(self.row),
            body=np.ascontiguousarray(self.body),
            pose=np.ascontiguousarray(self.pose),
        )


class TimedBodies(NamedTuple):
    """Bodies with the same shape, and their poses at a series of ray times.

    Attributes
    ----------
    body
        int64 (b,): indices of the bodies.
    poses
        float64 (t, b, 12): position in meters, and rotation matrix from the body frame, row by row.
        NaN while a body is absent.
    boxes
        float64 (t / TIMES_PER_BOX, b, 6): lower and upper corner, in meters, of a box that encloses
        the body at `TIMES_PER_BOX` consecutive times.
    first_time
        Index of the first of the t times among all ray times.
    limits
        Minimum and maximum distance of a hit in meters.
    """

    body: Ints
    poses: Floats
    boxes: Floats
    first_time: int
    limits: tuple[float, float]


# Number of times that a box in `TimedBodies` covers, which must match the value in intersect.cu.
TIMES_PER_BOX = 32


class BodyHits(NamedTuple):
    """Closest hits on moving bodies, only for the rays that hit a body.

    Attributes
    ----------
    ray
        int64 (k,): index of the ray, in ascending order.
    distance
        float64 (k,): distance in meters.
    body
        int64 (k,): index of the body. Ties are resolved in favor of the lowest index.
    instance, triangle
        int32 (k,): instance and triangle of the body's shape.
    """

    ray: Ints
    distance: Floats
    body: Ints
    instance: Ints32
    triangle: Ints32


class NearestHits(NamedTuple):
    """Closest hit of each ray on a moving body, with one row per ray.

    Ties are resolved in favor of the lowest body index. The arrays are updated in place.

    Attributes
    ----------
    distance
        float64 (n,): distance in meters. If a ray has no hit, only hits at a shorter distance are
        recorded.
    body
        int64 (n,): index of the body, or -1 for no hit.
    instance, triangle
        int32 (n,): instance and triangle of the body's shape.
    """

    distance: Floats
    body: Ints
    instance: Ints32
    triangle: Ints32

    @classmethod
    def empty(cls, limits: Floats) -> NearestHits:
        """Create a table that has no hits yet and only records hits closer than `limits`.

        `limits` contains one distance per ray in meters and becomes the column `distance`.
        """
        n = len(limits)
        return cls(limits, np.full(n, -1), np.zeros(n, np.int32), np.zeros(n, np.int32))

    def view(self, start: int, stop: int) -> NearestHits:
        """Return the rows for rays `start` to `stop` as views."""
        span = slice(start, stop)
        distance, body, instance, triangle = self
        return NearestHits(distance[span], body[span], instance[span], triangle[span])

    def update(self, hits: BodyHits) -> None:
        """Record the hits that are closer than those recorded so far."""
        nearer = np.flatnonzero(hits.distance < self.distance[hits.ray])
        ray = hits.ray[nearer]
        self.distance[ray] = hits.distance[nearer]
        self.body[ray] = hits.body[nearer]
        self.instance[ray] = hits.instance[nearer]
        self.triangle[ray] = hits.triangle[nearer]

    def compact(self) -> BodyHits:
        """Return the recorded hits, only for the rays that hit a body."""
        ray = np.flatnonzero(self.body >= 0)
        distance, body, instance, triangle = self
        return BodyHits(ray, distance[ray], body[ray], instance[ray], triangle[ray])


def cast_pairs(
    cast: Callable[[Rays], HitColumns], pairs: RayBodyPairs, nearest: NearestHits
) -> None:
    """Cast rays at bodies and record closer hits in `nearest`.

    The function `cast` returns the closest hits of rays that are in body coordinates.
    """
    rays = _to_body_frames(pairs)
    ray, distance, triangle, instance = cast(rays)
    # If the sensor rotates while the rays of a pose are fired, directions are not exactly unit
    # vectors.
    x, y, z = rays.directions.T[:, ray]
    distance = distance / np.sqrt((x * x + y * y) + z * z)
    row = pairs.row[ray]
    body = pairs.body[ray]
    nearer = _nearer_hits(nearest, row, distance, body)
    row = row[nearer]
    nearest.distance[row] = distance[nearer]
    nearest.body[row] = body[nearer]
    nearest.instance[row] = instance[nearer]
    nearest.triangle[row] = triangle[nearer]


def _to_body_frames(pairs: RayBodyPairs) -> Rays:
    """Transform the ray of each pair to the frame of the pair's body."""
    poses = pairs.poses[:, pairs.pose]
    origins = pairs.rays[:3, pairs.row] - poses[:3]
    directions = pairs.rays[3:, pairs.row]
    inverse = poses[3:].reshape(3, 3, -1).transpose(1, 0, 2)
    origins, directions = (
        np.stack([(x * a + y * b) + z * c for a, b, c in inverse])
        for x, y, z in (origins, directions)
    )
    return Rays(origins.T, directions.T, *pairs.limits)


def _nearer_hits(nearest: NearestHits, row: Ints, distance: Floats, body: Ints) -> Indices:
    """Return the indices of the hits that are closer than those recorded so far.

    The hits are sorted so that the closest hit of each ray comes last. If they are assigned in this
    order, the closest hit remains.
    """
    limit = nearest.distance[row]
    lower_body = (distance == limit) & (body < nearest.body[row])
    nearer = np.flatnonzero((distance < limit) | lower_body)
    return nearer[np.lexsort((-body[nearer], -distance[nearer]))]
