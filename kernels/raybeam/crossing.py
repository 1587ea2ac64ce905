"""Rays that pass through boxes of bodies that move, and the nearest hits found so far."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .arrays import Floats, Ints, Ints32
from .hits import Part
from .rays import Rays


class Crossing(NamedTuple):
    """Rays that pass through the boxes of bodies of one shape."""

    rays: Floats  # (6, n): origins and directions of all rays that are cast together, in metres
    row: Ints  # (m,): rays that pass, one after the other for each body,
    body: Ints  # (m,): the bodies,
    number: Ints  # (m,): and which of the poses these have then
    poses: Floats  # (12, p): positions, and rotations from the body's axes by rows
    box: Floats  # (6,): low and high corner of the shape
    limits: tuple[float, float]  # t_min and t_max
    frame: Floats  # (m,): of a shape that deforms, its frame then; (0,) of others


class Swept(NamedTuple):
    """Rays and bodies of one shape, with their poses at all times of the rays."""

    rays: Floats  # (6, n): as of `Crossing`
    when: Ints32  # (n,): number of each ray's time; one beyond the `t` times meets no body
    body: Ints  # (b,)
    poses: Floats  # (t, b, 12): as of `Crossing`; NaN where a body is not there
    boxes: Floats  # (t / SPAN, b, 6): corners of what holds them during that many times
    limits: tuple[float, float]


SPAN = 32  # as in intersect.cu


class Nearest(NamedTuple):
    """What rays (n,) hit nearest on bodies that move; of equal distances, the first body.

    distance float64 metres, before which hits count if there is none yet; body int64, -1 for none;
    instance and triangle of its shape int32.
    """

    distance: Floats
    body: Ints
    instance: Ints32
    triangle: Ints32

    @classmethod
    def of(cls, ends: Floats) -> Nearest:
        """Nothing is hit yet by rays that end at distances (n,)."""
        n = len(ends)
        return cls(ends, np.full(n, -1), np.zeros(n, np.int32), np.zeros(n, np.int32))

    def part(self, start: int, stop: int) -> Nearest:
        """Take those of some rays, which share their memory."""
        distance, body, instance, triangle = self
        some = slice(start, stop)
        return Nearest(distance[some], body[some], instance[some], triangle[some])


def strike(cast: Callable[[Rays], Part], crossing: Crossing, nearest: Nearest) -> None:
    """Take rays to the axes of bodies, `cast` them there, and note nearer hits."""
    row = crossing.row
    poses = crossing.poses[:, crossing.number]
    starts = crossing.rays[:3, row] - poses[:3]
    ways = crossing.rays[3:, row]
    turns = poses[3:].reshape(3, 3, -1).transpose(1, 0, 2)
    starts, ways = (
        np.stack([(x * a + y * b) + z * c for a, b, c in turns]) for x, y, z in (starts, ways)
    )
    met = cast(Rays(starts.T, ways.T, *crossing.limits))
    ray, distance, triangle, instance = met
    # Directions of a sensor that turns during a pose are not quite of unit length.
    x, y, z = ways[:, ray]
    distance = distance / np.sqrt((x * x + y * y) + z * z)
    row = row[ray]
    body = crossing.body[ray]
    before = nearest.distance[row]
    first = (distance == before) & (body < nearest.body[row])
    nearer = np.flatnonzero((distance < before) | first)
    nearer = nearer[np.lexsort((-body[nearer], -distance[nearer]))]  # the last of a ray remains
    row = row[nearer]
    nearest.distance[row] = distance[nearer]
    nearest.body[row] = body[nearer]
    nearest.instance[row] = instance[nearer]
    nearest.triangle[row] = triangle[nearer]
