"""Poses of actors at the starts of sweeps and while they last."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..motion.trajectory import CLOCK_S, full_poses, presence_ns, velocities
from ..numerics.arrays import Bools, Floats, Floats32, Ints32
from ..numerics.vectors import cross, matvec
from ..scene.actors import Actor
from ..scene.scene import Scene
from .sweep_motion import STILL, knots_in, relative_knots

KNOT_NS = 1e7  # between stored poses: at 10 m/s², 0.13 mm from a straight line
NO_ROWS = np.zeros((0, 0), np.int32)
_POSES = 100_000  # poses that are computed at a time


class ActorSweeps(NamedTuple):
    """Actors during n sweeps, in fields of `Sweeps`."""

    positions: Floats  # (a, n, 3): at the starts of the sweeps, meters, world coordinates
    rotations: Floats  # (a, n, 3, 3): from the actor's frame to the world frame
    velocities: Floats  # (a, n, 3): of the centers of the boxes, m/s
    bounds: Floats  # (a, 2, 3)
    present: Bools  # (a, n)
    comes: Bools  # (a, n)
    leaves: Bools  # (a, n)
    rows: Ints32  # (a, n): row of `knots`, -1 if the actor is static or absent
    knots: Floats32  # (r, k, 7), as of `relative_knots`: poses since the start of the sweep

    @classmethod
    def from_scene(cls, scene: Scene, starts_ns: Floats, stops_ns: Floats) -> ActorSweeps:
        """Return the actors of a scene in sweeps with these starts and last beams (n,).

        An actor that appears after the start of a sweep, or that has left, has the pose that it
        would have if it moved as fast as at that moment, with the same rotation: its boxes then
        move evenly from sweep to sweep.
        """
        shape = len(scene.actors), len(starts_ns)
        actors = [_OneActor.in_sweeps(actor, starts_ns, stops_ns) for actor in scene.actors]
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


class _OneActor(NamedTuple):
    """An actor during n sweeps."""

    positions: Floats  # (n, 3): scene frame, meters
    rotations: Floats  # (n, 3, 3)
    velocities: Floats  # (n, 3): of the center of the box, m/s
    present: Bools  # (n,)
    comes: Bools  # (n,)
    leaves: Bools  # (n,)
    moving: Bools  # (n,): whether it has knots
    knots: list[Floats32]  # (…, k, 7) of the sweeps with knots, in parts

    @classmethod
    def in_sweeps(cls, actor: Actor, starts_ns: Floats, stops_ns: Floats) -> _OneActor:
        """Return an actor in sweeps with these starts and last beams (n,)."""
        appears_ns, leaves_ns = presence_ns(actor.trajectory)
        poses = _poses(actor, starts_ns)
        lever_arms = matvec(poses.rotations, actor.bounds.mean(axis=0))
        present = (appears_ns <= starts_ns) & (starts_ns <= leaves_ns)
        comes = (starts_ns < appears_ns) & (appears_ns <= stops_ns)
        moving = (present | comes) & actor.trajectory.moves
        spans_ns = stops_ns - starts_ns
        count = knots_in(float(spans_ns.max(initial=0.0)), KNOT_NS)
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
    """Poses of an actor at times (k,), and their derivatives."""

    positions: Floats  # (k, 3): scene frame, meters
    rotations: Floats  # (k, 3, 3)
    speeds: Floats  # (k, 3): m/s
    rates: Floats  # (k, 3): rad/s


def _poses(actor: Actor, times_ns: Floats) -> _Poses:
    """Return the poses of an actor, extrapolated before it appears and after it has left."""
    trajectory = actor.trajectory
    within_ns = _times_of_presence(times_ns, *presence_ns(trajectory))
    positions, rotations = full_poses(trajectory, 0, within_ns)
    speeds, rates = velocities(trajectory, 0, within_ns)
    beyond_s = (times_ns - within_ns)[:, None] / 1e9
    return _Poses(positions + speeds * beyond_s, rotations, speeds, rates)


def _knots(actor: Actor, starts_ns: Floats, spans_ns: Floats, count: int) -> Iterator[Floats32]:
    """Yield the knots (…, count, 7) of an actor in sweeps, a part of the sweeps at a time."""
    sweeps = np.arange(len(starts_ns))
    for part in np.array_split(sweeps, -(-len(sweeps) * count // _POSES) or 1):
        times_ns = starts_ns[part, None] + np.linspace(0, 1, count) * spans_ns[part, None]
        poses = _poses(actor, times_ns.ravel())
        positions = poses.positions.reshape(len(part), count, 3)
        rotations = poses.rotations.reshape(len(part), count, 3, 3)
        yield relative_knots(positions - positions[:, :1], rotations)


def _times_of_presence(times_ns: Floats, appears_ns: float, leaves_ns: float) -> Floats:
    """Return the nearest times (n,) at which an actor is in the scene, within the rounding."""
    # A trajectory may be said to end by a clock of seconds since 1970, in steps of 2.4e-7 s.
    margin_ns = min(1e9 * CLOCK_S, (leaves_ns - appears_ns) / 2)
    present = (appears_ns <= times_ns) & (times_ns <= leaves_ns)
    return np.where(present, times_ns, times_ns.clip(appears_ns + margin_ns, leaves_ns - margin_ns))
