"""Ray casting with Embree, as embreex ships it."""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, ClassVar, NamedTuple
from weakref import ref

import numpy as np

from . import embree_library
from .arrays import Floats
from .backend import Backend, Found
from .crossing import Crossing, Nearest
from .hits import Part, joined
from .instances import Scene
from .mesh import NEAR
from .pattern_rays import checked_rays
from .poses import Poses
from .rays import Rays
from .scan import Scan

if TYPE_CHECKING:
    from .embree_memory import Cast

_SHARE = 1 << 13  # rays that a thread takes at a time, where there are several
# Cosine of 20 degrees. Packets of 16 rays within that are cast four to six times as fast as single
# rays, wider ones more slowly.
_COHERENCE = 0.94
_SHAPES = ((16, 1), (8, 2), (4, 4))  # rays along a ring and across, that go together
_MOST = 1 << 15  # rays of a block
# parts that are cast in each way to choose the fastest, and rays
_TRIALS = 5
_TRIED = 1 << 10
_LIKE = 0.02  # between the cosines of patterns for which the same way is the fastest
_PLANS = 16  # kept


class _RayGrouping(NamedTuple):
    """How rays are grouped, see `embree_packets`."""

    step: int
    high: int
    wide: int
    coherence: float = _COHERENCE


_IN_TURN = _RayGrouping(1, 16, 1)


class EmbreeBackend(Backend):
    """Embree's candidates, of which the watertight test in float64 takes the closest.

    A triangle that Embree does not propose is not found. It decides in float32, and does not see
    surfaces that are nearer to the ray's start than about 1e-6 of the scene's size, nor some of
    those whose rim a ray meets within that. Casting and building the tree use the given number of
    threads.
    """

    name: ClassVar[str] = "embree"
    chunk: ClassVar[int] = 1 << 17  # 20 bytes each; parts of a longer scan are copied together

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
        from . import embree_exact, embree_memory, embree_packets

        super().__init__(scene, threads, device)
        self._count = threads or os.cpu_count() or 1
        self._threads = ThreadPoolExecutor(self._count, "embree")  # which start when needed
        self._process = os.getpid()
        trees = [embree_library.EmbreeMesh(mesh, threads) for mesh in scene.meshes]
        self._instances = (
            embree_library.EmbreeInstances(scene, trees, threads) if scene.nested else None
        )
        self._plans: dict[tuple[int, int], _Plan] = {}
        self._strikes: tuple[list[float], list[float]] = [], []  # seconds a ray, see `strike`
        self._loops = embree_packets
        self._memory = embree_memory
        self._corners = [np.ascontiguousarray(mesh.corners) for mesh in scene.meshes]
        self._meshes = np.zeros(len(scene.meshes), embree_memory.MESH)
        for record, mesh, corners in zip(self._meshes, scene.meshes, self._corners, strict=True):
            record["corners"] = corners.ctypes.data
            if (opacity := mesh.opacity) is not None:
                record["uv"] = opacity.uv.ctypes.data
                record["mask"] = opacity.mask.ctypes.data
                record["high"], record["wide"] = opacity.mask.shape
        self._index = np.concatenate([mesh.index for mesh in scene.meshes])
        masked = any(mesh.opacity is not None for mesh in scene.meshes)
        width = embree_library.packet_width()
        packets = [embree_exact.propose] * min(16 // width, 4)  # none, for packets of 1
        single = embree_exact.propose
        if not (scene.nested or masked):
            packets = [embree_exact.plain_proposer(width, k) for k in range(len(packets))]
            single = embree_exact.plain_proposer(1)
        cast = np.zeros(1, embree_memory.CAST)
        cast["scene"] = (self._instances or trees[0]).address
        cast["mesh"] = self._meshes.ctypes.data
        cast["masked"] = masked
        cast["packets"][0, : len(packets)] = [one.address for one in packets]
        cast["single"] = single.address
        cast["decide"] = embree_exact.decide.address
        cast["nearby"] = embree_exact.nearby.address
        cast["width"] = width
        cast["coherence"] = _COHERENCE
        cast["index"] = self._index.ctypes.data
        # which keep what has an address
        self._trees = trees
        self._base = cast
        self.place(scene)

    def place(self, scene: Scene) -> None:
        """See `Backend.place`."""
        super().place(scene)
        frame = scene.frame
        base = self._base
        base["centre"] = frame.centre
        base["scale"] = frame.scale
        base["low"] = frame.low
        base["upper"] = frame.high
        if self._instances is not None:
            self._instances.place(scene)
            first = np.cumsum([0, *(len(corners) for corners in self._corners[:-1])])
            records = np.zeros(len(scene.mesh), self._memory.INSTANCE)
            records["matrix"] = scene.matrices
            records["mesh"] = self._meshes.ctypes.data + self._meshes.itemsize * scene.mesh
            records["first"] = first[scene.mesh]
            self._records = records
            self._base["instances"] = records.ctypes.data

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        cast = self._of_rays(rays)
        cast.record["index"] = 0
        ray, distance, place, instance = self._cast(cast, 0, len(rays))
        u, v = np.empty((2, len(ray)))
        origins = self._scene.frame.to_local(rays.origins)
        if len(origins) > 1:
            origins = np.ascontiguousarray(origins[ray])
        directions = np.ascontiguousarray(rays.directions[ray])
        self._loops.weigh(cast.record, origins, directions, place, instance, u, v)
        t = distance * self._scene.frame.scale  # a power of two
        return Found(ray, t, self._index[place], u, v, instance)

    def strike(self, crossing: Crossing, nearest: Nearest) -> None:
        """See `Backend.strike`."""
        from .embree_bodies import strike

        own = self._base.copy()
        limits = crossing.limits
        own["t_min"], own["t_max"] = (limit * self._scene.frame.scale for limit in limits)
        own["scratch"], _ = self._memory.own.memory(0)
        given = crossing.row, crossing.body, crossing.number
        row, body, number = map(np.ascontiguousarray, given)
        # Threads may time calls at the same time: each list has enough, whatever the order.
        packets, single = self._strikes
        tried = min(len(packets), len(single)) >= _TRIALS
        alone = len(single) < len(packets)
        if tried:  # by the medians
            alone = sorted(single)[_TRIALS // 2] < sorted(packets)[_TRIALS // 2]
        own["coherence"] = 2.0 if alone else _COHERENCE
        start = time.perf_counter()
        strike(own, crossing.rays, row, body, number, crossing.poses, crossing.box, *nearest)
        if not tried and len(row) >= _TRIED:
            self._strikes[bool(alone)].append((time.perf_counter() - start) / len(row))

    def parts(self, scan: Scan) -> Iterator[tuple[int, int, Part]]:
        """See `Backend.parts`."""
        cast = self._of_scan(scan)
        plan = self._plan(scan)
        for start, stop in scan.chunks(self.chunk):
            for begin, end, tried in plan.pieces(start, stop):
                yield begin, end, self._cast(cast, begin, end, plan.ways[0])
                if tried:
                    plan.choose(partial(self._cast, cast, begin, end))

    def _of_rays(self, rays: Rays) -> Cast:
        """Prepare to cast rays that are not of a pattern."""
        one = len(rays.origins) == 1
        origins, at = (None, rays.origins) if one else (rays.origins, np.zeros((1, 3)))
        cast = self._memory.Cast(self._base)
        poses = Poses(at, None, max(len(rays), 1))
        cast.take(rays.directions, origins, poses, 0)
        self._reach(cast, poses, origins, (rays.t_min, rays.t_max))
        return cast

    def _of_scan(self, scan: Scan) -> Cast:
        """Prepare to cast a scan."""
        pattern = scan.pattern
        cast = self._memory.Cast(self._base)
        aside = cast.take_pattern(pattern, scan.poses, scan.first)
        if scan.room is not None:
            cast.record["ways"] = scan.room[-3:].ctypes.data
            cast.record["all"] = len(scan)
            if len(scan.room) > 3:
                cast.record["starts"] = scan.room.ctypes.data
                if cast.record["still"]:
                    scan.room[:3] = scan.poses.positions.T
        self._reach(cast, scan.poses, pattern.origins, (scan.t_min, scan.t_max), aside)
        return cast

    def _reach(
        self,
        cast: Cast,
        poses: Poses,
        origins: Floats | None,
        limits: tuple[float, float],
        aside: float = 0.0,
    ) -> None:
        """Note limits, and whether all rays start near the scene, so far `aside` of their beam."""
        motion = poses.motion
        frame = self._scene.frame
        record = cast.record
        reach = float(np.abs(frame.to_local(poses.positions)).max(initial=0))
        reach += 2 * aside * frame.scale
        if origins is not None:
            reach += 2 * float(np.abs(origins).max(initial=0)) * frame.scale
        if motion is not None:
            way = np.abs(motion.delays).max(initial=0) * np.abs(motion.velocities).max(initial=0)
            reach += 2 * float(way) * frame.scale
        record["near"] = reach < NEAR
        record["t_min"], record["t_max"] = (limit * frame.scale for limit in limits)

    def _plan(self, scan: Scan) -> _Plan:
        """Ways to group the rays of a scan: those that were the fastest for others like it."""
        each = scan.poses.rays if len(scan.poses) > 1 else 0
        plan = self._plans.get((len(scan.pattern), each))
        if plan is None or not plan.fits(scan):
            if len(self._plans) >= _PLANS:
                self._plans.clear()
            plan = self._plans[len(scan.pattern), each] = _Plan(scan, each)
        return plan

    def _cast(self, cast: Cast, start: int, stop: int, way: _RayGrouping = _IN_TURN) -> Part:
        """Hits of rays `start` to `stop`, in their order, numbered from `start`."""
        n = stop - start
        ray = np.empty(n, np.uint32)
        distance = np.empty(n)
        triangle = np.empty(n, np.int32)
        instance = (np.empty if self._scene.nested else np.zeros)(n, np.int32)

        def part(begin: int) -> Part:
            own = cast.record.copy()
            at = begin - start
            own["step"] = way.step
            own["high"] = way.high
            own["wide"] = way.wide
            own["coherence"] = way.coherence
            own["before"] = start
            own["scratch"], own["room"] = self._memory.own.memory(way.step * way.high)
            own["ray"] = ray[at:].ctypes.data
            own["distance"] = distance[at:].ctypes.data
            own["triangle"] = triangle[at:].ctypes.data
            own["instance"] = instance[at:].ctypes.data
            count = self._loops.trace(own, begin, min(begin + share, stop))
            here = slice(at, at + count)
            return ray[here], distance[here], triangle[here], instance[here]

        span = way.step * way.high
        share = max(_SHARE // span, 1) * span
        if self._count == 1 or n <= share:
            share = n
            return part(start)
        if self._process != os.getpid():  # a fork, which has none of its parent's threads
            self._threads = ThreadPoolExecutor(self._count, "embree")
            self._process = os.getpid()
        return joined(list(self._threads.map(part, range(start, stop, share))))


class _Plan:
    """Ways to group the rays of a pattern, of which the fastest is found while they are cast.

    Rays of a group are of a ring, or of some neighbouring rings, or each is cast by itself: what is
    fastest depends on the scene. All are tried on the same parts. No way changes a result.
    """

    def __init__(self, scan: Scan, each: int) -> None:
        self._beams = ref(np.asarray(scan.pattern.directions.base))  # which its copies share
        many = scan.pattern.each
        steps = {1, scan.pattern.step * many, each} - {0}
        spreads = {step: _spread(scan, _RayGrouping(step, 16, 1)) for step in steps}
        self._step = max(spreads, key=lambda step: spreads[step])
        self._spread = spreads[self._step]
        self.ways = [_IN_TURN]
        if self._spread > _COHERENCE:
            ways = {
                _RayGrouping(self._step, high, wide) for high, wide in _SHAPES if wide <= self._step
            }
            if many > 1:  # those of a beam, which differ least, go together
                ways = {_IN_TURN} | {_RayGrouping(step, *_SHAPES[-1]) for step in steps if step > 4}
            self.ways = [
                way
                for way in sorted(ways)
                if way.step * way.high <= _MOST and _spread(scan, way) > _COHERENCE
            ] or self.ways
            self.ways.append(_RayGrouping(1, 16, 1, 2.0))
        self._trials: list[list[float]] = []  # times of each way, as shares of the shortest

    def fits(self, scan: Scan) -> bool:
        """Whether the rays of a scan are as close together as those for which this was made."""
        if self._beams() is scan.pattern.directions.base:
            return True
        return abs(_spread(scan, _RayGrouping(self._step, 16, 1)) - self._spread) < _LIKE

    def pieces(self, start: int, stop: int) -> Iterator[tuple[int, int, bool]]:
        """Parts of rays `start` to `stop`, and whether to try all ways there."""
        part = -(-(stop - start) // _TRIALS)
        while start < stop:
            if len(self.ways) > 1:
                blocks = max(way.step * way.high for way in self.ways)
                end = min(start + max(blocks, _TRIED), stop)
                yield start, end, True
                start, end = end, min(max(end, start + part), stop)
            else:
                end = stop
            if start < end:
                yield start, end, False
            start = end

    def choose(self, cast: Callable[[_RayGrouping], object]) -> None:
        """Cast a part, which is in the caches by now, in each way; the last time, choose one."""
        ways = self.ways
        marks = [time.perf_counter()]
        if len(ways) == 1:  # another thread has chosen meanwhile
            return
        for way in ways:
            cast(way)
            marks.append(time.perf_counter())
        times = np.diff(marks)
        self._trials.append(list(times / times.min()))
        if len(self._trials) >= _TRIALS:
            self.ways = [ways[int(np.median(self._trials, axis=0).argmin())]]


def _spread(scan: Scan, way: _RayGrouping) -> float:
    """Mean over some groups of the least cosine between their first ray and some others."""
    lanes = np.array([0, 5, 10, 15])
    lags = way.step * (lanes // way.wide) + lanes % way.wide
    room = len(scan) - int(lags[-1])
    if room <= 0:
        return -1.0
    ray = np.linspace(0, room - 1, 32).astype(np.int64)[:, None] + lags
    _, directions = checked_rays(scan.pattern, scan.first, ray.reshape(-1), scan.poses)
    packets = directions.reshape(-1, len(lags), 3)
    return float((packets[:, 1:] * packets[:, :1]).sum(axis=2).min(axis=1).mean())
