"""Mesh animations, such as walking people and rotating wheels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats, Indices
from ..numerics.vectors import rotate
from ..schema.checks import as_array, check_fields
from ..schema.value_texts import one_line

RATE_HZ = 60.0  # minimum frame rate when animations are baked
# Limit for the vertices of all keyframes in pictures. A walk compresses to 1.4 bytes per vertex.
MAX_PICTURED_VERTICES = 500_000


@dataclass(frozen=True, eq=False)
class Animation:
    """A mesh animation with evenly spaced keyframes and linear interpolation.

    Actors with the same mesh share the animation, but each actor plays it at its own rate
    (`Actor.frames_at`).

    Parameters
    ----------
    vertices
        Vertices of the mesh at two or more keyframes in the frame of the mesh, in meters. Shape
        (f, v, 3), float64.
    step_s
        Time between two keyframes in seconds.
    speed_m_s
        Speed at which an actor plays the animation in real time, in m/s. An actor at half this
        speed plays it at half the rate, and a stationary actor keeps its pose. With None, the
        playback rate does not depend on the speed.
    repeat
        Whether the animation repeats. Otherwise, the mesh keeps the last pose.

    Raises
    ------
    LidarError
        If there are fewer than two keyframes, a number is not finite, or the step or the speed is
        not positive.
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
        """Duration from the first to the last keyframe in seconds."""
        return (len(self.vertices) - 1) * self.step_s

    def frames(self, seconds: Floats) -> Floats:
        """Return the frame numbers at the given times.

        Times are in seconds since the first keyframe. Frame numbers can be fractional: frame 1.5 is
        halfway between the second and the third keyframe.
        """
        last = len(self.vertices) - 1
        frames = seconds / self.step_s
        return np.mod(frames, last) if self.repeat else np.clip(frames, 0, last)

    def vertices_at(
        self, frames: Floats, vertex: Indices | slice = slice(None)
    ) -> tuple[Floats, Floats]:
        """Return interpolated vertices and their displacements between adjacent keyframes.

        Frame numbers have shape (n,), and both results have shape (n, k, 3). To select vertices for
        each frame, pass their indices as `vertex` with shape (n, k).
        """
        first_pose = frames.astype(np.int64).clip(0, len(self.vertices) - 2)
        fraction = (frames - first_pose)[:, None, None]
        first_pose = first_pose if isinstance(vertex, slice) else first_pose[:, None]
        start = self.vertices[first_pose, vertex]
        stop = self.vertices[first_pose + 1, vertex]
        return (1 - fraction) * start + fraction * stop, stop - start

    @cached_property
    def for_pictures(self) -> Animation:
        """Animation for rendering, with fewer keyframes if the mesh has many vertices.

        Coordinates are rounded to 1/1024 m.
        """
        steps = min(len(self.vertices), max(MAX_PICTURED_VERTICES // self.vertices.shape[1], 2)) - 1
        poses, _ = self.vertices_at(np.linspace(0, len(self.vertices) - 1, steps + 1))
        return replace(self, vertices=np.round(1024 * poses) / 1024, step_s=self.duration_s / steps)

    @cached_property
    def bounds(self) -> Floats:
        """Bounding box of all keyframes in meters.

        The shape is (2, 3).
        """
        return np.stack([self.vertices.min(axis=(0, 1)), self.vertices.max(axis=(0, 1))])

    def affine_transform(self, linear: Floats, offset: Floats) -> Animation:
        """Return the animation transformed by p -> linear @ p + offset."""
        points = rotate(self.vertices.reshape(-1, 3), linear) + offset
        return replace(self, vertices=points.reshape(self.vertices.shape))
