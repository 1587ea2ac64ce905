"""Ray casting with Embree, as Open3D ships it."""

from __future__ import annotations

import importlib.util
import threading
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from . import triangle as exact
from .backend import Backend, Found
from .clip import clip
from .mesh import LocalMesh
from .rays import Rays
from .tree import PAD

_MISS = 0xFFFFFFFF

# Embree decides in float32: a start this much farther on, in local units, is surely beyond a
# surface that refinement put just before the start.
_NUDGE = 2.0**-20


class EmbreeBackend(Backend):
    """Open3D's RaycastingScene; the winner's distance is worked out again in float64.

    Embree decides in float32 which triangle is hit. Surfaces nearer to each other, or to the
    ray's start, than about 1e-6 of the scene's size are not told apart.
    """

    name: ClassVar[str] = "embree"
    chunk: ClassVar[int] = 1 << 17

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        if importlib.util.find_spec("open3d") is None:
            return "Open3D is not installed: pip install open3d-cpu (Linux x86_64) or open3d"
        try:
            import open3d  # noqa: F401
        except (ImportError, OSError) as error:
            return (
                f"Open3D does not load ({error}); on Debian and Ubuntu it needs the packages "
                "libegl1 libgl1 libgomp1 libusb-1.0-0"
            )
        return ""

    def __init__(
        self, mesh: LocalMesh, threads: int | None = None, device: int | None = None
    ) -> None:
        import open3d

        super().__init__(mesh, threads, device)
        self._threads = threads or 0  # 0: Open3D takes every core
        self._tensor = open3d.core.Tensor.from_numpy
        self._scene: Any = None
        if len(mesh.corners):  # an empty scene is an error to Open3D
            points = mesh.corners.reshape(-1, 3).astype(np.float32)
            rows = np.arange(len(points), dtype=np.uint32).reshape(-1, 3)
            self._scene = open3d.t.geometry.RaycastingScene(nthreads=self._threads)
            self._scene.add_triangles(self._tensor(points), self._tensor(rows))
        low, high = mesh.box
        self._low, self._high = low - PAD, high + PAD
        self._local = threading.local()  # threads of one worker may cast at the same time

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        origins = self._mesh.to_local(rays.origins)
        t_min, t_max = rays.t_min * self._mesh.scale, rays.t_max * self._mesh.scale
        found = self._cast(origins, rays.directions, 0.0)
        early = found.t < t_min
        if early.any():
            found = self._beyond(found, early, origins, rays.directions, t_min)
        return _only(found, found.t <= t_max)

    def _beyond(
        self,
        found: Found,
        early: NDArray[np.bool_],
        origins: NDArray[np.float64],
        directions: NDArray[np.float64],
        t_min: float,
    ) -> Found:
        """Replace hits before `t_min` by the next ones behind it."""
        parts = [_only(found, ~early)]
        ray = found.ray[early]
        for start in (t_min, t_min + _NUDGE, t_min + 4 * _NUDGE):
            at = origins if len(origins) == 1 else origins[ray]
            again = self._cast(at, directions[ray], start)
            again = Found(ray[again.ray], again.t, again.triangle, again.u, again.v)
            parts.append(_only(again, again.t >= t_min))
            ray = again.ray[again.t < t_min]
            if not len(ray):
                break
        joined = Found(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("ray", "t", "triangle", "u", "v")
            )
        )
        return _only(joined, np.argsort(joined.ray))

    def _cast(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64], start: float
    ) -> Found:
        """Closest hits at or behind `start`, up to float32 rounding; lengths are local."""
        n = len(directions)
        if self._scene is None or not n:
            return _only(_NOTHING, slice(0))
        buffer = self._rows(n)
        buffer[:, 3:] = directions
        inside = ((origins >= self._low) & (origins <= self._high)).all()
        if inside and start == 0:
            buffer[:, :3] = origins
        else:
            # Start at the scene's box: then float32 rounds by the scene's size, not by the way.
            entry, _ = clip(self._low, self._high, origins, directions)
            buffer[:, :3] = origins + np.maximum(entry, start)[:, None] * directions
        answer = self._scene.cast_rays(self._tensor(buffer), nthreads=self._threads)
        face = answer["primitive_ids"].numpy()
        ray = np.flatnonzero(face != _MISS)
        weights = answer["primitive_uvs"].numpy()[ray].astype(np.float64)
        at = np.broadcast_to(origins, directions.shape)[ray]
        return self._refine(ray, at, directions[ray], face[ray].astype(np.intp), weights)

    def _rows(self, n: int) -> NDArray[np.float32]:
        """Room for n rays; kept, since fresh pages cost a quarter of what the cast does."""
        kept: NDArray[np.float32] | None = getattr(self._local, "rows", None)
        if kept is None or len(kept) < n:
            kept = self._local.rows = np.empty((n, 6), np.float32)
        return kept[:n]

    def _refine(
        self,
        ray: NDArray[np.intp],
        origins: NDArray[np.float64],
        directions: NDArray[np.float64],
        place: NDArray[np.intp],
        weights: NDArray[np.float64],
    ) -> Found:
        """Distance and weights of known hits in float64."""
        corners = self._mesh.corners
        a, b, c, det, t = exact.intersect(
            exact.shear(origins, directions), np.arange(len(ray)), corners, place
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = b / det, c / det
        out = np.flatnonzero(~exact.inside(a, b, c, det))
        if len(out):
            # The ray passes just outside the triangle, and where it also grazes, the plane may
            # be far away: take the point that Embree means.
            one, two = weights[out].clip(0, 1).T
            two = np.minimum(two, 1 - one)
            three = corners[place[out]]
            point = (
                (1 - one - two)[:, None] * three[:, 0]
                + one[:, None] * three[:, 1]
                + two[:, None] * three[:, 2]
            )
            u[out], v[out] = one, two
            t[out] = ((point - origins[out]) * directions[out]).sum(axis=1)
        return Found(ray, t, self._mesh.index[place], u, v)


_NOTHING = Found(np.zeros(0, np.intp), np.zeros(0), np.zeros(0, np.int32), np.zeros(0), np.zeros(0))


def _only(found: Found, rows: Any) -> Found:
    return Found(found.ray[rows], found.t[rows], found.triangle[rows], found.u[rows], found.v[rows])
