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
from .hits import Returns
from .memory import Meter, require
from .mesh import LocalMesh
from .rays import Pattern, Rays
from .refine import Refiner
from .tree import PAD
from .workspace import Workspace

_MISS = 0xFFFFFFFF

# Embree decides in float32, and may find again what refinement put just before the start. So the
# start moves on, in local units: a little for most surfaces, and for those that a ray grazes, along
# which float32 sees less sharply, as much as it takes.
_STARTS = (0.0, *(4.0**k * 2**-20 for k in range(6)))

# A ray that starts farther from zero than this, in local units, is begun at the scene's box:
# then float32 rounds by the scene's size, not by the way to it.
_NEAR = 2.0

_PAIR_BYTES = 24  # a hit in _Pairs

# A triangle, at the peak of a build, the mesh apart: some 110 of them are Embree's own, which
# Open3D 0.20 was seen to take.
_BYTES = 300


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
    # Smaller chunks, which stay in a core's level 2 cache, gain less there than more calls cost.
    chunk: ClassVar[int] = 1 << 16

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
        n = len(mesh.corners)
        require(_BYTES * n, f"Embree's tree over {n:,} triangles", "use a smaller mesh")
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
        origins, scale = self._mesh.to_local(rays.origins), self._mesh.scale
        hits = self._within(rays.directions, None, origins, rays.t_min * scale, rays.t_max * scale)
        u = v = np.zeros(0)
        if weights:
            at = _of(origins, hits.ray)
            u, v = self._refine.weights(at, rays.directions[hits.ray], hits.place)
        return Found(hits.ray, hits.t, self._mesh.index[hits.place], u, v)

    def scan(
        self,
        pattern: Pattern,
        window: tuple[int, int],
        origin: NDArray[np.float64],
        rotation: NDArray[np.float64] | None,
        interval: tuple[float, float],
    ) -> Returns:
        """See `Backend.scan`; rays are turned where Embree reads them, a chunk at a time."""
        origins, scale = self._mesh.to_local(origin), self._mesh.scale
        t_min, t_max = interval[0] * scale, interval[1] * scale
        first, last = window
        parts, meter = [], Meter("Joining the hits", "scan a smaller window at a time")
        for start in range(first, max(last, first + 1), self.chunk):
            directions = pattern.directions[start : min(start + self.chunk, last)]
            hits = self._within(directions, rotation, origins, t_min, t_max)
            np.add(hits.ray, start - first, out=hits.ray)
            parts.append(hits)
            meter.add(_PAIR_BYTES * len(hits.ray))
        hits = _joined(parts)
        np.divide(hits.t, scale, out=hits.t)
        return Returns(hits.ray.astype(np.uint32), hits.t, self._mesh.index.take(hits.place))

    def along(self, rays: Rays) -> NDArray[np.int32]:
        """See `Backend.along`; of triangles at one distance Open3D lists one."""
        if self._scene is None or not len(rays):
            return np.zeros(0, np.int32)
        origins, scale = self._mesh.to_local(rays.origins), self._mesh.scale
        entry, _ = clip(self._low, self._high, origins, rays.directions)
        rows = np.empty((len(rays), 6), np.float32)
        rows[:, :3] = np.clip(origins + entry[:, None] * rays.directions, -_NEAR, _NEAR)
        rows[:, 3:] = rays.directions
        answer = self._scene.list_intersections(self._tensor(rows), nthreads=self._threads)
        ray = answer["ray_ids"].numpy().astype(np.intp)
        place = answer["primitive_ids"].numpy().astype(np.intp)
        rough = answer["t_hit"].numpy() + entry.take(ray)
        unit = rays.directions.take(ray, axis=0).T
        t = self._refine.distance(_of(origins, ray), unit, place, rough)
        hit = (t >= rays.t_min * scale) & (t <= rays.t_max * scale)
        found: NDArray[np.int32] = self._mesh.index[place[hit]]
        return found

    def _within(
        self,
        directions: NDArray[np.float64],
        rotation: NDArray[np.float64] | None,
        origins: NDArray[np.float64],
        t_min: float,
        t_max: float,
    ) -> _Pairs:
        """Closest hits between two distances of rays whose directions are yet to be turned."""
        if self._scene is None or not len(directions):
            return _Pairs(np.zeros(0, np.intp), np.zeros(0), np.zeros(0, np.intp))
        desk = self._desk(len(directions))
        unit = desk.turn(directions, rotation)
        hits = self._cast(desk, unit, origins, 0.0)
        early = hits.t < t_min
        if early.any():  # a refined distance may be just below 0 as well
            hits = self._beyond(desk, hits, early, unit, origins, t_min)
        return hits.only(hits.t <= t_max) if t_max < np.inf else hits

    def _beyond(
        self,
        desk: Workspace,
        hits: _Pairs,
        early: NDArray[np.bool_],
        unit: NDArray[np.float64],
        origins: NDArray[np.float64],
        t_min: float,
    ) -> _Pairs:
        """Replace hits before `t_min` by the next ones behind it."""
        parts = [hits.only(~early)]
        ray = hits.ray[early]
        directions = unit[:, ray].T  # a copy: the workspace is about to be used again
        for ahead in _STARTS:
            turned = desk.turn(directions, None)
            again = self._cast(desk, turned, _of(origins, ray), t_min + ahead)
            parts.append(_Pairs(ray[again.ray], again.t, again.place).only(again.t >= t_min))
            left = again.ray[again.t < t_min]
            ray, directions = ray[left], directions[left]
            if not len(ray):
                break
        joined = _joined(parts)
        return joined.only(np.argsort(joined.ray))

    def _cast(
        self,
        desk: Workspace,
        unit: NDArray[np.float64],
        origins: NDArray[np.float64],
        start: float,
    ) -> _Pairs:
        """Closest hits at or behind `start`, up to float32 rounding; lengths are local.

        Parameters
        ----------
        desk
            Its rows hold the directions already.
        unit
            (3, n): the same directions in float64.
        origins
            (n, 3) or (1, 3).
        start
            Distance along the rays.
        """
        begin, starts = np.zeros(1), origins
        near = np.abs(origins).max(axis=1) <= _NEAR
        if start > 0 or not near.all():
            entry, _ = clip(self._low, self._high, origins, unit.T)
            begin = np.maximum(np.where(near, 0, entry), start)
            # From so far away that float64 cannot place the start, it stays near the scene.
            starts = np.clip(origins + begin[:, None] * unit.T, -_NEAR, _NEAR)
        rows = desk.start(unit.shape[1], starts)
        answer = self._scene.cast_rays(self._tensor(rows), nthreads=self._threads)
        face = answer["primitive_ids"].numpy()
        ray = np.flatnonzero(face != _MISS)
        place = face.take(ray).astype(np.intp)
        rough = answer["t_hit"].numpy().take(ray) + _of(begin, ray)
        t = self._refine.distance(_of(origins, ray), unit.take(ray, axis=1), place, rough)
        return _Pairs(ray, t, place)

    def _desk(self, rays: int) -> Workspace:
        """Workspace of this thread, for that many rays at least."""
        kept: Workspace | None = getattr(self._local, "desk", None)
        if kept is None or kept.size < rays:
            kept = self._local.desk = Workspace(rays)
        return kept


def _joined(parts: list[_Pairs]) -> _Pairs:
    if len(parts) == 1:
        return parts[0]
    return _Pairs(
        np.concatenate([part.ray for part in parts]),
        np.concatenate([part.t for part in parts]),
        np.concatenate([part.place for part in parts]),
    )


def _of(values: NDArray[np.float64], rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """Rows of what is either one for all or one a ray."""
    return values if len(values) == 1 else values.take(rows, axis=0)
