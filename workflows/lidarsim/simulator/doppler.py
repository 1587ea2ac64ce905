"""Radial velocities: how fast the range of each return grows, as a coherent lidar measures it.

The velocity of the point that was hit, less that of the ray's origin, along the ray: what the
Doppler shift 2 v / wavelength of FMCW lidars shows (Hexsel, Vhavle and Chen 2022). Both are
derivatives of the trajectories' own curves (`lidarsim.sensor.trajectory.velocities`).
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats, Integers, Ints, Ints32
from ..base.vectors import products
from ..sensor.random_numbers import Purpose
from .actor_trajectories import ActorTrajectories
from .motion import CastPoses
from .surfaces import Surfaces

VELOCITY = Purpose(40, "noise of a return's radial velocity")
BLOCK_HITS = 1 << 13  # hits that are looked at a time, to fit a cache


def approach(poses: CastPoses, ray: Integers, origins: Floats, directions: Floats) -> Floats:
    """How fast rays (n,) grow because their origins move, m/s: (n,); what stands still has that.

    Origins and unit directions are (n, 3), in the scene's axes.
    """
    out = np.zeros(len(ray))
    if poses.carrier is None:
        return out
    origins = np.broadcast_to(origins, directions.shape)
    for begin in range(0, len(ray), BLOCK_HITS):
        block = slice(begin, begin + BLOCK_HITS)
        drift = poses.drift(ray[block], origins[block])
        out[block] = -products(drift.T, directions[block].T)
    return out


def radial_velocities(
    surfaces: Surfaces,
    poses: CastPoses,
    ray: Integers,
    rays: tuple[Floats, Floats],
    distance: Floats,
    triangle: Ints32,
    times: Floats | Ints,
) -> Floats:
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
    origins, directions = rays
    out = approach(poses, ray, origins, directions)
    if poses.actor_trajectories:
        velocity = velocities_of_ends(surfaces, poses.actor_trajectories, rays, distance, triangle, times)
        out += products(velocity.T, directions.T)
    return out


def velocities_of_ends(
    surfaces: Surfaces, ways: ActorTrajectories, rays: tuple[Floats, Floats], distance: Floats,
    triangle: Ints32, times: Floats | Ints,
) -> Floats:  # fmt: skip
    """Return the velocities of where rays end, m/s: (n, 3); arguments as of `radial_velocities`."""
    directions = rays[1]
    out = np.empty(rays[1].shape)
    origins = np.broadcast_to(rays[0], out.shape)
    for begin in range(0, len(out), BLOCK_HITS):
        block = slice(begin, begin + BLOCK_HITS)
        points = origins[block] + distance[block, None] * directions[block]
        out[block] = surfaces.velocities(triangle[block], points, times[block], ways)
    return out
