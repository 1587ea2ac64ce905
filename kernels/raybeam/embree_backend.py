"""Ray casting with Embree, as embreex ships it."""

from __future__ import annotations

import importlib.util
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from . import embree_library
from .arrays import AnyArray, Floats, Indices, Integers, Ints, Ints32
from .backend import Backend, Found
from .hits import ScanReturns
from .instances import Scene
from .mesh import NEAR, Frame
from .pattern import Pattern
from .poses import Poses
from .rays import Rays
from .scan import Scan

_Room = tuple[Floats, Ints32, Ints32]

_SHARE = 1 << 13  # rays that a thread takes at a time, where there are several
# Cosine of 20 degrees. Packets of 16 rays within that are cast four to six times as fast as single
# rays, wider ones more slowly. Packets are made along a ring (`Pattern.step`): along a firing, they
# are slower than single rays in fine terrain.
_COHERENCE = 0.94


class EmbreeBackend(Backend):
    """Embree's candidates, of which the watertight test in float64 takes the closest.

    A triangle that Embree does not propose is not found. It decides in float32, and does not see
    surfaces that are nearer to the ray's start than about 1e-6 of the scene's size, nor some of
    those whose rim a ray meets within that. Casting and
    building the tree use the given number of threads.
    """

    name: ClassVar[str] = "embree"
    chunk: ClassVar[int] = 1 << 15  # distances and places fit a core's level 2 cache

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        if importlib.util.find_spec("numba") is None:
            return "numba is not installed: pip install numba"
        try:
            embree_library.library()
        except (ImportError, OSError) as error:
            return f"Embree does not load ({error}): pip install embreex"
        return ""

    @classmethod
    def build(cls) -> str:
        """See `Backend.build`: embreex and its copy of Embree."""
        return embree_library.build()

    def __init__(self, scene: Scene, threads: int | None = None, device: int | None = None) -> None:
        from . import embree_kernels

        super().__init__(scene, threads, device)
        count = threads or os.cpu_count() or 1
        self._threads = ThreadPoolExecutor(count, "embree") if count > 1 else None
        trees = [embree_library.EmbreeMesh(mesh, threads) for mesh in scene.meshes]
        self._instances = (
            embree_library.EmbreeInstances(scene, trees, threads) if scene.nested else None
        )
        self._tree = self._instances or trees[0]
        self._width = embree_library.packet_width()
        self._steps: WeakKeyDictionary[Pattern, dict[int, int]] = WeakKeyDictionary()
        self._kernels = embree_kernels
        self._corners = [np.ascontiguousarray(mesh.corners) for mesh in scene.meshes]
        self._meshes = np.zeros((len(scene.meshes), embree_kernels.MESH_RECORD), np.int64)
        for record, mesh, corners in zip(self._meshes, scene.meshes, self._corners, strict=True):
            record[0] = corners.ctypes.data
            if (opacity := mesh.opacity) is not None:
                tables = opacity.uv.ctypes.data, opacity.mask.ctypes.data
                record[1:] = *tables, *opacity.mask.shape
        self._masked = any(mesh.opacity is not None for mesh in scene.meshes)
        proposers = [embree_kernels.propose] * 2
        if not (scene.nested or self._masked):
            proposers = [embree_kernels.plain_proposer(n) for n in (self._width, 1)]
        called = (*proposers, embree_kernels.decide, embree_kernels.nearby)
        filters = [function.address for function in called]
        self._filters = np.array(filters, np.int64)
        self._index = np.concatenate([mesh.index for mesh in scene.meshes])
        self.place(scene)

    def place(self, scene: Scene) -> None:
        """See `Backend.place`."""
        super().place(scene)
        self._frame = scene.frame.table
        self._records_at = 0
        if self._instances is not None:
            self._instances.place(scene)
            first = np.cumsum([0, *(len(corners) for corners in self._corners[:-1])])
            self._records = np.empty((len(scene.mesh), self._kernels.RECORD))
            self._records[:, :12] = scene.matrices
            rows = self._meshes.ctypes.data + self._meshes.strides[0] * scene.mesh
            self._records.view(np.int64)[:, 12] = rows
            self._records.view(np.int64)[:, 13] = first[scene.mesh]
            self._records_at = self._records.ctypes.data

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        ray, t, place, instance = self._hits(rays)
        u, v = np.empty((2, len(ray)))
        origins = self._scene.frame.to_local(rays.origins)
        if len(origins) > 1:
            origins = np.ascontiguousarray(origins[ray])
        directions = np.ascontiguousarray(rays.directions[ray])
        self._kernels.weigh(
            self._meshes.ctypes.data, self._records_at, origins, directions, place, instance, u, v
        )
        return Found(ray, t, self._index[place], u, v, instance)

    def found(self, rays: Rays) -> tuple[Integers, Floats, Ints32, Ints32]:
        """See `Backend.found`."""
        ray, t, place, instance = self._hits(rays)
        return ray, t, self._index[place], instance

    def _hits(self, rays: Rays) -> tuple[Indices, Floats, Ints32, Ints32]:
        """Rays that hit, local distances, places in `index`, and instances."""
        each = len(rays) if len(rays.origins) == 1 else 1
        source = _Source(
            rays.directions.T, None, Poses(rays.origins, None, each), self._scene.frame
        )
        limits = (rays.t_min, rays.t_max)
        t, place, instance = self._cast(source, 0, (0, len(rays)), limits, 1, self._room(len(rays)))
        ray = np.flatnonzero(place >= 0)
        instance = instance[ray] if self._scene.nested else np.zeros(len(ray), np.int32)
        return ray, t[ray], place[ray], instance

    def scan(self, scan: Scan) -> ScanReturns:
        """See `Backend.scan`."""
        pattern, frame = scan.pattern, self._scene.frame
        origins = None if pattern.origins is None else pattern.origins.T
        source = _Source(pattern.directions.T, origins, scan.poses, frame)
        step, limits = self._step(scan), (scan.t_min, scan.t_max)
        room = self._room(min(len(scan), self.chunk))
        groups = np.array(scan.groups)
        hits = np.zeros(len(groups), np.int64)
        tally = np.zeros(len(self._index) if scan.tally else 0, np.int64)
        # Pages of what is not written take no memory.
        ray, metres = np.empty(len(scan), np.uint32), np.empty(len(scan))
        triangle, instance = np.empty(len(scan), np.int32), np.zeros(len(scan), np.int32)
        kept = 0
        for start, stop in scan.chunks(self.chunk):
            t, place, chosen = self._cast(source, scan.first, (start, stop), limits, step, room)
            kept += self._kernels.gather(
                t,
                place,
                chosen,
                self._index,
                start,
                1 / frame.scale,
                groups,
                int(np.searchsorted(groups, start, side="right")) - 1,
                scan.keep_every,
                hits,
                tally,
                ray[kept:],
                metres[kept:],
                triangle[kept:],
                instance[kept:],
            )
        found = ray[:kept], metres[:kept], triangle[:kept]
        counts = self._by_face(tally) if scan.tally else None
        return ScanReturns(*found, hits, counts, instance[:kept])

    def _by_face(self, tally: Ints) -> Ints:
        """Count hits of all faces, from those of triangles that have an area."""
        counts, start = np.zeros(self._scene.face_count, np.int64), 0
        for mesh, first in zip(self._scene.meshes, self._scene.first_face, strict=False):
            stop = start + len(mesh.index)
            counts[first + mesh.index] = tally[start:stop]
            start = stop
        return counts

    def _room(self, rays: int) -> _Room:
        """Arrays for distances, places, and instances if there are any."""
        instances = np.empty(rays if self._scene.nested else 0, np.int32)
        return np.empty(rays), np.empty(rays, np.int32), instances

    def _step(self, scan: Scan) -> int:
        """How far apart the rays of a packet are; found once for a pattern with one or many poses.

        It is that for which they differ least; 1 for rays that have nothing in common.
        """
        each = scan.poses.rays if len(scan.poses) > 1 else 0
        steps = self._steps.setdefault(scan.pattern, {})
        if each not in steps:
            spreads = {
                step: self._spread(scan, step) for step in {1, scan.pattern.step, each} - {0}
            }
            best = max(spreads, key=lambda step: spreads[step])
            steps[each] = best if spreads[best] > _COHERENCE else 1
        return steps[each]

    def _spread(self, scan: Scan, step: int) -> float:
        """Mean over some packets of the least cosine between their first ray and some others."""
        lags = step * np.array([0, self._width // 4, self._width // 2, self._width - 1])
        room = len(scan) - int(lags[-1])
        if room <= 0:
            return -1.0
        ray = np.linspace(0, room - 1, 32).astype(np.int64)[:, None] + lags
        _, directions = scan.pattern.made(scan.first, ray.reshape(-1), scan.poses)
        packets = directions.reshape(-1, len(lags), 3)
        return float((packets[:, 1:] * packets[:, :1]).sum(axis=2).min(axis=1).mean())

    def _cast(
        self,
        source: _Source,
        first: int,
        rays: tuple[int, int],
        limits: tuple[float, float],
        step: int,
        room: _Room,
    ) -> _Room:
        """Local distances (n,), inf for a miss; places in `index` (n,), -1; instances, if any."""
        start, stop = rays
        scale = self._scene.frame.scale
        n = stop - start
        t, place, instance = room[0][:n], room[1][:n], room[2][:n]

        def part(begin: int) -> None:
            end = min(begin + share, stop)
            self._kernels.trace(
                self._tree.address,
                _scratch(self._kernels.SIZE),
                self._meshes.ctypes.data,
                self._records_at,
                self._masked,
                self._filters,
                source.addresses,
                self._frame,
                source.near,
                source.still,
                first,
                begin,
                end,
                source.each,
                step,
                self._width,
                _COHERENCE,
                limits[0] * scale,
                limits[1] * scale,
                t[begin - start : end - start],
                place[begin - start : end - start],
                instance[begin - start : end - start],
            )

        span = step * self._width
        share = max(_SHARE // span, 1) * span
        if self._threads is None or stop - start <= share:
            share = stop - start
            part(start)
        else:
            list(self._threads.map(part, range(start, stop, share)))
        return t, place, instance


class _Source:
    """Arrays from which rays are made, and their addresses for compiled code; see `trace`."""

    def __init__(
        self, directions: Floats, origins: Floats | None, poses: Poses, frame: Frame
    ) -> None:
        motion, self.each = poses.motion, poses.rays
        tables = [directions, origins, poses.positions, poses.rotations]
        tables += [None] * 3 if motion is None else [motion.delays, motion.velocities, motion.rates]
        self._kept = [None if a is None else np.ascontiguousarray(a, np.float64) for a in tables]
        places = [0 if a is None else a.ctypes.data for a in self._kept]
        self.addresses = np.array([*places, directions.shape[1]], np.int64)
        reach = float(np.abs(frame.to_local(poses.positions)).max(initial=0))
        if origins is not None:
            reach += 2 * float(np.abs(origins).max(initial=0)) * frame.scale
        if motion is not None:
            way = np.abs(motion.delays).max(initial=0) * np.abs(motion.velocities).max(initial=0)
            reach += 2 * float(way) * frame.scale
        self.near = reach < NEAR
        self.still = len(poses) == 1 and origins is None and motion is None


_own = threading.local()  # threads of one worker may cast at the same time


def _scratch(size: int) -> int:
    """Address of scratch memory of this thread, a multiple of 64."""
    room: AnyArray | None = getattr(_own, "room", None)
    if room is None:
        room = _own.room = np.zeros(size + 8, np.int64)
    return room.ctypes.data + -room.ctypes.data % 64
