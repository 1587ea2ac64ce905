"""Radial velocities: growth of the range of each return, as a coherent lidar measures it.

The velocity of the hit point minus the velocity of the ray's origin, along the ray, which the
Doppler shift 2 v / wavelength of FMCW lidars shows (Hexsel, Vhavle and Chen 2022). Both are
derivatives of the trajectories' curves (`lidarsim.motion.trajectory.velocities`).
"""

from __future__ import annotations

import numpy as np

from ...base.arrays import Floats, Integers, Ints, Ints32
from ...base.random_numbers import Purpose
from ...base.vectors import products
from ..casting.actor_trajectories import ActorTrajectories
from ..casting.motion import CastPoses
from ..casting.surfaces import Surfaces

VELOCITY = Purpose(40, "radial velocity noise of a return")
BLOCK_HITS = 1 << 13  # hits that are computed at a time, to fit a cache


def range_rates_of_origins(
    poses: CastPoses, ray: Integers, origins: Floats, directions: Floats
) -> Floats:
    """Return the growth of the ranges of static points by the motion of the carrier, m/s: (n,).

    `ray` (n,) are numbers of rays in the order of `poses`. Origins and unit directions of the rays
    are (n, 3), in the scene frame.
    """
    rates = np.zeros(len(ray))
    if poses.carrier is None:
        return rates
    origins = np.broadcast_to(origins, directions.shape)
    for begin in range(0, len(ray), BLOCK_HITS):
        block = slice(begin, begin + BLOCK_HITS)
        drift = poses.drift(ray[block], origins[block])
        rates[block] = -products(drift.T, directions[block].T)
    return rates


def radial_velocities(
    surfaces: Surfaces,
    poses: CastPoses,
    ray: Integers,
    rays: tuple[Floats, Floats],
    distance: Floats,
    triangle: Ints32,
    times: Floats | Ints,
) -> Floats:
    """Return the radial velocities, growth of length, of rays (n,) to triangles, m/s: (n,).

    Parameters
    ----------
    ray
        (n,): numbers of the rays in the order of `poses`.
    rays
        Origins and unit directions of the rays, (n, 3) each, in the scene frame.
    distance
        (n,): lengths of the rays, meters; without noise.
    triangle
        (n,): triangles at the ends; ends in the air, -1, are at rest.
    times
        (n,): firing times, nanoseconds since the survey's start; for actors.
    """
    origins, directions = rays
    rates = range_rates_of_origins(poses, ray, origins, directions)
    if poses.actor_trajectories:
        velocity = velocities_of_ends(
            surfaces, poses.actor_trajectories, rays, distance, triangle, times
        )
        rates += products(velocity.T, directions.T)
    return rates


def velocities_of_ends(
    surfaces: Surfaces,
    actor_trajectories: ActorTrajectories,
    rays: tuple[Floats, Floats],
    distance: Floats,
    triangle: Ints32,
    times: Floats | Ints,
) -> Floats:
    """Return the velocities of actors' surfaces at the ends of rays, scene frame, m/s: (n, 3).

    `rays` are origins and unit directions (n, 3) in the scene frame; `distance` (n,) is in meters,
    `times` (n,) are firing times in nanoseconds since the survey's start.
    """
    directions = rays[1]
    end_velocities = np.empty(rays[1].shape)
    origins = np.broadcast_to(rays[0], end_velocities.shape)
    for begin in range(0, len(end_velocities), BLOCK_HITS):
        block = slice(begin, begin + BLOCK_HITS)
        points = origins[block] + distance[block, None] * directions[block]
        end_velocities[block] = surfaces.on_actors.velocities(
            triangle[block], points, times[block], actor_trajectories
        )
    return end_velocities
