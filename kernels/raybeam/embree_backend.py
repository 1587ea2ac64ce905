"""Ray casting with Embree, as embreex ships it.

Rays of a pattern are numbered firing after firing, so the next ray of a ring is `step` rays later.
The compiled loops read and write memory by the addresses in a `CAST` record, see embree_memory.py.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, ClassVar, NamedTuple
from weakref import ref

import numpy as np

from . import embree_library
from .arrays import AnyArray, Floats
from .backend import Backend, ClosestHits
from .crossing import Crossing, Nearest
from .hits import Part, join_hits
from .installation import install_command
from .instances import Scene
from .mesh import NEAR
from .pattern import GOLDEN, sample_rows
from .pattern_rays import checked_rays
from .poses import Poses
from .rays import Rays
from .scan import Scan
from .trials import Alternation, Trials, clock

if TYPE_CHECKING:
    from .embree_memory import Cast

_SHARE = 1 << 13  # rays that a thread casts in a call, if there are several threads
# Cosine of 20 degrees. Packets of 16 rays within that are cast four to six times as fast as single
# rays, wider packets more slowly.
_COHERENCE = 0.94
_SHAPES = ((16, 1), (8, 2), (4, 4))  # of groups: rays along a ring, and neighbouring rings
_MAX_BLOCK = 1 << 15  # rays of a block
_TRIAL_RAYS = 1 << 10  # minimum number of rays of a timed cast
_SIMILAR = 0.02  # maximum difference of the coherence of patterns with the same fastest grouping
_MAX_PLANS = 16


class _RayGrouping(NamedTuple):
    """How the rays of a scan are divided into groups of 16, see `embree_packets`.

    A block is `step` times `rays_along` consecutive rays: `step` rings of `rays_along` rays.

    Attributes
    ----------
    step
        Difference of the numbers of neighbouring rays of a ring: 1 where consecutive rays form a
        ring; elsewhere for example the number of rays of a firing.
    rays_along, rays_across
        Rays of each ring in a group, and rings of a group; their product is 16.
    coherence
        Minimum cosine between the first and further rays of a group; a group with a smaller cosine
        is cast ray by ray. Greater than 1 to cast all groups ray by ray.
    """

    step: int
    rays_along: int
    rays_across: int
    coherence: float = _COHERENCE

    @property
    def block(self) -> int:
        """Number of rays of a block."""
        return self.step * self.rays_along


_CONSECUTIVE = _RayGrouping(1, 16, 1)


class EmbreeBackend(Backend):
    """Embree's candidates, of which the watertight test in float64 takes the closest.

    A triangle that Embree does not propose is missed. Embree decides in float32, and does not see
    surfaces that are nearer to the ray's origin than about 1e-6 of the scene's size, nor some
    surfaces whose rim a ray meets within that distance. Casting and building the tree use the given
    number of threads.
    """

    name: ClassVar[str] = "embree"
    chunk: ClassVar[int] = 1 << 17  # rays; hits take 20 bytes a ray, until chunks are joined

    @classmethod
    def missing(cls) -> str:
        """Return why Embree or numba cannot be used and the remedy; "" if usable."""
        if importlib.util.find_spec("numba") is None:
            return f"numba is not installed: {install_command('numba')}"
        try:
            embree_library.load_library()
        except (ImportError, OSError) as error:
            return f"Embree does not load ({error}): {install_command('embreex')}"
        return ""

    @classmethod
    def build(cls) -> str:
        """Return the versions of embreex and of its copy of Embree."""
        return embree_library.build()

    def __init__(self, scene: Scene, threads: int | None = None, device: int | None = None) -> None:
        from . import embree_exact, embree_memory, embree_packets

        super().__init__(scene, threads, device)
        self._count = threads or os.cpu_count() or 1
        self._threads = ThreadPoolExecutor(self._count, "embree")  # threads start on first use
        self._process = os.getpid()
        trees = [embree_library.EmbreeMesh(mesh, threads) for mesh in scene.meshes]
        self._instances = (
            embree_library.EmbreeInstances(scene, trees, threads) if scene.nested else None
        )
        self._plans: dict[tuple[int, int], _GroupingPlan] = {}
        self._crossing_options = Alternation()  # of `cast_crossing`: in packets, and ray by ray
        self._loops = embree_packets
        self._memory = embree_memory
        self._corners = [np.ascontiguousarray(mesh.corners) for mesh in scene.meshes]
        self._meshes = self._mesh_records(scene)
        # Row of each triangle in the caller's `faces`, by row of the corners of all meshes.
        self._index = np.concatenate([mesh.index for mesh in scene.meshes])
        masked = any(mesh.opacity is not None for mesh in scene.meshes)
        self._width = width = embree_library.packet_width()
        packets = [embree_exact.propose] * min(16 // width, 4)  # unused if a packet is one ray
        single = embree_exact.propose
        if not masked:
            packets = [
                embree_exact.opaque_proposer(width, number, nested=scene.nested)
                for number in range(len(packets))
            ]
            single = embree_exact.opaque_proposer(1, nested=scene.nested)
        cast = np.zeros(1, embree_memory.CAST)
        cast["scene"] = (self._instances or trees[0]).address
        cast["mesh"] = self._meshes.ctypes.data
        cast["masked"] = masked
        cast["packets"][0, : len(packets)] = [proposer.address for proposer in packets]
        cast["single"] = single.address
        cast["decide"] = embree_exact.decide.address
        cast["nearby"] = embree_exact.nearby.address
        cast["coherence"] = _COHERENCE
        cast["index"] = self._index.ctypes.data
        self._records = self._instance_records(scene)
        if scene.nested:
            cast["instances"] = self._records.ctypes.data
        self._trees = trees  # keeps the addresses in the record valid
        self._base = cast
        self.update_scene(scene)

    def _mesh_records(self, scene: Scene) -> AnyArray:
        """Return a `MESH` record for each mesh of a scene."""
        records = np.zeros(len(scene.meshes), self._memory.MESH)
        for record, mesh, corners in zip(records, scene.meshes, self._corners, strict=True):
            record["corners"] = corners.ctypes.data
            if (opacity := mesh.opacity) is not None:
                record["uv"] = opacity.uv.ctypes.data
                record["mask"] = opacity.mask.ctypes.data
                record["mask_height"], record["mask_width"] = opacity.mask.shape
        return records

    def _instance_records(self, scene: Scene) -> AnyArray:
        """Return an `INSTANCE` record for each instance of a scene, without matrices."""
        records = np.zeros(len(scene.mesh), self._memory.INSTANCE)
        first_rows = np.cumsum([0, *(len(corners) for corners in self._corners[:-1])])
        records["mesh"] = self._meshes.ctypes.data + self._meshes.itemsize * scene.mesh
        records["first"] = first_rows[scene.mesh]
        return records

    def update_scene(self, scene: Scene) -> None:
        """Replace the scene by a scene of the same instances with new transforms."""
        super().update_scene(scene)
        frame = scene.frame
        base = self._base
        base["centre"] = frame.centre
        base["scale"] = frame.scale
        base["lower"] = frame.lower
        base["upper"] = frame.upper
        grid = embree_library.direction_grid(scene)
        base["rounding"] = 1.5 * 2.0**52 * grid
        base["width"] = self._width if np.isfinite(grid) else 1
        if self._instances is not None:
            self._instances.update_scene(scene)
            self._records["matrix"] = scene.matrices

    def closest(self, rays: Rays) -> ClosestHits:
        """Return the closest hits of at most `chunk` rays."""
        cast = self._ray_cast(rays)
        cast.record["index"] = 0  # hits get the row of the corners, which `weigh` needs
        ray, distance, row, instance = self._cast(cast, 0, len(rays))
        u, v = np.empty((2, len(ray)))
        origins = self._scene.frame.to_local(rays.origins)
        if len(origins) > 1:
            origins = np.ascontiguousarray(origins[ray])
        directions = np.ascontiguousarray(rays.directions[ray])
        self._loops.weigh(cast.record, origins, directions, row, instance, u, v)
        t = distance * self._scene.frame.scale  # local; exact, since the scale is a power of two
        return ClosestHits(ray, t, self._index[row], u, v, instance)

    def cast_crossing(self, crossing: Crossing, nearest: Nearest) -> None:
        """Cast pairs of a ray and a body on this scene, the shape that the bodies share.

        Hits nearer than those in `nearest` replace these.
        """
        from .embree_bodies import cast_crossing

        record = self._base.copy()
        scale = self._scene.frame.scale
        record["t_min"], record["t_max"] = (limit * scale for limit in crossing.limits)
        record["scratch"], _ = self._memory.thread_memory.addresses(0)
        count = len(crossing.row)
        one_by_one = self._crossing_options.next()
        record["coherence"] = 2.0 if one_by_one else _COHERENCE
        pairs = crossing.contiguous()
        start = clock()
        cast_crossing(record, pairs, nearest)
        if count >= _TRIAL_RAYS:
            self._crossing_options.add(one_by_one, (clock() - start) / count)

    def parts(self, scan: Scan) -> Iterator[tuple[int, int, Part]]:
        """Yield ranges of rays of a scan, and the hits of each range.

        Yields start and stop of the range, and a `Part`: hits in ray order, whose rays are numbered
        from start.
        """
        cast = self._scan_cast(scan)
        plan = self._plan(scan)
        for start, stop in scan.chunks(self.chunk):
            for begin, end, is_trial in plan.pieces(start, stop):
                yield begin, end, self._cast(cast, begin, end, plan.trials.current)
                if is_trial:  # of rays that were cast before, so caches are warm
                    work = partial(self._cast, cast, begin, end, in_this_thread=True)
                    plan.trials.try_all(work, end - begin)

    def _ray_cast(self, rays: Rays) -> Cast:
        """Return the `Cast` of rays that are not of a pattern.

        Each ray becomes a beam, seen from a single pose.
        """
        origins: Floats | None = rays.origins
        position = np.zeros((1, 3))
        if len(rays.origins) == 1:
            position = rays.origins
            origins = None
        cast = self._memory.Cast(self._base)
        poses = Poses(position, None, max(len(rays), 1))
        cast.set_beams(rays.directions, origins, poses, 0)
        max_origin = 0.0 if origins is None else float(np.abs(origins).max(initial=0))
        self._set_limits(cast, poses, max_origin, (rays.t_min, rays.t_max))
        return cast

    def _scan_cast(self, scan: Scan) -> Cast:
        """Return the `Cast` of a scan; the loops also write the rays to `scan.room`, if any."""
        pattern = scan.pattern
        cast = self._memory.Cast(self._base)
        max_offset = pattern.max_origin + cast.set_pattern(pattern, scan.poses, scan.first)
        if scan.room is not None:
            cast.record["directions_out"] = scan.room[-3:].ctypes.data
            cast.record["ray_count"] = len(scan)
            if len(scan.room) > 3:
                cast.record["origins_out"] = scan.room.ctypes.data
                if cast.record["shares_origin"]:
                    scan.room[:3] = scan.poses.positions.T
        self._set_limits(cast, scan.poses, max_offset, (scan.t_min, scan.t_max))
        return cast

    def _set_limits(
        self,
        cast: Cast,
        poses: Poses,
        max_offset: float,
        limits: tuple[float, float],
    ) -> None:
        """Write the limits of distances, and whether all rays start near the scene, to a cast.

        Parameters
        ----------
        cast
            The cast, to whose record the limits are written.
        poses
            Poses of the rays, with their motion.
        max_offset
            Upper bound of the components of the vectors from the position of a pose to the starts
            of its rays, in the axes of the sensor, metres.
        limits
            Closest and farthest distance of a hit, metres.
        """
        motion = poses.motion
        frame = self._scene.frame
        record = cast.record
        # Upper bound of the local coordinates of all origins.
        max_coordinate = float(np.abs(frame.to_local(poses.positions)).max(initial=0))
        max_coordinate += 2 * max_offset * frame.scale
        if motion is not None:
            max_delay = np.abs(motion.delays).max(initial=0)
            path = max_delay * np.abs(motion.velocities).max(initial=0)
            max_coordinate += 2 * float(path) * frame.scale
        record["starts_near"] = max_coordinate < NEAR
        record["t_min"], record["t_max"] = (limit * frame.scale for limit in limits)

    def _plan(self, scan: Scan) -> _GroupingPlan:
        """Return the plan of groupings that similar scans share; a new plan if there is none."""
        rays_per_pose = scan.poses.rays_per_pose if len(scan.poses) > 1 else 0
        key = (len(scan.pattern), rays_per_pose)
        plan = self._plans.get(key)
        if plan is None or not plan.fits(scan):
            if len(self._plans) >= _MAX_PLANS:
                self._plans.clear()
            plan = self._plans[key] = _GroupingPlan(scan, rays_per_pose)
        return plan

    def _cast(
        self,
        cast: Cast,
        start: int,
        stop: int,
        grouping: _RayGrouping = _CONSECUTIVE,
        *,
        in_this_thread: bool = False,
    ) -> Part:
        """Return the hits of rays `start` to `stop`, in ray order, numbered from `start`.

        Distances are in metres; `triangle` is the row in the caller's faces, or the row of the
        corners if `index` of the record is 0. With `in_this_thread` no other thread casts.
        """
        n = stop - start
        ray = np.empty(n, np.uint32)
        distance = np.empty(n)
        triangle = np.empty(n, np.int32)
        instance = (np.empty if self._scene.nested else np.zeros)(n, np.int32)

        def cast_share(begin: int) -> Part:
            """Return the hits of `share` rays from `begin`, as views of the memory of all rays."""
            record = cast.record.copy()
            row = begin - start
            scratch, block_memory = self._memory.thread_memory.addresses(grouping.block)
            record["scratch"] = scratch
            record["block_memory"] = block_memory
            record["step"] = grouping.step
            record["rays_along"] = grouping.rays_along
            record["rays_across"] = grouping.rays_across
            record["coherence"] = grouping.coherence
            record["first_ray"] = start
            record["ray"] = ray[row:].ctypes.data
            record["distance"] = distance[row:].ctypes.data
            record["triangle"] = triangle[row:].ctypes.data
            record["instance"] = instance[row:].ctypes.data
            count = self._loops.trace(record, begin, min(begin + share, stop))
            hits = slice(row, row + count)
            return ray[hits], distance[hits], triangle[hits], instance[hits]

        share = max(_SHARE // grouping.block, 1) * grouping.block
        if self._count == 1 or in_this_thread or n <= share:
            share = n
            return cast_share(start)
        if self._process != os.getpid():  # a fork, which has no threads of its parent
            self._threads = ThreadPoolExecutor(self._count, "embree")
            self._process = os.getpid()
        return join_hits(list(self._threads.map(cast_share, range(start, stop, share))))


class _GroupingPlan:
    """Groupings of the rays of a pattern, of which the fastest is chosen during casts.

    A group has rays of a single ring, or of some neighbouring rings, or each ray is cast by itself:
    which grouping is fastest depends on the scene. Some ranges of rays are cast in all groupings,
    and timed. No grouping changes a result.

    Attributes
    ----------
    trials
        The groupings that are tried, and the grouping that casts.
    """

    def __init__(self, scan: Scan, rays_per_pose: int) -> None:
        self._beams = ref(np.asarray(scan.pattern.directions.base))  # shared by copies of a pattern
        subrays = scan.pattern.subrays_per_beam
        steps = {1, scan.pattern.step * subrays, rays_per_pose} - {0}
        coherences = {step: _coherence(scan, _RayGrouping(step, 16, 1)) for step in steps}
        self._step = max(coherences, key=lambda step: coherences[step])
        self._coherence = coherences[self._step]
        groupings = [_CONSECUTIVE]
        if self._coherence > _COHERENCE:
            shapes = {
                _RayGrouping(step, rays_along, rays_across)
                for step in steps
                for rays_along, rays_across in _SHAPES
                if rays_across <= step
            }
            if subrays > 1:  # the sub-rays of a beam, which differ least, form groups
                squares = {_RayGrouping(step, *_SHAPES[-1]) for step in steps if step > 4}
                shapes = {_CONSECUTIVE} | squares
            groupings = [
                grouping
                for grouping in sorted(shapes)
                if grouping.block <= _MAX_BLOCK and _coherence(scan, grouping) > _COHERENCE
            ] or groupings
            groupings.append(_RayGrouping(1, 16, 1, 2.0))
        self.trials = Trials(groupings)
        self._trial_rays = max(_TRIAL_RAYS, *(grouping.block for grouping in groupings))
        self._single_trials = 0  # so far

    def fits(self, scan: Scan) -> bool:
        """Return whether the plan holds for a scan: of the same beams, or as coherent."""
        if self._beams() is scan.pattern.directions.base:
            return True
        grouping = _RayGrouping(self._step, 16, 1)
        return abs(_coherence(scan, grouping) - self._coherence) < _SIMILAR

    def pieces(self, start: int, stop: int) -> Iterator[tuple[int, int, bool]]:
        """Yield start and stop of ranges of rays, and whether to try all groupings on a range.

        The caller casts each range by `trials.current`, and tries before it asks for the next one.
        """
        self.trials.worked(stop - start)
        due = self.trials.due
        if due == 1:  # elsewhere each time, so that checks see all parts of scans
            self._single_trials += 1
            spare = max(stop - start - self._trial_rays, 0)
            lead = int(self._single_trials * GOLDEN % 1 * spare)
            if lead:
                yield start, start + lead, False
                start += lead
        while due and start < stop:
            trial_end = min(start + self._trial_rays, stop)
            yield start, trial_end, True
            # The trials that are left share the rays that are left.
            end = max(min(start + -(-(stop - start) // due), stop), trial_end)
            if trial_end < end:
                yield trial_end, end, False
            start = end
            due = self.trials.due
        if start < stop:
            yield start, stop, False


def _coherence(scan: Scan, grouping: _RayGrouping) -> float:
    """Return the coherence of a grouping: the mean of the smallest cosines of 32 sampled groups.

    Cosines are between the first ray of a group and three further rays, which `lags` numbers.
    """
    lanes = np.array([0, 5, 10, 15])
    lags = grouping.step * (lanes // grouping.rays_across) + lanes % grouping.rays_across
    last_start = len(scan) - int(lags[-1])
    if last_start <= 0:
        return -1.0
    ray = sample_rows(32, last_start)[:, None] + lags
    _, directions = checked_rays(scan.pattern, scan.first, ray.reshape(-1), scan.poses)
    packets = directions.reshape(-1, len(lags), 3)
    return float((packets[:, 1:] * packets[:, :1]).sum(axis=2).min(axis=1).mean())
