"""Ray casting with Embree, as Open3D ships it."""

from __future__ import annotations

import importlib.util
import threading
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .backend import Backend, Found
from .clip import clip
from .mesh import LocalMesh
from .rays import Rays
from .refine import Refiner
from .tree import PAD

_MISS = 0xFFFFFFFF

# Embree decides in float32: a start this much farther on, in local units, is surely beyond a
# surface that refinement put just before the start.
_NUDGE = 2.0**-20


@dataclass(frozen=True)
class _Pairs:
    """Hits: number of the ray, local distance, row of the mesh's corners; (k,) each."""

    ray: NDArray[np.intp]
    t: NDArray[np.float64]
    place: NDArray[np.intp]

    def only(self, rows: NDArray[Any]) -> _Pairs:
        """Return some of the hits."""
        return _Pairs(self.ray[rows], self.t[rows], self.place[rows])


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
        self._refine = Refiner(mesh)
        low, high = mesh.box
        self._low, self._high = low - PAD, high + PAD
        self._local = threading.local()  # threads of one worker may cast at the same time

    def closest(self, rays: Rays, weights: bool) -> Found:
        """See `Backend.closest`."""
        origins, directions = self._mesh.to_local(rays.origins), rays.directions
        t_min, t_max = rays.t_min * self._mesh.scale, rays.t_max * self._mesh.scale
        hits = self._cast(origins, directions, 0.0)
        early = hits.t < t_min
        if early.any():
            hits = self._beyond(hits, early, origins, directions, t_min)
        if t_max < np.inf:
            hits = hits.only(hits.t <= t_max)
        u = v = np.zeros(0)
        if weights:
            at = _of(origins, hits.ray)
            u, v = self._refine.weights(at, directions[hits.ray], hits.place)
        return Found(hits.ray, hits.t, self._mesh.index[hits.place], u, v)

    def _beyond(
        self,
        hits: _Pairs,
        early: NDArray[np.bool_],
        origins: NDArray[np.float64],
        directions: NDArray[np.float64],
        t_min: float,
    ) -> _Pairs:
        """Replace hits before `t_min` by the next ones behind it."""
        parts = [hits.only(~early)]
        ray = hits.ray[early]
        for start in (t_min, t_min + _NUDGE, t_min + 4 * _NUDGE):
            again = self._cast(_of(origins, ray), directions[ray], start)
            again = _Pairs(ray[again.ray], again.t, again.place)
            parts.append(again.only(again.t >= t_min))
            ray = again.ray[again.t < t_min]
            if not len(ray):
                break
        joined = _Pairs(
            np.concatenate([part.ray for part in parts]),
            np.concatenate([part.t for part in parts]),
            np.concatenate([part.place for part in parts]),
        )
        return joined.only(np.argsort(joined.ray))

    def _cast(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64], start: float
    ) -> _Pairs:
        """Closest hits at or behind `start`, up to float32 rounding; lengths are local."""
        n = len(directions)
        if self._scene is None or not n:
            return _Pairs(np.zeros(0, np.intp), np.zeros(0), np.zeros(0, np.intp))
        buffer = self._rows(n)
        buffer[:, 3:] = directions
        begin = np.zeros(1)
        if start == 0 and ((origins >= self._low) & (origins <= self._high)).all():
            buffer[:, :3] = origins
        else:
            # Start at the scene's box: then float32 rounds by the scene's size, not by the way.
            entry, _ = clip(self._low, self._high, origins, directions)
            begin = np.maximum(entry, start)
            # From so far away that float64 cannot place the start, it stays near the scene.
            buffer[:, :3] = np.clip(origins + begin[:, None] * directions, -2, 2)
        answer = self._scene.cast_rays(self._tensor(buffer), nthreads=self._threads)
        face = answer["primitive_ids"].numpy()
        ray = np.flatnonzero(face != _MISS)
        rough = answer["t_hit"].numpy()[ray] + _of(begin, ray)
        place = face[ray].astype(np.intp)
        t = self._refine.distance(_of(origins, ray), directions.take(ray, axis=0), place, rough)
        return _Pairs(ray, t, place)

    def _rows(self, n: int) -> NDArray[np.float32]:
        """Room for n rays; kept, since fresh pages cost a quarter of what the cast does."""
        kept: NDArray[np.float32] | None = getattr(self._local, "rows", None)
        if kept is None or len(kept) < n:
            kept = self._local.rows = np.empty((n, 6), np.float32)
        return kept[:n]


def _of(values: NDArray[np.float64], rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """Rows of what is either one for all or one a ray."""
    return values if len(values) == 1 else values.take(rows, axis=0)
