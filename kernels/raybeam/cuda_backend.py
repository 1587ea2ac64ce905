"""Ray casting on a CUDA device, through CuPy."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from . import cuda_scene
from .backend import Backend, Found
from .collector import Collector
from .cuda_module import Kernels, options
from .cuda_results import Packer, PinnedRoom
from .cuda_scene import WORK, free, sent
from .hits import Returns, ScanReturns
from .memory import lacking
from .mesh import LocalMesh
from .pattern import Pattern
from .rays import Rays
from .scan import Scan

_STACK_STEP = 32
_RAY_BYTES = 104  # a ray of a chunk: origin, direction, hit with its weights, sums; 101 and room
_MOST_INT = (1 << 31) - 1  # rays of a pose, as intersect.cu is told: more than a chunk has
_KEEP = 1 << 30  # bytes of hits that wait on the device, at most


class CudaBackend(Backend):
    """The walk of intersect.cu, one thread a ray; only hits come back from the device.

    Kernels and copies are in the order of the thread's current stream, and every call ends with
    a copy to the host, for which CuPy waits: when it returns, the device has done with all that
    the call used. What outlives a call, tables and patterns, is waited for when it is made, so
    threads with streams of their own may use it. All calls switch to the caster's device and
    back, whatever device the thread is on.
    """

    name: ClassVar[str] = "cuda"
    # Rays: some 430 MB on the device. The grid, the sums of hits and the places in a chunk's
    # arrays are far from 2**31 with it; only the number of a ray needs 64 bits.
    chunk: ClassVar[int] = 1 << 22
    device_build: ClassVar[int] = 4096  # triangles from which the device builds the tree faster

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

    def __init__(
        self, mesh: LocalMesh, threads: int | None = None, device: int | None = None
    ) -> None:
        super().__init__(mesh, threads, device)
        self._cupy = cupy = self._library()
        self._device = _device(cupy, device)
        with self._device:
            tables = cuda_scene.make(cupy, self._device.id, mesh, self.device_build)
            # In steps, so that scenes share what is compiled.
            self._stack = -(-max(tables.stack, 1) // _STACK_STEP) * _STACK_STEP
            self._kernels = Kernels(cupy, self._device.id, "intersect.cu", flags(self._stack))
            self._keep = max(0, min(_KEEP, (free(cupy) - WORK) // 4))
            cupy.cuda.get_current_stream().synchronize()
        self._corners, self._faces, self._frame = tables.corners, tables.faces, tables.frame
        self._scene = (tables.nodes, tables.triangles, tables.corners, tables.faces, tables.frame)
        self._room = PinnedRoom(cupy)
        # {pattern: its directions on the device, and its origins if it has any}
        self._patterns: WeakKeyDictionary[Pattern, tuple[Any, ...]] = WeakKeyDictionary()

    @staticmethod
    def _library() -> Any:
        """CuPy, loaded when it is needed; the tests put another in its place."""
        import cupy

        return cupy

    @contextmanager
    def _on_device(self, rays: int) -> Iterator[None]:
        """Switch to the device; what it has no memory for is told in both numbers."""
        with self._device:
            try:
                yield
            except self._cupy.cuda.memory.OutOfMemoryError as error:
                need = _RAY_BYTES * min(rays, self.chunk) + 8 * self._mesh.face_count + self._keep
                what = f"On CUDA device {self._device.id} a cast of {rays:,} rays"
                instead = "free some, or use another device or backend 'embree'"
                raise MemoryError(lacking(need, free(self._cupy), what, instead)) from error

    def closest(self, rays: Rays, weights: bool) -> Found:
        """See `Backend.closest`."""
        cp = self._cupy
        with self._on_device(len(rays)):
            table = self._table(rays)
            t, place = self._cast("cast_table", len(rays), self._limited(table, rays))
            ray, *hits = self._packer().add(t, place, 0, 1.0)
            u = v = cp.empty(0)
            if weights:
                u, v = cp.empty(len(ray)), cp.empty(len(ray))
                given = (self._corners, self._frame, *table, ray, place, np.int64(len(ray)))
                self._kernels.run("weigh_table", len(ray), *given, u, v)
            return Found(*(array.get() for array in (ray, *hits, u, v)))

    def along(self, rays: Rays) -> NDArray[np.int32]:
        """See `Backend.along`."""
        triangles = np.arange(self._mesh.face_count, dtype=np.int32)
        return np.repeat(triangles, self.count(rays, every=True))

    def returns(self, rays: Rays) -> Returns:
        """See `Backend.returns`."""
        with self._on_device(len(rays)):
            packer = self._packer()
            for start in range(0, len(rays), self.chunk):
                part = rays.part(start, start + self.chunk)
                given = self._limited(self._table(part), part)
                packer.add(*self._cast("cast_table", len(part), given), start, self._mesh.scale)
            return packer.returns()

    def scan(self, scan: Scan) -> ScanReturns:
        """See `Backend.scan`; the rays are made on the device, hits are chosen on the host."""
        with self._on_device(len(scan)):
            packer = self._packer()
            for start, n, rays in self._made(scan):
                packer.add(*self._cast("cast_pattern", n, rays), start, self._mesh.scale)
            found = packer.returns()
        collector = Collector(scan, self._mesh.face_count)
        collector.tally(found.triangle)
        kept = collector.keep(found.ray, 0, len(scan))
        collector.add(Returns(found.ray[kept], found.distance[kept], found.triangle[kept]))
        return collector.result()

    def count(self, rays: Rays, every: bool) -> NDArray[np.int64]:
        """See `Backend.count`; only the counts leave the device."""
        with self._on_device(len(rays)):
            counts = self._cupy.zeros(self._mesh.face_count, np.int64)
            for start in range(0, len(rays), self.chunk):
                part = rays.part(start, start + self.chunk)
                given = self._limited(self._table(part), part)
                self._tally(len(part), given, every, counts)
            return self._cupy.asnumpy(counts)

    # ---- arguments of the kernels ----

    def _table(self, rays: Rays) -> tuple[Any, ...]:
        stride = np.int32(0 if len(rays.origins) == 1 else 3)
        return self._cupy.asarray(rays.origins), stride, self._cupy.asarray(rays.directions)

    def _limited(self, table: tuple[Any, ...], rays: Rays) -> tuple[Any, ...]:
        limits = (np.float64(t * self._mesh.scale) for t in (rays.t_min, rays.t_max))
        return (*table, np.int64(len(rays)), *limits)

    def _made(self, scan: Scan) -> Iterator[tuple[int, int, tuple[Any, ...]]]:
        """Chunks of a scan: number of the first ray, how many, and arguments for cast_pattern."""
        cp, poses, unused = self._cupy, scan.poses, np.zeros(1)
        limits = [np.float64(t * self._mesh.scale) for t in (scan.t_min, scan.t_max)]
        shifted, turned = scan.pattern.origins is not None, poses.rotations is not None
        resident = self._resident(scan.pattern)
        for start, stop in scan.chunks(self.chunk):
            n = stop - start
            tables, rows, first = resident, len(scan.pattern), (scan.first + start)
            if tables is None:
                row = (first + np.arange(n)) % rows
                tables = tuple(cp.asarray(t.take(row, axis=1)) for t in _tables(scan.pattern))
                rows, first = n, 0
            pose, skip = divmod(start, poses.rays)
            span = slice(pose, -(-stop // poses.rays))
            matrices = unused if poses.rotations is None else poses.rotations[span]
            places = [
                cp.asarray(np.ascontiguousarray(a)) for a in (poses.positions[span], matrices)
            ]
            counts = (min(number, _MOST_INT) for number in (poses.rays - skip, poses.rays))
            flags = (np.int32(flag) for flag in (*counts, turned, shifted))
            given = (*places, tables[0], tables[-1], np.int64(rows), np.int64(first % rows))
            yield start, n, (*given, *flags, np.int64(n), *limits)

    def _resident(self, pattern: Pattern) -> tuple[Any, ...] | None:
        """Directions and origins of a pattern on the device, if there is room for all of them."""
        cupy, kept = self._cupy, self._patterns.get(pattern)
        if kept is None:
            tables = _tables(pattern)
            if sum(table.nbytes for table in tables) + self._keep + WORK > free(cupy):
                return None
            # Two threads may both come here: then the second copy is kept, and both are right.
            kept = self._patterns[pattern] = tuple(sent(cupy, table) for table in tables)
        return kept

    # ---- casts ----

    def _packer(self) -> Packer:
        return Packer(self._cupy, self._kernels, self._faces, self._room, self._keep)

    def _cast(self, kernel: str, n: int, rays: tuple[Any, ...]) -> tuple[Any, Any]:
        """Local distance and place of the closest hit of each ray, on the device."""
        t, place = self._cupy.empty(n), self._cupy.empty(n, np.int32)
        self._kernels.run(kernel, n, *self._scene, *rays, t, place)
        return t, place

    def _tally(self, n: int, rays: tuple[Any, ...], every: bool, counts: Any) -> None:
        """Add to the counts of a chunk's triangles."""
        if every:
            self._kernels.run("count_table", n, *self._scene, *rays, counts)
            return
        _, place = self._cast("cast_table", n, rays)
        self._kernels.run("count_closest", n, self._faces, place, np.int64(n), counts)


def _tables(pattern: Pattern) -> tuple[NDArray[np.float64], ...]:
    """Directions of a pattern and its origins, if it has any: (3, n) each, one row an axis."""
    given = (pattern.directions, pattern.origins)
    return tuple(table.T for table in given if table is not None)


def flags(stack: int) -> tuple[str, ...]:
    """Compiler options of intersect.cu; `stack` is the most nodes that may wait in a walk."""
    return options(STACK=stack)


def _headers() -> bool:
    """Whether CuPy will find the headers of CUDA, without which it refuses to compile anything.

    A driver and a compiler may well be there without them, as in containers made for running.
    """
    try:
        from cuda.pathfinder import find_nvidia_header_directory
    except ImportError:  # then this CuPy looks for them in another way
        return True
    return find_nvidia_header_directory("cudart") is not None


def _device(cupy: Any, number: int | None) -> Any:
    """Return the device of that number, or the current one; raises ValueError if it is none."""
    count = cupy.cuda.runtime.getDeviceCount()
    if number is not None and not 0 <= number < count:
        raise ValueError(f"There is no CUDA device {number}: this process sees {count}, from 0.")
    return cupy.cuda.Device(number)
