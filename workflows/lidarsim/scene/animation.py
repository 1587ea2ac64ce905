"""Animations of meshes: people who walk, wheels that turn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats, Indices
from ..numerics.vectors import rotate
from ..schema.checks import as_array, check_fields
from ..schema.value_texts import one_line

RATE_HZ = 60.0  # least rate of baked poses
# Vertices in all poses of a mesh in pictures; the vertices of a walk compress to 1.4 bytes each.
MAX_PICTURED_VERTICES = 500_000


@dataclass(frozen=True, eq=False)
class Animation:
    """Poses of a mesh, evenly spaced, between which its vertices move straight.

    Actors of the same mesh share the animation; each plays it by its own clock
    (`Actor.played`).

    Parameters
    ----------
    vertices
        float64 (f, v, 3): the mesh's vertices in at least two poses, meters, in the mesh's frame.
    step_s
        Time from each pose to the next, seconds.
    speed_m_s
        Speed of an actor that plays the animation in real time, m/s: an actor of half the speed
        plays at half the rate, and a static actor keeps its pose. None plays by time.
    repeat
        Whether the animation starts again after its end; else the last pose remains.

    Raises
    ------
    LidarError
        If there are less than two poses, a number is not finite, or the step or speed is not
        above 0.
    """

    vertices: Floats
    step_s: float
    speed_m_s: float | None = None
    repeat: bool = True

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        poses = as_array("vertices of an animation", self.vertices)
        object.__setattr__(self, "vertices", np.ascontiguousarray(poses))
        shape = np.shape(self.vertices)
        speed = self.speed_m_s
        valid = len(shape) == 3 and shape[0] > 1 and shape[1] > 0 and shape[2] == 3
        valid = valid and self.step_s > 0 and (speed is None or speed > 0)
        if not valid or not np.isfinite(self.vertices).all():
            raise LidarError(
                "An animation requires finite vertices (f, v, 3) with at least two poses and a "
                f"positive step and speed, but has vertices {shape}, a step of {self.step_s} s "
                f"and a speed of {speed} m/s."
            )

    @property
    def duration_s(self) -> float:
        """Time from the first to the last pose, seconds."""
        return (len(self.vertices) - 1) * self.step_s

    def frames(self, seconds: Floats) -> Floats:
        """Return frames (n,) at seconds (n,) since the first pose.

        Frame 1.5 is half way from the second pose to the third.
        """
        last = len(self.vertices) - 1
        frames = seconds / self.step_s
        return np.mod(frames, last) if self.repeat else np.clip(frames, 0, last)

    def vertices_at(
        self, frames: Floats, vertex: Indices | slice = slice(None)
    ) -> tuple[Floats, Floats]:
        """Return vertices (n, k, 3) at frames (n,), and their steps (n, k, 3) to the next pose.

        `vertex` (n, k) selects vertices by their indices.
        """
        first_pose = frames.astype(np.int64).clip(0, len(self.vertices) - 2)
        share = (frames - first_pose)[:, None, None]
        first_pose = first_pose if isinstance(vertex, slice) else first_pose[:, None]
        start = self.vertices[first_pose, vertex]
        stop = self.vertices[first_pose + 1, vertex]
        return (1 - share) * start + share * stop, stop - start

    @cached_property
    def pictured(self) -> Animation:
        """Animation for pictures: fewer poses of many vertices, rounded to 1/1024 m."""
        steps = min(len(self.vertices), max(MAX_PICTURED_VERTICES // self.vertices.shape[1], 2)) - 1
        poses, _ = self.vertices_at(np.linspace(0, len(self.vertices) - 1, steps + 1))
        return replace(self, vertices=np.round(1024 * poses) / 1024, step_s=self.duration_s / steps)

    @cached_property
    def bounds(self) -> Floats:
        """Lowest and highest corner of all poses, meters: (2, 3)."""
        return np.stack([self.vertices.min(axis=(0, 1)), self.vertices.max(axis=(0, 1))])

    def moved(self, linear: Floats, offset: Floats) -> Animation:
        """Return the animation with all vertices at p -> linear @ p + offset."""
        points = rotate(self.vertices.reshape(-1, 3), linear) + offset
        return replace(self, vertices=points.reshape(self.vertices.shape))
