"""Meshes whose vertices move: each ray meets the mesh as it is at the ray's own time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .arrays import Floats, Ints
from .crossing import Crossing, Nearest, strike
from .hits import Part, joined
from .rays import Rays
from .triangle import inside, intersect, shear

_PAIRS = 1 << 16  # of rays and triangles at a time: 5 MB of corners


@dataclass(frozen=True, eq=False)
class Bending:
    """A mesh whose vertices move evenly from frame to frame: a shape of `Moving`.

    All triangles are compared with each ray, so it is meant for some hundreds of them.

    Attributes
    ----------
    vertices
        float64 (f, v, 3), metres: at least two frames.
    faces
        int64 (t, 3).
    times
        float64 (f,): of the frames, ascending, as those of rays. Before the first and after the
        last it stays as it is there.
    """

    vertices: Floats
    faces: Ints
    times: Floats
    on_device: ClassVar[bool] = False  # as of `RayCaster`

    @property
    def box(self) -> Floats:
        """Low and high corner of all frames: (2, 3)."""
        return np.stack([self.vertices.min(axis=(0, 1)), self.vertices.max(axis=(0, 1))])

    def at(self, times: Floats) -> Floats:
        """Return the vertices at times (n,): (n, v, 3)."""
        frame = np.searchsorted(self.times, times, side="right") - 1
        frame = frame.clip(0, len(self.times) - 2)
        begin, end = self.times[frame], self.times[frame + 1]
        share = ((times - begin) / (end - begin)).clip(0, 1)[:, None, None]
        return np.asarray((1 - share) * self.vertices[frame] + share * self.vertices[frame + 1])

    def strike(self, crossing: Crossing, nearest: Nearest) -> None:
        """See `RayCaster.strike`; of equally close triangles the lowest is hit."""
        strike(self._cast, crossing, nearest)

    def _cast(self, rays: Rays, times: Floats) -> Part:
        count = len(self.faces)
        parts: list[Part] = []
        step = max(1, _PAIRS // count)
        for start in range(0, len(rays), step):
            some = rays.part(start, start + step)
            n = len(some)
            corners = self.at(times[start : start + step])[:, self.faces].reshape(-1, 3, 3)
            sheared = shear(np.broadcast_to(some.origins, (n, 3)), some.directions)
            pair = np.arange(n * count)
            a, b, c, det, t = intersect(sheared, pair // count, corners, pair)
            hit = inside(a, b, c, det) & (t >= rays.t_min) & (t <= rays.t_max)
            t = np.where(hit, t, np.inf).reshape(n, count)
            triangle = t.argmin(axis=1)
            ray = np.flatnonzero(hit.reshape(n, count).any(axis=1))
            number, triangle = (start + ray).astype(np.uint32), triangle[ray].astype(np.int32)
            parts.append((number, t[ray, triangle], triangle, np.zeros(len(ray), np.int32)))
        return joined(parts)
