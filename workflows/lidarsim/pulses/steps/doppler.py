"""Radial velocities, the rates of change of range that a coherent lidar measures.

A radial velocity is the velocity of the hit point minus the velocity of the ray's origin, projected
on the ray. FMCW lidars measure it from the Doppler shift 2 v / wavelength
(Hexsel, Vhavle and Chen 2022). Both velocities are derivatives of trajectories
(`lidarsim.motion.trajectory.velocities`).
"""

from __future__ import annotations

import numpy as np

from ...casting.actor_trajectories import ActorTrajectories
from ...casting.motion import CastPoses
from ...casting.surfaces import SceneSurfaces
from ...numerics.arrays import Floats, Integers, Ints, Ints32
from ...numerics.random_numbers import Purpose
from ...numerics.vectors import dot

VELOCITY = Purpose(40, "radial velocity noise of a return")
BLOCK_HITS = 1 << 13  # number of hits that are computed at a time, to fit a cache


def range_rates_of_origins(
    poses: CastPoses, ray: Integers, origins: Floats, directions: Floats
) -> Floats:
    """Return the range rates of static points due to the motion of the platform, in m/s.

    `ray` (n,) are numbers of rays in the order of `poses`. Origins and unit directions of the rays
    have shape (n, 3) and are in the scene frame.
    """
    rates = np.zeros(len(ray))
    if poses.platform is None:
        return rates
    origins = np.broadcast_to(origins, directions.shape)
    for begin in range(0, len(ray), BLOCK_HITS):
        block = slice(begin, begin + BLOCK_HITS)
        drift = poses.platform_velocities(ray[block], origins[block])
        rates[block] = -dot(drift.T, directions[block].T)
    return rates


def radial_velocities(
    surfaces: SceneSurfaces,
    poses: CastPoses,
    ray: Integers,
    rays: tuple[Floats, Floats],
    distance: Floats,
    triangle: Ints32,
    times: Floats | Ints,
) -> Floats:
    """Return the radial velocities of ray end points in m/s. Receding points have positive values.

    Parameters
    ----------
    ray
        (n,): numbers of the rays in the order of `poses`.
    rays
        Origins and unit directions of the rays, each (n, 3), in the scene frame.
    distance
        (n,): lengths of the rays in meters, without noise.
    triangle
        (n,): triangles at the end points. A point in the air, with triangle -1, is static.
    times
        (n,): firing times in nanoseconds since the start of the survey, for actors.
    """
    origins, directions = rays
    rates = range_rates_of_origins(poses, ray, origins, directions)
    if poses.actor_trajectories:
        velocity = velocities_of_ends(
            surfaces, poses.actor_trajectories, rays, distance, triangle, times
        )
        rates += dot(velocity.T, directions.T)
    return rates


def velocities_of_ends(
    surfaces: SceneSurfaces,
    actor_trajectories: ActorTrajectories,
    rays: tuple[Floats, Floats],
    distance: Floats,
    triangle: Ints32,
    times: Floats | Ints,
) -> Floats:
    """Return the scene-frame velocities, in m/s, of actors' surfaces at the ends of rays.

    `rays` are origins and unit directions (n, 3) in the scene frame. `distance` (n,) is in meters,
    and `times` (n,) are firing times in nanoseconds since the start of the survey.
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
