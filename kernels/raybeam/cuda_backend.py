"""Ray casting on a CUDA device, through CuPy."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from . import cuda_build
from .backend import Backend, Found
from .cuda_module import Kernels, options
from .cuda_results import Packer, PinnedRoom
from .hits import ScanReturns
from .layout import Layout, lay_out
from .memory import require
from .mesh import LocalMesh
from .pattern import Pattern
from .rays import Rays
from .scan import Collector, Scan

_STACK_STEP = 32
_MOST_INT = (1 << 31) - 1  # rays of a pose, as intersect.cu is told: more than a chunk has
_KEEP = 1 << 30  # bytes of hits that wait on the device, at most
# Bytes left free for a chunk of rays and for the walk's stacks, of which each resident thread has
# one: 2048 for each of 132 multiprocessors, 64 places of 8 bytes, are 138 MB.
_WORK = 3 << 28
_LAYOUT_BYTES = 330  # on the host a triangle, at the peak of a build by NumPy, the mesh apart
_TABLE_BYTES = 124  # on the device a triangle in the finished tables, the nodes apart


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
            tables = self._built()
            # In steps, so that scenes share what is compiled.
            self._stack = -(-max(tables.stack, 1) // _STACK_STEP) * _STACK_STEP
            self._kernels = Kernels(cupy, self._device.id, "intersect.cu", flags(self._stack))
            self._keep = max(0, min(_KEEP, (self._free() - _WORK) // 4))
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

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        cp, n = self._cupy, len(rays)
        with self._device:
            stride = np.int32(0 if len(rays.origins) == 1 else 3)
            table = (cp.asarray(rays.origins), stride, cp.asarray(rays.directions))
            limits = (np.float64(t * self._mesh.scale) for t in (rays.t_min, rays.t_max))
            t, place = self._cast("cast_table", n, (*table, np.int64(n), *limits))
            ray, *hits = self._packer().add(t, place, 0, 1.0)
            u, v = cp.empty(len(ray)), cp.empty(len(ray))
            given = (self._corners, self._frame, *table, ray, place, np.int64(len(ray)))
            self._kernels.run("weigh_table", len(ray), *given, u, v)
            return Found(*(array.get() for array in (ray, *hits, u, v)))

    def scan(self, scan: Scan) -> ScanReturns:
        """See `Backend.scan`; the rays are made on the device, hits are chosen on the host."""
        with self._device:
            packer = self._packer()
            for start, n, rays in self._made(scan):
                packer.add(*self._cast("cast_pattern", n, rays), start, self._mesh.scale)
            ray, distance, triangle = packer.returns()
        collector = Collector(scan, self._mesh.face_count)
        collector.tally(triangle)
        kept = collector.keep(ray, 0, len(scan))
        collector.add(0, ray[kept], distance[kept], triangle[kept])
        return collector.result()

    # ---- the scene ----

    def _built(self) -> Layout:
        """Build the tables on the device where that is faster, and where there is memory for it.

        Raises MemoryError if even the finished tables do not fit the device, or their making the
        host.
        """
        cupy, mesh, there = self._cupy, self._mesh, self._free()
        n = len(mesh.corners)
        if n >= self.device_build and cuda_build.BYTES * n + _WORK <= there:
            tables = cuda_build.build(cupy, self._device.id, mesh)
            cupy.get_default_memory_pool().free_all_blocks()  # several times what is kept
            return tables
        need = _TABLE_BYTES * n + _WORK
        if need > there:  # before NumPy builds for minutes
            raise MemoryError(
                f"The mesh needs {need / 2**20:.0f} MiB on the CUDA device and "
                f"{there / 2**20:.0f} MiB are free: use a smaller mesh or backend 'embree'."
            )
        require(_LAYOUT_BYTES * n, f"The tree over {n:,} triangles")
        made = lay_out(mesh)
        given = (made.nodes, made.triangles, made.corners, made.faces, made.frame)
        nodes, triangles, corners, faces, frame = (_sent(cupy, table) for table in given)
        return Layout(nodes, triangles, corners, faces, frame, made.stack)

    def _free(self) -> int:
        """Bytes that can be had on the device."""
        pool = self._cupy.get_default_memory_pool()
        return int(self._cupy.cuda.runtime.memGetInfo()[0] + pool.free_bytes())

    # ---- casts ----

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
            if sum(table.nbytes for table in tables) + self._keep + _WORK > self._free():
                return None
            # Two threads may both come here: then the second copy is kept, and both are right.
            kept = self._patterns[pattern] = tuple(_sent(cupy, table) for table in tables)
        return kept

    def _packer(self) -> Packer:
        return Packer(self._cupy, self._kernels, self._faces, self._room, self._keep)

    def _cast(self, kernel: str, n: int, rays: tuple[Any, ...]) -> tuple[Any, Any]:
        """Local distance and place of the closest hit of each ray, on the device."""
        t, place = self._cupy.empty(n), self._cupy.empty(n, np.int32)
        self._kernels.run(kernel, n, *self._scene, *rays, t, place)
        return t, place


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


def _sent(cupy: Any, array: NDArray[Any]) -> Any:
    """Copy an array to the current device, and wait for that.

    A device that reads ordinary memory itself, as Grace Hopper does, may still be about to read
    when `set` returns: the caller may let go of the array once this has returned.

    Not by `asarray`, which copies by way of page-locked memory as large as the array and keeps
    that: right for the rays of a chunk, too much for a scene.
    """
    copy = cupy.empty(array.shape, array.dtype)
    if array.size:
        copy.set(array)
        cupy.cuda.get_current_stream().synchronize()
    return copy
