"""Rays that pass through the boxes of moving bodies, and the nearest hits so far."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .arrays import Floats, Indices, Ints, Ints32
from .hits import HitColumns
from .rays import Rays


class RayBodyPairs(NamedTuple):
    """Pairs of a ray and a body of a common shape, where the ray passes through the body's box.

    Attributes
    ----------
    rays
        float64 (6, n): origins, meters, and directions of all rays of the cast.
    row
        int64 (m,): row in `rays` of each pair's ray; the pairs of a body follow each other.
    body
        int64 (m,): number of each pair's body.
    pose
        int64 (m,): column in `poses` of the body's pose at the time of the ray.
    poses
        float64 (12, p): positions, meters, and rotations from the body's axes by rows.
    box
        float64 (6,): lower and upper corner of the shape, in its axes, meters.
    limits
        Closest and farthest distance of a hit, meters.
    frame
        float64 (m,): frame of a deforming shape at the time of the ray; (0,) for a rigid shape.
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
        """Return a copy whose rows, bodies and poses are contiguous, for compiled loops."""
        return self._replace(
            row=np.ascontiguousarray(self.row),
            body=np.ascontiguousarray(self.body),
            pose=np.ascontiguousarray(self.pose),
        )


class TimedBodies(NamedTuple):
    """Bodies of a common shape, with their poses at consecutive times of rays.

    Attributes
    ----------
    body
        int64 (b,): numbers of the bodies.
    poses
        float64 (t, b, 12): position, meters, and rotation from the body's axes by rows; NaN while
        a body is absent.
    boxes
        float64 (t / SPAN, b, 6): lower and upper corner of the box around a body's boxes during
        `SPAN` times, meters.
    first_time
        Number of the first of the t times among the times of the rays.
    limits
        Closest and farthest distance of a hit, meters.
    """

    body: Ints
    poses: Floats
    boxes: Floats
    first_time: int
    limits: tuple[float, float]


SPAN = 32  # times of a box of `TimedBodies`; as in intersect.cu


class BodyHits(NamedTuple):
    """Nearest hits on moving bodies, of the rays that hit a body.

    Attributes
    ----------
    ray
        int64 (k,): number of the ray, ascending.
    distance
        float64 (k,): meters.
    body
        int64 (k,): number of the body; of equal distances, the lowest.
    instance, triangle
        int32 (k,): instance and triangle of the body's shape.
    """

    ray: Ints
    distance: Floats
    body: Ints
    instance: Ints32
    triangle: Ints32


class NearestHits(NamedTuple):
    """Nearest hits of rays (n,) on moving bodies.

    Of bodies at equal distances, the lowest number counts.

    Attributes
    ----------
    distance
        float64 (n,): meters; the distance before which hits count for a ray without a hit.
    body
        int64 (n,): number of the body, -1 for no hit.
    instance, triangle
        int32 (n,): instance and triangle of the body's shape.
    """

    distance: Floats
    body: Ints
    instance: Ints32
    triangle: Ints32

    @classmethod
    def empty(cls, limits: Floats) -> NearestHits:
        """Create rays without a hit, for hits before distances `limits` (n,), meters."""
        n = len(limits)
        return cls(limits, np.full(n, -1), np.zeros(n, np.int32), np.zeros(n, np.int32))

    def view(self, start: int, stop: int) -> NearestHits:
        """Return the hits of rays `start` to `stop`, as views of the same memory."""
        span = slice(start, stop)
        distance, body, instance, triangle = self
        return NearestHits(distance[span], body[span], instance[span], triangle[span])

    def update(self, hits: BodyHits) -> None:
        """Write those hits on bodies that are nearer than the nearest hits so far."""
        nearer = np.flatnonzero(hits.distance < self.distance[hits.ray])
        ray = hits.ray[nearer]
        self.distance[ray] = hits.distance[nearer]
        self.body[ray] = hits.body[nearer]
        self.instance[ray] = hits.instance[nearer]
        self.triangle[ray] = hits.triangle[nearer]

    def compact(self) -> BodyHits:
        """Return the hits, without the rays that hit no body."""
        ray = np.flatnonzero(self.body >= 0)
        distance, body, instance, triangle = self
        return BodyHits(ray, distance[ray], body[ray], instance[ray], triangle[ray])


def cast_pairs(
    cast: Callable[[Rays], HitColumns], pairs: RayBodyPairs, nearest: NearestHits
) -> None:
    """Cast the rays of a crossing in the bodies' axes, and write nearer hits to `nearest`."""
    rays = _in_body_axes(pairs)
    ray, distance, triangle, instance = cast(rays)
    # Directions of a sensor that turns during a pose are not quite of unit length.
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


def _in_body_axes(pairs: RayBodyPairs) -> Rays:
    """Return the ray of each pair, relative to the body's position and in the body's axes."""
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
    """Return the hits (m,) that are nearer than known hits, the nearest of each ray last."""
    limit = nearest.distance[row]
    lower_body = (distance == limit) & (body < nearest.body[row])
    nearer = np.flatnonzero((distance < limit) | lower_body)
    return nearer[np.lexsort((-body[nearer], -distance[nearer]))]
