"""Animations of meshes: people who walk, wheels that turn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..base.arrays import Floats, Indices
from ..base.errors import LidarError
from ..base.validation import as_array, checked_fields
from ..base.vectors import turned

RATE_HZ = 60.0  # of poses that are baked, at least
PICTURED = 500_000  # most vertices in all poses of a mesh in pictures; a walk's compress to 1.4 B


@dataclass(frozen=True, eq=False)
@checked_fields
class Animation:
    """Poses of a mesh, evenly spaced, between which its vertices move straight.

    Actors of one mesh share it; each plays it by its own clock, see `Actor.played`.

    Parameters
    ----------
    vertices
        float64 (f, v, 3): the mesh's vertices in at least two poses, metres, in its own axes.
    step_s
        From each pose to the next, seconds.
    speed_m_s
        Speed of an actor that plays it as fast as it was made: at half of that it plays half as
        fast, and an actor that stands stays as it is. None plays it by time.
    repeat
        Whether it begins again, else its last pose remains.

    Raises
    ------
    LidarError
        If there are no two poses, a number is not finite, or the step or speed is not above 0.
    """

    vertices: Floats
    step_s: float
    speed_m_s: float | None = None
    repeat: bool = True

    def __post_init__(self) -> None:
        poses = as_array("vertices of an animation", self.vertices)
        object.__setattr__(self, "vertices", np.ascontiguousarray(poses))
        shape = np.shape(self.vertices)
        speed = self.speed_m_s
        good = len(shape) == 3 and shape[0] > 1 and shape[1] > 0 and shape[2] == 3
        good = good and self.step_s > 0 and (speed is None or speed > 0)
        if not good or not np.isfinite(self.vertices).all():
            raise LidarError(
                "An animation has finite vertices (f, v, 3) of two poses at least, and a step and "
                f"speed above 0; given: {shape}, {self.step_s} s, {speed} m/s."
            )

    @property
    def duration_s(self) -> float:
        """From the first to the last pose."""
        return (len(self.vertices) - 1) * self.step_s

    def frames(self, seconds: Floats) -> Floats:
        """Return frames (n,) at seconds since the first pose: 1.5 is half way from the second."""
        last = len(self.vertices) - 1
        frames = seconds / self.step_s
        return np.mod(frames, last) if self.repeat else np.clip(frames, 0, last)

    def at(self, frames: Floats, vertex: Indices | slice = slice(None)) -> tuple[Floats, Floats]:
        """Return vertices of numbers (n, k), or all, at frames (n,), and their steps: (n, k, 3)."""
        begin = frames.astype(np.int64).clip(0, len(self.vertices) - 2)
        share = (frames - begin)[:, None, None]
        begin = begin if isinstance(vertex, slice) else begin[:, None]
        here = self.vertices[begin, vertex]
        then = self.vertices[begin + 1, vertex]
        return (1 - share) * here + share * then, then - here

    @cached_property
    def pictured(self) -> Animation:
        """The same for pictures: fewer poses if they have many vertices, rounded to 1/1024 m."""
        steps = min(len(self.vertices), max(PICTURED // self.vertices.shape[1], 2)) - 1
        poses, _ = self.at(np.linspace(0, len(self.vertices) - 1, steps + 1))
        return replace(self, vertices=np.round(1024 * poses) / 1024, step_s=self.duration_s / steps)

    @cached_property
    def bounds(self) -> Floats:
        """Corners of the box of all poses: (2, 3)."""
        return np.stack([self.vertices.min(axis=(0, 1)), self.vertices.max(axis=(0, 1))])

    def bounds_between(self, first_s: Floats, last_s: Floats) -> Floats:
        """Boxes of all poses between seconds (n,) since the first pose: (n, 2, 3)."""
        last = len(self.vertices) - 1
        ends = np.stack([first_s, last_s]) / self.step_s
        ends = ends if self.repeat else ends.clip(0, last)
        first = np.floor(ends[0]).astype(np.int64)
        steps = np.ceil(ends[1]).astype(np.int64) - first  # 0 while it keeps a pose
        lows = self.vertices.min(axis=1)
        highs = self.vertices.max(axis=1)
        low = np.full((len(first), 3), np.inf)
        high = np.full((len(first), 3), -np.inf)
        for step in range(max(1, min(int(steps.max(initial=0)), last))):
            begin = first + np.minimum(step, (steps - 1).clip(0))
            begin = begin % last if self.repeat else begin
            for frame in (begin, begin + (steps > 0)):
                low = np.minimum(low, lows[frame])
                high = np.maximum(high, highs[frame])
        return np.stack([low, high], axis=1)

    def moved(self, linear: Floats, offset: Floats) -> Animation:
        """Return it with all vertices at p -> linear @ p + offset."""
        points = turned(self.vertices.reshape(-1, 3), linear) + offset
        return replace(self, vertices=points.reshape(self.vertices.shape))
