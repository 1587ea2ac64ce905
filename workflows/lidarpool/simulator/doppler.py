"""Radial velocities: how fast the range of each return grows, as a coherent lidar measures it.

The velocity of the point that was hit, less that of the ray's origin, along the ray: what the
Doppler shift 2 v / wavelength of FMCW lidars shows (Hexsel, Vhavle and Chen 2022). Both are
derivatives of the trajectories' own curves (`lidarpool.sensor.trajectory.velocities`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .motion import Poses, products
from .surfaces import Surfaces

BLOCK_HITS = 1 << 13  # hits that are looked at a time, to fit a cache

Real = NDArray[np.float64]


def radial_velocities(
    surfaces: Surfaces,
    poses: Poses,
    ray: NDArray[np.integer[Any]],
    rays: tuple[Real, Real],
    distance: Real,
    triangle: NDArray[np.int32],
    times: Real | NDArray[np.int64],
) -> Real:
    """Return the radial velocities of straight rays (n,) that end on triangles, m/s: (n,).

    Parameters
    ----------
    rays
        Their origins and unit directions, (n, 3) each, in the scene's axes.
    distance
        (n,): where they end, metres; without noise.
    triangle
        (n,): what they hit; what is in the air, -1, is at rest.
    times
        (n,): when they are fired, nanoseconds since the survey's start; for actors.
    """
    out = np.zeros(len(ray))
    origins, directions = rays
    origins = np.broadcast_to(origins, directions.shape)
    for begin in range(0, len(ray), BLOCK_HITS):
        block = slice(begin, begin + BLOCK_HITS)
        ahead, start = directions[block], origins[block]
        points = start + distance[block, None] * ahead
        velocity = surfaces.velocities(triangle[block], points, times[block], poses.ways)
        velocity -= poses.drift(ray[block], start)
        out[block] = products(velocity.T, ahead.T)
    return out
