"""Find the firings of recorded sweeps whose pulses can hit inserted bodies."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from ..casting.motion import CastPoses
from ..motion.trajectory import full_poses
from ..numerics.arrays import Bools, Floats
from ..numerics.vectors import dot, norm, rotate_into_frames
from ..scene.scene import Scene
from ..sensor.disc import Beam

_BLOCK_BEAMS = 1024  # number of consecutive beams that are treated alike


def firings_near_bodies(
    scene: Scene,
    beam: Beam,
    poses: CastPoses,
    firing_ns: Floats,
    directions: Floats,
    origins: Floats | None = None,
) -> Bools:
    """Return whether any sub-ray of each firing can hit a body of a scene.

    Bodies are replaced by their bounding spheres.

    Parameters
    ----------
    scene
        Static objects and actors. The first object is ignored.
    beam
        Sub-rays of the beams.
    poses
        Poses of all beams, or of each firing.
    firing_ns
        (f,): times of the firings in nanoseconds, on the clock of the actors.
    directions
        (f, c, 3): unit directions of the beams in the frame of the poses.
    origins
        (f, c, 3): origins of the beams in the same frame in meters, or None.
    """
    spread_rad = float(norm(beam.angles).max())
    offset_m = 0.0 if beam.starts is None else float(norm(beam.starts).max())
    near = np.zeros(len(firing_ns), np.bool_)
    for center, radius_m in _spheres(scene, firing_ns):
        toward = np.broadcast_to(center - poses.positions, (len(firing_ns), 3))
        if poses.rotations is not None:
            toward = rotate_into_frames(
                toward, np.broadcast_to(poses.rotations, (len(firing_ns), 3, 3))
            )
        toward = toward[:, None] if origins is None else toward[:, None] - origins
        components = np.moveaxis(toward, 2, 0)
        squared = dot(components, components)
        along = dot(components, np.moveaxis(directions, 2, 0))
        reach_m = radius_m + offset_m + spread_rad * np.sqrt(squared)
        meets = (along > -reach_m) & (squared - along * along < reach_m * reach_m)
        near |= meets.any(axis=1)
    return near


def ranges_of_firings(near: Bools, channels: int) -> Iterator[tuple[int, int, bool]]:
    """Divide firings into ranges that are near bodies and ranges that are not.

    `near` (f,) is the result of `firings_near_bodies`. Ranges consist of whole blocks of firings,
    so that there are few of them. Each is a tuple of the first firing, one past the last, and
    whether the range is near a body.
    """
    block = max(_BLOCK_BEAMS // channels, 1)
    blocks = np.logical_or.reduceat(near, np.arange(0, len(near), block))
    changes = np.flatnonzero(blocks[1:] != blocks[:-1]) + 1
    starts = np.concatenate([[0], changes * block, [len(near)]]).tolist()
    for start, stop in pairwise(starts):
        yield start, stop, bool(blocks[start // block])


def _spheres(scene: Scene, firing_ns: Floats) -> Iterator[tuple[Floats, float]]:
    """Yield the center (3,) or (f, 3) and the radius of each body, in the scene frame in meters."""
    for low, high in scene.object_bounds[1:]:
        yield (low + high) / 2, float(norm(high - low)) / 2
    for actor in scene.actors:
        low, high = actor.bounds
        positions, _ = full_poses(actor.trajectory, 0, firing_ns)
        # The box rotates about the origin of the actor.
        yield positions, float(norm(np.maximum(np.abs(low), np.abs(high))))
