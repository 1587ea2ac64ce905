"""Every triangle along a ray, in NumPy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from . import triangle as exact
from .clip import clip
from .traverse import Walker, _Best, _Bundle, _bundle
from .tree import LEAF_BITS

Float = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass
class _Along(_Best):
    """All hits so far: rows of `faces`, in pieces; `t` stays at the limit."""

    faces: list[NDArray[np.int32]] = field(default_factory=list)


class Crossings(Walker):
    """A walker that can also go on behind the closest hit."""

    def along(
        self, origins: Float, directions: Float, t_min: float, t_max: float
    ) -> NDArray[np.int32]:
        """Rows of `faces`, once for each ray that meets them; parameters as for `closest`."""
        entry, leave = clip(self._low, self._high, origins, directions)
        row = np.flatnonzero(entry <= leave)
        none = np.zeros(0)
        hits = _Along(np.full(len(row), t_max), np.zeros(0, np.int32), none, none)
        if len(row):
            rays = _bundle(origins[row], directions[row], entry[row], t_max)
            self._walk(rays, hits, t_min)
        return np.concatenate([np.zeros(0, np.int32), *hits.faces])

    def _test(self, rays: _Bundle, best: _Best, t_min: float, ray: Index, leaf: Index) -> None:
        """Test rays against the triangles of leaves and keep what is asked for."""
        if not isinstance(best, _Along):
            super()._test(rays, best, t_min, ray, leaf)
            return
        count = (leaf & ((1 << LEAF_BITS) - 1)) + 1
        ray = np.repeat(ray, count)
        step = np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
        place = np.repeat(leaf >> LEAF_BITS, count) + step
        a, b, c, det, t = exact.intersect(rays.sheared, ray, self._corners, place)
        met = exact.inside(a, b, c, det) & (t >= t_min) & (t <= best.t.take(ray))
        best.faces.append(self._face[place[met]])
