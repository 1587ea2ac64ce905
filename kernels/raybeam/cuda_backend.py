"""Ray casting on a CUDA device through CuPy."""

from __future__ import annotations

import importlib.resources
import importlib.util
import os
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial
from typing import Any, ClassVar, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from .arrays import AnyArray, Ints, Ints32
from .backend import Backend, ClosestHits
from .body_rays import TimedBodies
from .cuda_tables import build_instance_tables, build_mesh_tables
from .device import DeviceHits, DeviceNearestHits, ExternalHits, HitTransfer, PendingCopy, to_device
from .hits import ScanReturns, TallyCounts
from .installation import install_command
from .instances import LocalScene
from .opacity import MaskTables
from .pattern import Pattern
from .poses import Poses
from .rays import Rays
from .scan import HitGroups, Scan, host_rays

T = TypeVar("T")

# Patterns on devices: {pattern: {device index: (directions, origins)}}.
_patterns: WeakKeyDictionary[Pattern, dict[int, tuple[Any, ...]]] = WeakKeyDictionary()
_BLOCK = 128  # threads per block; intersect.cu has the same value
_STACK_STEP = 32
# Placeholders for mask tables, which are not read if all triangles are opaque.
NO_MASKS = np.zeros((1, 6), np.float32), np.zeros(1, np.uint8), np.zeros((1, 4), np.int64)
_MAX_INT = (1 << 31) - 1  # more than the number of rays in a chunk


class _CastChunk(NamedTuple):
    """Hits of consecutive rays on the device, and hit counts that are being copied to the host."""

    start: int  # index of the first ray
    rays: tuple[Any, Any]  # origins and directions, float64 (3, n) each
    hits: tuple[Any, Any, Any]  # local distance, table row and instance, (n,) each
    external_hits: tuple[Any, ...]  # arguments of the kernel `pack`
    sums: Any  # int32 (n,): cumulative number of hits
    span: slice  # indices of the groups that the rays belong to
    later_starts: Ints  # first ray of the second and later groups, relative to `start`
    cuts: PendingCopy  # cumulative number of hits at the end of each group


class CudaBackend(Backend):
    """Backend that traverses the trees with the kernels in intersect.cu, one thread per ray.

    Only the stored hits are copied to the host.

    Kernels and copies use the current stream of the calling thread. Each call ends with a copy to
    the host, for which CuPy waits. When the call returns, the device therefore no longer uses the
    call's memory. Tables and patterns are kept between calls. The call that creates them waits
    until they are complete, so that threads with other streams can use them. Each call switches to
    the caster's device and back.

    NumPy builds the trees (cuda_tables.py). A builder on the device would need as much code as the
    traversal and would save each worker only two seconds per million triangles at startup.
    """

    name: ClassVar[str] = "cuda"
    on_device: ClassVar[bool] = True
    # Two chunks of rays with all columns take about 600 MB on the device. The grid size, the sums
    # of hits and the indices into the arrays of a chunk are far below 2**31. Only ray indices need
    # 64 bits.
    chunk: ClassVar[int] = 1 << 21

    @classmethod
    def unavailable_reason(cls) -> str:
        """Return why CuPy or CUDA is unavailable and how to fix this, or "" if it is available."""
        if importlib.util.find_spec("cupy") is None:
            command = install_command("cupy-cuda12x")
            return f"CuPy is not installed; run {command} (or cupy-cuda13x)"
        try:
            import cupy
        except ImportError as error:
            return f"CuPy cannot be imported ({error})"
        try:
            count = cupy.cuda.runtime.getDeviceCount()
        except cupy.cuda.runtime.CUDARuntimeError as error:
            return f"CuPy cannot find a CUDA device ({error})"
        if not count:
            return "no CUDA device is available"
        try:
            cupy.cuda.nvrtc.getVersion()
        except RuntimeError as error:
            reason = str(error).partition("\n")[0]
            command = install_command("cupy-cuda13x[ctk]")
            return f"CuPy cannot find a compiler ({reason}); run {command} (or cupy-cuda12x[ctk])"
        if not _has_cuda_headers():
            command = install_command("cupy-cuda13x[ctk]")
            return f"CuPy cannot find the CUDA headers; run {command} (or cupy-cuda12x[ctk])"
        return ""

    @classmethod
    def limit_memory(cls, device: int | None, share: float) -> None:
        """Limit the device memory of this process to a fraction of the total.

        CuPy keeps memory that it has freed, so without a limit, the first process on a device may
        leave no memory for other processes. If `share` is 1 or more, there is no limit. A limit set
        by the user with CUPY_GPU_MEMORY_LIMIT takes precedence.
        """
        if share >= 1 or "CUPY_GPU_MEMORY_LIMIT" in os.environ:
            return
        cupy = cls.load_cupy()
        with _device(cupy, device):
            cupy.get_default_memory_pool().set_limit(fraction=share)

    def __init__(
        self, scene: LocalScene, threads: int | None = None, device: int | None = None
    ) -> None:
        super().__init__(scene, threads, device)
        self._cupy = cupy = self.load_cupy()
        self._device = _device(cupy, device)
        layout = build_mesh_tables(scene.meshes)
        self._roots = layout.roots
        self._stack = layout.stack
        self._masked = layout.masks is not None
        with self._device:
            masks = layout.masks or MaskTables(*NO_MASKS)
            tables: tuple[AnyArray, ...] = (
                layout.nodes,
                layout.triangles,
                layout.corners,
                layout.faces,
                masks.uv,
                masks.mask,
                masks.records,
            )
            self._meshes = tuple(to_device(cupy, table) for table in tables)
            no_table = to_device(cupy, np.zeros(2, np.int64))
            self._no_counters = no_table, np.int32(0), cupy.zeros(1, np.int64)
            self._no_external_hits = cupy.zeros(1), cupy.zeros(1, np.int32), np.int32(0)
        self.update_scene(scene)

    def update_scene(self, scene: LocalScene) -> None:
        """Replace the scene by one with the same instances but new transforms."""
        super().update_scene(scene)
        layout = build_instance_tables(scene, self._roots)
        with self._device:
            # The stack size is rounded up so that different scenes can share compiled kernels.
            stack = -(-max(self._stack + layout.stack, 1) // _STACK_STEP) * _STACK_STEP
            self._module = _compiled(
                self._cupy,
                self._device.id,
                compiler_options(stack, scene.has_matrices, self._masked),
            )
            tables = (layout.frame, layout.top, layout.instances)
            self._instance_tables = tuple(to_device(self._cupy, table) for table in tables)

    @property
    def device_lost(self) -> bool:
        """Whether the device no longer responds to calls from this process.

        After an illegal memory access or an uncorrectable memory error, all CUDA calls fail until
        the process ends. After an out-of-memory error, they do not.
        """
        try:
            self._device.synchronize()
        except self._cupy.cuda.runtime.CUDARuntimeError:
            return True
        return False

    @staticmethod
    def load_cupy() -> Any:
        """Import CuPy on first use.

        The tests replace this method.
        """
        import cupy

        return cupy

    def closest_hits(self, rays: Rays) -> ClosestHits:
        """Return the closest hits of at most `chunk` rays."""
        n = len(rays)
        with self._device:
            table = self._ray_table(rays)
            hits = self._cast(table, n, (rays.t_min, rays.t_max))
            groups = HitGroups(np.zeros(1, np.int64), 1)
            chunk = self._count_chunk_hits(0, table, hits, groups, self._no_external_hits)
            packed = self._pack(chunk, groups, 1.0, self._no_counters)
            u, v = self._weights(hits, table, packed[0])
            ray, distance, triangle, instance = packed
            columns = (ray, distance, triangle, u, v, instance)
            return ClosestHits(*(array.get() for array in columns))

    def _ray_table(self, rays: Rays) -> tuple[Any, Any]:
        """Copy rays to the device.

        Return the origins with shape (3, n), or (3, 1) if all rays share an origin, and the
        directions with shape (3, n).
        """
        tables = (np.ascontiguousarray(table.T) for table in (rays.origins, rays.directions))
        origins, directions = map(self._cupy.asarray, tables)
        return origins, directions

    def _weights(
        self, hits: tuple[Any, Any, Any], table: tuple[Any, Any], ray: Any
    ) -> tuple[Any, Any]:
        """Return the barycentric weights of the second and third vertex at each hit.

        `ray` (k,) contains the indices of rays that hit.
        """
        count = len(ray)
        u = self._cupy.empty(count)
        v = self._cupy.empty(count)
        frame, _, instances = self._instance_tables
        scene = (self._meshes[2], frame, instances)
        _, row, instance = hits
        arguments = (*scene, *_table_arguments(table), ray, row, instance, np.int64(count))
        self._run("weigh_table", count, *arguments, u, v)
        return u, v

    def scan(self, scan: Scan) -> ScanReturns:
        """Return the hits to store for a scan, and the counts of all hits."""
        if scan.pattern.sub_rays is not None:  # The kernel does not support sub-rays.
            return super().scan(scan)
        if scan.out is not None:
            scan.rays(0, len(scan))  # writes the rays to `scan.out`
        with self._device:
            max_hits = -(-len(scan) // scan.keep_every) + len(scan.groups)
            transfer = HitTransfer(self._cupy, max_hits, nested=self._scene.has_matrices)
            try:
                hit_counts, counted = self.scan_on_device(scan, transfer.send)
            finally:  # Wait in any case, because the device still writes to this memory.
                ray, distance, triangle, instance = transfer.finish()
        tally = None
        if counted is not None:
            tally = np.zeros(self._scene.face_count, np.int64)
            tally[counted[0]] = counted[1]
        return ScanReturns(ray, distance, triangle, hit_counts, tally, instance)

    def scan_on_device(
        self,
        scan: Scan,
        use: Callable[[DeviceHits], object],
        counters: tuple[Ints, int] | None = None,
        external_hits: ExternalHits | None = None,
    ) -> tuple[Ints, TallyCounts | None]:
        """Cast a scan and pass its hits to `use` on the device. See `RayCaster.scan_on_device`."""
        cp = self._cupy
        scene = self._scene
        groups = HitGroups(scan.groups, scan.keep_every)
        with self._device:
            counting = self._no_counters
            if scan.tally:
                table, size = (scene.counters, scene.face_count) if counters is None else counters
                counting = to_device(cp, table), np.int32(1), cp.zeros(size, np.int64)
            chunks = (
                self._cast_chunk(scan, start, stop, groups, external_hits)
                for start, stop in scan.chunks(self.chunk)
            )
            try:
                for chunk in _one_behind(chunks):
                    packed = self._pack(chunk, groups, scene.frame.scale, counting)
                    use(DeviceHits(*packed, cp, partial(_select_rays, chunk.start, chunk.rays)))
            except BaseException:  # The device still writes the counts of the next chunk.
                cp.cuda.get_current_stream().synchronize()
                raise
            return groups.hit_counts, self._nonzero_counters(counting[2]) if scan.tally else None

    def upload_rays(
        self, scan: Scan, start: int, stop: int, time_index: Ints32, end: float
    ) -> DeviceNearestHits:
        """Copy rays `start` to `stop` of a scan to the device. See `RayCaster.upload_rays`."""
        cp = self._cupy
        n = stop - start
        with self._device:
            if scan.pattern.sub_rays is None:
                rays = self._make_rays(scan, start, stop)
            else:  # The kernel does not support sub-rays.
                rays = cp.asarray(host_rays(scan, start, stop))
            return DeviceNearestHits(
                rays=rays,
                time_index=cp.asarray(time_index),
                distance=cp.full(n, end, np.float64),
                body=cp.full(n, -1, np.int64),
                instance=cp.zeros(n, np.int32),
                triangle=cp.zeros(n, np.int32),
                cupy=cp,
            )

    def cast_bodies(self, bodies: TimedBodies, nearest: DeviceNearestHits) -> None:
        """Cast rays at bodies on the device, and record closer hits in `nearest`."""
        cp = self._cupy
        n = len(nearest.time_index)
        limits = (np.float64(t * self._scene.frame.scale) for t in bodies.limits)
        with self._device:
            body, poses, boxes = map(cp.asarray, (bodies.body, bodies.poses, bodies.boxes))
            self._run(
                "cast_bodies",
                n,
                *self._meshes,
                *self._instance_tables,
                nearest.rays,
                nearest.time_index,
                np.int64(n),
                body,
                np.int32(len(body)),
                poses,
                boxes,
                np.int32(bodies.first_time),
                np.int32(len(poses)),
                *limits,
                nearest.distance,
                nearest.body,
                nearest.instance,
                nearest.triangle,
            )

    def _nonzero_counters(self, tally: Any) -> TallyCounts:
        """Copy the nonzero counters to the host, because most counters are zero."""
        rows = self._cupy.flatnonzero(tally)
        return rows.get(), tally[rows].get()

    def _apply_external_hits(
        self, hits: tuple[Any, Any, Any], start: int, n: int, external_hits: ExternalHits | None
    ) -> tuple[Any, ...]:
        """Replace hits in a chunk of n rays where an external hit is closer.

        Return the arguments of the kernel `pack` that describe the external hits.
        """
        if external_hits is None:
            return self._no_external_hits
        span = slice(*np.searchsorted(external_hits.ray, [start, start + n]))
        tables = (
            external_hits.ray[span],
            external_hits.distance[span],
            external_hits.triangle[span],
        )
        ray, meters, triangle = map(self._cupy.asarray, tables)
        count = np.int64(len(ray))
        scale = np.float64(self._scene.frame.scale)
        self._run("replace", len(ray), ray, meters, count, np.int64(start), scale, *hits[:2])
        return meters, triangle, np.int32(len(self._scene.mesh))

    def _make_rays(self, scan: Scan, start: int, stop: int) -> Any:
        """Compute the origins (in meters) and the directions of rays `start` to `stop` of a scan.

        Return a float64 array (6, n) on the device, which is bit-identical to the result of
        `pattern_rays`. Casting rays that are read from memory takes fewer registers and fewer
        double-precision operations than computing each ray again for each triangle.
        """
        cp = self._cupy
        n = stop - start
        directions, pattern_origins = self._pattern_on_device(scan.pattern)
        rows = len(scan.pattern)
        rays = cp.empty((6, n))
        self._run(
            "make_rays",
            n,
            *self._pose_tables(scan.poses, start, stop),
            directions,
            pattern_origins,
            np.int64(rows),
            np.int64((scan.first + start) % rows),
            *self._pattern_flags(scan, start),
            *self._motion_tables(scan.poses, start, stop),
            np.int64(n),
            rays,
        )
        return rays

    def _pose_tables(self, poses: Poses, start: int, stop: int) -> list[Any]:
        """Return the poses' positions and rotations, as arguments of the kernel `make_rays`."""
        span = _pose_span(poses, start, stop)
        matrices = np.zeros(1) if poses.rotations is None else poses.rotations[span]
        # Poses are stored component by component, and `asarray` would keep this memory order.
        return [
            self._cupy.asarray(np.ascontiguousarray(table))
            for table in (poses.positions[span], matrices)
        ]

    def _pattern_flags(self, scan: Scan, start: int) -> list[np.int32]:
        """Return the remaining arguments of the kernel `make_rays`.

        These are the number of rays that use the first pose, the number for each later pose,
        whether there are rotations, and whether the pattern has origins.
        """
        poses = scan.poses
        first_count = poses.rays_per_pose - start % poses.rays_per_pose
        has_rotations = poses.rotations is not None
        has_origins = scan.pattern.origins is not None
        counts = (min(first_count, _MAX_INT), min(poses.rays_per_pose, _MAX_INT))
        return [np.int32(number) for number in (*counts, has_rotations, has_origins)]

    def _motion_tables(self, poses: Poses, start: int, stop: int) -> tuple[Any, ...]:
        """Return delays, velocities, and whether the lidar moves, as arguments of `make_rays`."""
        cp = self._cupy
        motion = poses.motion
        if motion is None:
            return cp.asarray(np.zeros(1)), cp.asarray(np.zeros(1)), np.int32(0)
        span = _pose_span(poses, start, stop)
        rates = np.concatenate([motion.velocities[span], motion.rates[span]], axis=1)
        return cp.asarray(motion.delays), cp.asarray(np.ascontiguousarray(rates)), np.int32(1)

    def _pattern_on_device(self, pattern: Pattern) -> tuple[Any, ...]:
        """Copy a pattern's directions and origins to the device.

        The arrays have shape (3, n) and are copied on first use. If the pattern has no origins, the
        directions are returned in their place, and the kernel does not read them.
        """
        copies = _patterns.setdefault(pattern, {})
        tables = copies.get(self._device.id)
        if tables is None:
            arrays = (pattern.directions, pattern.origins)
            # If two threads copy the pattern at the same time, both copies are correct.
            columns = [to_device(self._cupy, array.T) for array in arrays if array is not None]
            tables = copies[self._device.id] = (columns[0], columns[-1])
        return tables

    def _cast(
        self, table: tuple[Any, Any], n: int, limits: tuple[float, float]
    ) -> tuple[Any, Any, Any]:
        """Find the closest hits on the device.

        `table` contains the origins and directions of n rays. `limits` are the minimum and maximum
        distance in meters.
        """
        t = self._cupy.empty(n)
        row = self._cupy.empty(n, np.int32)
        instance = self._cupy.empty(n if self._scene.has_matrices else 1, np.int32)
        local_limits = [np.float64(t * self._scene.frame.scale) for t in limits]
        scene = (*self._meshes, *self._instance_tables)
        arguments = (*_table_arguments(table), *local_limits, t, row, instance)
        self._run("cast_table", n, *scene, *arguments)
        return t, row, instance

    def _cast_chunk(
        self,
        scan: Scan,
        start: int,
        stop: int,
        groups: HitGroups,
        external_hits: ExternalHits | None,
    ) -> _CastChunk:
        """Cast rays `start` to `stop` of a scan, and count the hits without blocking."""
        rays = _split_rays(self._make_rays(scan, start, stop))
        hits = self._cast(rays, stop - start, (scan.t_min, scan.t_max))
        replacing = self._apply_external_hits(hits, start, stop - start, external_hits)
        return self._count_chunk_hits(start, rays, hits, groups, replacing)

    def _count_chunk_hits(
        self,
        start: int,
        rays: tuple[Any, Any],
        hits: tuple[Any, Any, Any],
        groups: HitGroups,
        external_hits: tuple[Any, ...],
    ) -> _CastChunk:
        """Compute the cumulative number of hits, and start copying the counts to the host.

        The hits are compacted by these sums instead of atomic operations, so that they are in ray
        order and each run returns the same bytes.
        """
        cp = self._cupy
        n = len(hits[1])
        sums = cp.cumsum(hits[1] != -1, dtype=np.int32)
        span, later_starts = groups.find_groups(start, start + n)
        cuts = PendingCopy(cp, sums[cp.asarray(np.append(later_starts, n) - 1)])
        return _CastChunk(
            start=start,
            rays=rays,
            hits=hits,
            external_hits=external_hits,
            sums=sums,
            span=span,
            later_starts=later_starts,
            cuts=cuts,
        )

    def _pack(
        self,
        chunk: _CastChunk,
        groups: HitGroups,
        scale: float,
        counting: tuple[Any, np.int32, Any],
    ) -> tuple[Any, Any, Any, Any]:
        """Count a chunk's hits in `groups` on the device, and compact the hits to store.

        Distances are divided by `scale`. `counting` contains the tally arguments of the kernel
        `pack`. Return the ray indices, distances, triangles and instances.
        """
        cp = self._cupy
        n = len(chunk.hits[1])
        cuts = np.append(0, chunk.cuts.values()).astype(np.int64)
        first_kept, kept_counts = groups.count_hits(chunk.span, np.diff(cuts))
        offsets = np.cumsum(kept_counts) - kept_counts
        starts = np.append(0, chunk.later_starts)
        table = np.minimum([starts, cuts[:-1] + first_kept, offsets], _MAX_INT)
        dtypes = (np.uint32, np.float64, np.int32, np.int32)
        packed = tuple(cp.empty(int(kept_counts.sum()), dtype) for dtype in dtypes)
        self._run(
            "pack",
            n,
            self._meshes[3],
            *chunk.hits,
            chunk.sums,
            np.int64(n),
            np.float64(scale),
            np.int64(chunk.start),
            *chunk.external_hits,
            cp.asarray(table.astype(np.int32)),
            np.int32(len(kept_counts)),
            np.int32(min(groups.keep_every, _MAX_INT)),
            *counting,
            *packed,
        )
        return packed

    def _run(self, kernel: str, threads: int, *arguments: Any) -> None:
        """Launch a kernel with one thread per item, unless there are no items.

        The grid has one dimension with fewer than 2**31 blocks, which is enough for 2**38 items.
        """
        if threads:
            grid = (-(-threads // _BLOCK),)
            self._module.get_function(kernel)(grid, (_BLOCK,), arguments)


def _one_behind(items: Iterable[T]) -> Iterator[T]:
    """Yield each item only after the next item has been computed.

    This way, the device casts the next chunk while the host waits for the hits of the current
    chunk.
    """
    waiting: list[T] = []
    for item in items:
        waiting.append(item)
        if len(waiting) > 1:
            yield waiting.pop(0)
    yield from waiting


def _split_rays(rays: Any) -> tuple[Any, Any]:
    return rays[:3], rays[3:]


def _table_arguments(table: tuple[Any, Any]) -> tuple[Any, np.int64, Any, np.int64]:
    """Return kernel arguments for origins and directions, each followed by its column count."""
    origins, directions = table
    return origins, np.int64(origins.shape[1]), directions, np.int64(directions.shape[1])


def _select_rays(start: int, table: tuple[Any, Any], ray: Any) -> tuple[Any, Any]:
    """Return the origins and directions of selected rays.

    The first column of the table belongs to ray `start`. The results have shape (3, k).
    """
    origins, directions = (column.take(ray - start, axis=1) for column in table)
    return origins, directions


def _pose_span(poses: Poses, start: int, stop: int) -> slice:
    """Return the slice of poses to which rays `start` to `stop` belong."""
    return slice(start // poses.rays_per_pose, -(-stop // poses.rays_per_pose))


def kernel_source() -> str:
    """Return the source code of intersect.cu, preceded by its file name for compiler messages."""
    text = importlib.resources.files(__package__).joinpath("intersect.cu").read_text("utf-8")
    return f'#line 1 "intersect.cu"\n{text}'


def compiler_options(stack: int, nested: bool, masked: bool) -> tuple[str, ...]:
    """Return the compiler options for intersect.cu.

    `stack` is the maximum number of pending nodes in a traversal. `nested` states whether the scene
    has instances, and `masked` whether parts of triangles are transparent.
    """
    scene_flags = (f"-DNESTED={int(nested)}", f"-DMASKED={int(masked)}")
    return ("-std=c++17", "-fmad=false", f"-DSTACK={stack}", *scene_flags)


@lru_cache(maxsize=64)
def _compiled(cupy: Any, device: int, options: tuple[str, ...]) -> Any:
    """Compile the kernels for the current device, and cache the result by device index."""
    module = cupy.RawModule(code=kernel_source(), options=options)
    module.compile()
    return module


def _has_cuda_headers() -> bool:
    """Return whether CuPy will find the CUDA headers, which it needs to compile kernels.

    Runtime containers contain a driver and a compiler, but no headers.
    """
    try:
        from cuda.pathfinder import find_nvidia_header_directory
    except ImportError:  # Versions of CuPy without cuda.pathfinder find the headers differently.
        return True
    return find_nvidia_header_directory("cudart") is not None


def _device(cupy: Any, number: int | None) -> Any:
    """Return the device with the given index, or the current device if it is None.

    Raises ValueError if the device does not exist.
    """
    count = cupy.cuda.runtime.getDeviceCount()
    if number is not None and not 0 <= number < count:
        raise ValueError(
            f"CUDA device {number} does not exist. This process has {count} devices, numbered "
            "from 0."
        )
    return cupy.cuda.Device(number)
