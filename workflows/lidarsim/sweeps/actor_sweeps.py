"""Poses of actors at the start of each sweep and during it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..motion.trajectory import CLOCK_S, full_poses, presence_ns, velocities
from ..numerics.arrays import Bools, Floats, Floats32, Ints32
from ..numerics.vectors import cross, matvec
from ..scene.actors import Actor
from ..scene.scene import Scene
from .sweep_motion import STILL, knot_count, relative_knots

# Interval between stored poses. If an actor accelerates at 10 m/s², the interpolation error is at
# most 0.13 mm.
KNOT_NS = 1e7
NO_ROWS = np.zeros((0, 0), np.int32)
_POSES = 100_000  # poses to compute at a time


class ActorSweeps(NamedTuple):
    """Poses and presence of all actors in n sweeps, as stored in the fields of `Sweeps`."""

    positions: Floats  # (a, n, 3), world coordinates at the start of each sweep, meters
    rotations: Floats  # (a, n, 3, 3), from the actor frame to the world frame
    velocities: Floats  # (a, n, 3), velocities of the box centers, m/s
    bounds: Floats  # (a, 2, 3)
    present: Bools  # (a, n)
    comes: Bools  # (a, n)
    leaves: Bools  # (a, n)
    rows: Ints32  # (a, n), row index in `knots`, or -1 if the actor is static or absent
    knots: Floats32  # (r, k, 7), poses relative to the start of the sweep; see `relative_knots`

    @classmethod
    def from_scene(cls, scene: Scene, starts_ns: Floats, stops_ns: Floats) -> ActorSweeps:
        """Compute the poses of a scene's actors during the given sweeps.

        The sweeps are specified by the times of their starts and last beams, with shape (n,). If an
        actor is not present at the start of a sweep, its pose is extrapolated from the time at
        which it appears or leaves, with constant velocity and rotation. Its boxes then move
        smoothly from sweep to sweep.
        """
        shape = len(scene.actors), len(starts_ns)
        actors = [
            _SingleActorSweeps.in_sweeps(actor, starts_ns, stops_ns) for actor in scene.actors
        ]
        moving = np.reshape([actor.moving for actor in actors], shape).astype(np.bool_)
        rows = np.where(moving, np.cumsum(moving).reshape(shape) - 1, -1)
        knots = [part for actor in actors for part in actor.knots]
        return cls(
            np.reshape([actor.positions for actor in actors], (*shape, 3)) + scene.origin,
            np.reshape([actor.rotations for actor in actors], (*shape, 3, 3)),
            np.reshape([actor.velocities for actor in actors], (*shape, 3)),
            np.reshape([actor.bounds for actor in scene.actors], (-1, 2, 3)),
            np.reshape([actor.present for actor in actors], shape).astype(np.bool_),
            np.reshape([actor.comes for actor in actors], shape).astype(np.bool_),
            np.reshape([actor.leaves for actor in actors], shape).astype(np.bool_),
            rows.astype(np.int32) if moving.any() else NO_ROWS,
            np.concatenate(knots) if moving.any() else STILL,
        )


class _SingleActorSweeps(NamedTuple):
    """Poses and presence of a single actor in n sweeps."""

    positions: Floats  # (n, 3), scene frame, meters
    rotations: Floats  # (n, 3, 3)
    velocities: Floats  # (n, 3), velocity of the box center, m/s
    present: Bools  # (n,)
    comes: Bools  # (n,)
    leaves: Bools  # (n,)
    moving: Bools  # (n,), whether the actor has knots in the sweep
    knots: list[Floats32]  # parts of shape (…, k, 7), for sweeps in which the actor moves

    @classmethod
    def in_sweeps(cls, actor: Actor, starts_ns: Floats, stops_ns: Floats) -> _SingleActorSweeps:
        """Compute the poses of an actor, given the times of each sweep's start and last beam."""
        appears_ns, leaves_ns = presence_ns(actor.trajectory)
        poses = _poses(actor, starts_ns)
        lever_arms = matvec(poses.rotations, actor.bounds.mean(axis=0))
        present = (appears_ns <= starts_ns) & (starts_ns <= leaves_ns)
        comes = (starts_ns < appears_ns) & (appears_ns <= stops_ns)
        moving = (present | comes) & actor.trajectory.moves
        spans_ns = stops_ns - starts_ns
        count = knot_count(float(spans_ns.max(initial=0.0)), KNOT_NS)
        return cls(
            poses.positions,
            poses.rotations,
            poses.speeds + cross(poses.rates.T, lever_arms.T).T,
            present,
            comes,
            present & (leaves_ns < stops_ns),
            moving,
            [*_knots(actor, starts_ns[moving], spans_ns[moving], count)] if moving.any() else [],
        )


class _Poses(NamedTuple):
    """Poses of an actor at k times, and their derivatives."""

    positions: Floats  # (k, 3), scene frame, meters
    rotations: Floats  # (k, 3, 3)
    speeds: Floats  # (k, 3), velocities, m/s
    rates: Floats  # (k, 3), angular velocities, rad/s


def _poses(actor: Actor, times_ns: Floats) -> _Poses:
    """Return the poses of an actor, extrapolated to times at which it is not present."""
    trajectory = actor.trajectory
    within_ns = _times_of_presence(times_ns, *presence_ns(trajectory))
    positions, rotations = full_poses(trajectory, 0, within_ns)
    speeds, rates = velocities(trajectory, 0, within_ns)
    beyond_s = (times_ns - within_ns)[:, None] / 1e9
    return _Poses(positions + speeds * beyond_s, rotations, speeds, rates)


def _knots(actor: Actor, starts_ns: Floats, spans_ns: Floats, count: int) -> Iterator[Floats32]:
    """Yield the knots of an actor for consecutive parts of the sweeps.

    Each part has shape (…, count, 7).
    """
    sweeps = np.arange(len(starts_ns))
    for part in np.array_split(sweeps, -(-len(sweeps) * count // _POSES) or 1):
        times_ns = starts_ns[part, None] + np.linspace(0, 1, count) * spans_ns[part, None]
        poses = _poses(actor, times_ns.ravel())
        positions = poses.positions.reshape(len(part), count, 3)
        rotations = poses.rotations.reshape(len(part), count, 3, 3)
        yield relative_knots(positions - positions[:, :1], rotations)


def _times_of_presence(times_ns: Floats, appears_ns: float, leaves_ns: float) -> Floats:
    """Clip times to the interval during which an actor is present, with a margin for rounding."""
    # Trajectory times may be seconds since 1970, whose resolution is 2.4e-7 s.
    margin_ns = min(1e9 * CLOCK_S, (leaves_ns - appears_ns) / 2)
    present = (appears_ns <= times_ns) & (times_ns <= leaves_ns)
    return np.where(present, times_ns, times_ns.clip(appears_ns + margin_ns, leaves_ns - margin_ns))
