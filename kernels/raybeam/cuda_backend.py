"""Ray casting on a CUDA device, through CuPy."""

from __future__ import annotations

import importlib.resources
import importlib.util
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any, ClassVar, cast
from weakref import WeakKeyDictionary

import numpy as np

from .arrays import AnyArray, Ints
from .backend import Backend, Found
from .crossing import Nearest, Swept
from .device import DeviceHits, OtherHits, to_device
from .hits import Counted, Part, ScanReturns, joined
from .instances import Scene
from .layout import lay_out, lay_out_places
from .opacity import Masks
from .pattern import Pattern
from .poses import Poses
from .rays import Rays
from .scan import Groups, Scan

_BLOCK = 128  # threads; the kernels are bound to it
_STACK_STEP = 32
# Tables that are not read where all triangles are opaque.
NO_MASKS = np.zeros((1, 6), np.float32), np.zeros(1, np.uint8), np.zeros((1, 4), np.int64)
_MOST_INT = (1 << 31) - 1  # rays of a pose for intersect.cu: more than a chunk has


class CudaBackend(Backend):
    """The traversal of intersect.cu, one thread a ray; only kept hits leave the device.

    Kernels and copies use the thread's current stream, and every call ends with a copy to the
    host, for which CuPy waits: when it returns, the device no longer uses the call's memory.
    Tables and patterns outlive a call; their creation is waited for, so that threads with other
    streams may use them. All calls switch to the caster's device and back.

    NumPy builds the tree (layout.py). Building it on the device took as much code as the
    traversal, and saved a worker two seconds for each million triangles, once.
    """

    name: ClassVar[str] = "cuda"
    on_device: ClassVar[bool] = True
    # Rays: some 300 MB on the device, and while columns are copied again as much. Grid, sums of
    # hits and indices into a chunk's arrays stay far below 2**31; only the number of a ray needs
    # 64 bits.
    chunk: ClassVar[int] = 1 << 21

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        if importlib.util.find_spec("cupy") is None:
            return "CuPy is not installed: pip install cupy-cuda12x or cupy-cuda13x"
        try:
            import cupy
        except ImportError as error:
            return f"CuPy does not load ({error})"
        try:
            count = cupy.cuda.runtime.getDeviceCount()
        except cupy.cuda.runtime.CUDARuntimeError as error:
            return f"CuPy finds no CUDA device ({error})"
        if not count:
            return "there is no CUDA device"
        try:
            cupy.cuda.nvrtc.getVersion()
        except RuntimeError as error:
            said = str(error).partition("\n")[0]
            return f"CuPy finds no compiler ({said}): pip install 'cupy-cuda13x[ctk]', or 12x"
        if not _headers():
            return "CuPy finds no CUDA headers: pip install 'cupy-cuda13x[ctk]', or 12x"
        return ""

    def __init__(self, scene: Scene, threads: int | None = None, device: int | None = None) -> None:
        super().__init__(scene, threads, device)
        self._cupy = cupy = self._library()
        self._device = _device(cupy, device)
        made = lay_out(scene.meshes)
        self._roots = made.roots
        self._stack = made.stack
        self._masked = made.masks is not None
        with self._device:
            masks = made.masks or Masks(*NO_MASKS)
            tables = (made.nodes, made.triangles, made.corners, made.faces)
            given = (*tables, masks.uv, masks.mask, masks.records)
            self._meshes = tuple(to_device(cupy, table) for table in given)
            nothing = (to_device(cupy, np.zeros(2, np.int64)), np.int32(0))
            self._uncounted = (*nothing, cupy.zeros(1, np.int64))
            self._none = cupy.zeros(1), cupy.zeros(1, np.int32), np.int32(0)
        # {pattern: its directions on the device, and its origins if it has any}
        self._patterns: WeakKeyDictionary[Pattern, tuple[Any, ...]] = WeakKeyDictionary()
        self.place(scene)

    def place(self, scene: Scene) -> None:
        """See `Backend.place`."""
        super().place(scene)
        made = lay_out_places(scene, self._roots)
        with self._device:
            # In steps, so that scenes share compiled kernels.
            stack = -(-max(self._stack + made.stack, 1) // _STACK_STEP) * _STACK_STEP
            self._module = _compiled(
                self._cupy, self._device.id, flags(stack, scene.nested, self._masked)
            )
            given = (made.frame, made.top, made.instances)
            self._places = tuple(to_device(self._cupy, table) for table in given)

    @staticmethod
    def _library() -> Any:
        """CuPy, loaded on first use; tests replace it."""
        import cupy

        return cupy

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        cp = self._cupy
        n = len(rays)
        with self._device:
            stride = np.int32(0 if len(rays.origins) == 1 else 3)
            origins, directions = map(np.ascontiguousarray, (rays.origins, rays.directions))
            table = (cp.asarray(origins), stride, cp.asarray(directions))
            limits = (np.float64(t * self._scene.frame.scale) for t in (rays.t_min, rays.t_max))
            found = self._cast("cast_table", n, (*table, np.int64(n), *limits))
            groups = Groups(np.zeros(1, np.int64), 1)
            ray, *hits, instance = self._packed(found, 0, groups, 1.0, self._uncounted, self._none)
            u = cp.empty(len(ray))
            v = cp.empty(len(ray))
            frame, _, instances = self._places
            scene = (self._meshes[2], frame, instances)
            given = (*scene, *table, ray, *found[1:], np.int64(len(ray)))
            self._run("weigh_table", len(ray), *given, u, v)
            return Found(*(array.get() for array in (ray, *hits, u, v, instance)))

    def scan(self, scan: Scan) -> ScanReturns:
        """See `Backend.scan`."""
        if scan.pattern.sub_rays is not None:  # which the kernel does not make
            return super().scan(scan)
        if scan.room is not None:
            scan.rays(0, len(scan))  # which writes them
        kept: list[Part] = []
        hits, counted = self.visit(scan, lambda found: kept.append(found.get()))
        ray, distance, triangle, instance = joined(kept)
        tally = None
        if counted is not None:
            tally = np.zeros(self._scene.face_count, np.int64)
            tally[counted[0]] = counted[1]
        return ScanReturns(ray, distance, triangle, hits, tally, instance)

    def visit(
        self,
        scan: Scan,
        use: Callable[[DeviceHits], object],
        counters: tuple[Ints, int] | None = None,
        others: OtherHits | None = None,
    ) -> tuple[Ints, Counted | None]:
        """See `RayCaster.visit`."""
        cp = self._cupy
        scene = self._scene
        groups = Groups(scan.groups, scan.keep_every)
        with self._device:
            counting = self._uncounted
            if scan.tally:
                table, size = (scene.counters, scene.face_count) if counters is None else counters
                counting = to_device(cp, table), np.int32(1), cp.zeros(size, np.int64)
            for start, n, rays in self._made(scan):
                found = self._cast("cast_pattern", n, rays)
                replaced = self._replaced(found, start, n, others)
                kept = self._packed(found, start, groups, scene.frame.scale, counting, replaced)
                use(DeviceHits(*kept, cp, partial(self._rays, start, rays)))
            return groups.hits, self._counted(counting[2]) if scan.tally else None

    def sweep(self, sweep: Swept, nearest: Nearest) -> None:
        """See `Backend.sweep`."""
        cp = self._cupy
        n = len(sweep.when)
        kept = cast(tuple[AnyArray, ...], nearest)
        limits = (np.float64(t * self._scene.frame.scale) for t in sweep.limits)
        with self._device:
            rays, when, body, poses, boxes = map(cp.asarray, sweep[:5])
            found = [cp.asarray(column) for column in kept]
            numbers = body, np.int32(len(body)), poses, boxes, np.int32(len(poses))
            given = rays, when, np.int64(n), *numbers, *limits
            self._run("cast_bodies", n, *self._meshes, *self._places, *given, *found)
            for column, out in zip(found, kept, strict=True):
                out[:] = column.get()

    def _counted(self, tally: Any) -> Counted:
        """Copy to the host what was counted: most rows of a tally are 0."""
        rows = self._cupy.flatnonzero(tally)
        return rows.get(), tally[rows].get()

    def _replaced(
        self, found: tuple[Any, Any, Any], start: int, n: int, others: OtherHits | None
    ) -> tuple[Any, ...]:
        """Let other hits replace those of a cast that are farther; arguments of `pack`."""
        if others is None:
            return self._none
        span = slice(*np.searchsorted(others.ray, [start, start + n]))
        tables = (others.ray[span], others.distance[span], others.triangle[span])
        ray, metres, triangle = map(self._cupy.asarray, tables)
        count = np.int64(len(ray))
        scale = np.float64(self._scene.frame.scale)
        self._run("replace", len(ray), ray, metres, count, np.int64(start), scale, *found[:2])
        return metres, triangle, np.int32(len(self._scene.mesh))

    def _rays(self, start: int, rays: tuple[Any, ...], ray: Any) -> tuple[Any, Any]:
        """Make starts and directions of rays of a chunk, on the device."""
        cp = self._cupy
        n = len(ray)
        origins = cp.empty((3, n))
        directions = cp.empty((3, n))
        numbers = ray, np.int64(start), np.int64(n)
        self._run("make_rays", n, *rays[:-3], *numbers, origins, directions)
        return origins, directions

    def _made(self, scan: Scan) -> Iterator[tuple[int, int, tuple[Any, ...]]]:
        """Chunks of a scan: number of the first ray, how many, and arguments for cast_pattern."""
        cp = self._cupy
        poses = scan.poses
        unused = np.zeros(1)
        limits = [np.float64(t * self._scene.frame.scale) for t in (scan.t_min, scan.t_max)]
        shifted = scan.pattern.origins is not None
        turned = poses.rotations is not None
        tables = self._resident(scan.pattern)
        rows = len(scan.pattern)
        for start, stop in scan.chunks(self.chunk):
            n = stop - start
            pose, skip = divmod(start, poses.rays)
            span = slice(pose, -(-stop // poses.rays))
            matrices = unused if poses.rotations is None else poses.rotations[span]
            # `asarray` keeps the order of memory, and poses are stored by component.
            places = [
                cp.asarray(np.ascontiguousarray(a)) for a in (poses.positions[span], matrices)
            ]
            motion = self._motion(poses, span)
            counts = (min(number, _MOST_INT) for number in (poses.rays - skip, poses.rays))
            flags = (np.int32(flag) for flag in (*counts, turned, shifted))
            window = (np.int64(rows), np.int64((scan.first + start) % rows))
            given = (*places, tables[0], tables[-1], *window)
            yield start, n, (*given, *flags, *motion, np.int64(n), *limits)

    def _motion(self, poses: Poses, span: slice) -> tuple[Any, ...]:
        """Arguments for cast_pattern: delays, rates of some poses, and whether there are any."""
        cp = self._cupy
        motion = poses.motion
        if motion is None:
            return cp.asarray(np.zeros(1)), cp.asarray(np.zeros(1)), np.int32(0)
        rates = np.concatenate([motion.velocities[span], motion.rates[span]], axis=1)
        return cp.asarray(motion.delays), cp.asarray(np.ascontiguousarray(rates)), np.int32(1)

    def _resident(self, pattern: Pattern) -> tuple[Any, ...]:
        """Directions and origins of a pattern on the device, (3, n) each, one row for each axis."""
        kept = self._patterns.get(pattern)
        if kept is None:
            given = (pattern.directions, pattern.origins)
            # If two threads come here, the second copy is kept, and both are right.
            kept = self._patterns[pattern] = tuple(
                to_device(self._cupy, table.T) for table in given if table is not None
            )
        return kept

    def _cast(self, kernel: str, n: int, rays: tuple[Any, ...]) -> tuple[Any, Any, Any]:
        """Local distance, table row and instance of the closest hit of each ray, on the device."""
        t = self._cupy.empty(n)
        place = self._cupy.empty(n, np.int32)
        instance = self._cupy.empty(n if self._scene.nested else 1, np.int32)
        self._run(kernel, n, *self._meshes, *self._places, *rays, t, place, instance)
        return t, place, instance

    def _packed(
        self,
        found: tuple[Any, Any, Any],
        start: int,
        groups: Groups,
        scale: float,
        counting: tuple[Any, np.int32, Any],
        others: tuple[Any, ...],
    ) -> tuple[Any, Any, Any, Any]:
        """Count the hits of a cast and close up those that are kept, all on the device.

        Distances are divided by `scale`. `counting` and `others` are arguments of the kernel
        `pack`. Returns numbers of the rays, from `start` on, distances, the caller's
        triangles, and instances.
        """
        cp = self._cupy
        n = len(found[1])
        # Closed up by sums in ray order, not by atomics: the same bytes on every run.
        ends = cp.cumsum(found[1] != -1, dtype=np.int32)
        span, begins = groups.spans(start, start + n)
        cuts = np.append(0, ends[cp.asarray(np.append(begins, n) - 1)].get()).astype(np.int64)
        leave, number = groups.count(span, np.diff(cuts))
        before = np.cumsum(number) - number
        table = np.minimum([np.append(0, begins), cuts[:-1] + leave, before], _MOST_INT)
        kinds = (np.uint32, np.float64, np.int32, np.int32)
        kept = tuple(cp.empty(int(number.sum()), kind) for kind in kinds)
        self._run(
            "pack", n, self._meshes[3], *found, ends, np.int64(n), np.float64(scale),
            np.int64(start), *others, cp.asarray(table.astype(np.int32)), np.int32(len(number)),
            np.int32(min(groups.every, _MOST_INT)), *counting, *kept,
        )  # fmt: skip
        return kept

    def _run(self, kernel: str, threads: int, *arguments: Any) -> None:
        """Launch a kernel with one thread for each item; does nothing without items.

        A grid has one dimension, of fewer than 2**31 blocks: room for 2**38 items.
        """
        if threads:
            grid = (-(-threads // _BLOCK),)
            self._module.get_function(kernel)(grid, (_BLOCK,), arguments)


def source() -> str:
    """Text of intersect.cu, with its name for the compiler's messages."""
    text = importlib.resources.files(__package__).joinpath("intersect.cu").read_text("utf-8")
    return f'#line 1 "intersect.cu"\n{text}'


def flags(stack: int, nested: bool, masked: bool) -> tuple[str, ...]:
    """Compiler options of intersect.cu.

    `stack` is the most nodes that wait in a traversal; `nested` says whether there are instances,
    `masked` whether parts of triangles are transparent.
    """
    kinds = f"-DNESTED={int(nested)}", f"-DMASKED={int(masked)}"
    return "-std=c++17", "-fmad=false", f"-DSTACK={stack}", *kinds


@lru_cache(maxsize=64)
def _compiled(cupy: Any, device: int, flags: tuple[str, ...]) -> Any:
    """Compile the kernels for the current device, whose number is `device`, once."""
    module = cupy.RawModule(code=source(), options=flags)
    module.compile()
    return module


def _headers() -> bool:
    """Whether CuPy will find the headers of CUDA, without which it compiles nothing.

    Runtime containers have a driver and a compiler, but no headers.
    """
    try:
        from cuda.pathfinder import find_nvidia_header_directory
    except ImportError:  # this version of CuPy finds them in another way
        return True
    return find_nvidia_header_directory("cudart") is not None


def _device(cupy: Any, number: int | None) -> Any:
    """Return the device of that number, or the current one; ValueError if it does not exist."""
    count = cupy.cuda.runtime.getDeviceCount()
    if number is not None and not 0 <= number < count:
        raise ValueError(f"There is no CUDA device {number}: this process sees {count}, from 0.")
    return cupy.cuda.Device(number)
