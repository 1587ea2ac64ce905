"""Ray casting on a CUDA device, through CuPy."""

from __future__ import annotations

import importlib.resources
import importlib.util
from functools import lru_cache
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from .backend import Backend, Found
from .hits import Returns
from .layout import lay_out
from .mesh import LocalMesh
from .rays import Pattern, Rays

_BLOCK = 128  # threads; intersect.cu is bound to it
_STACK_STEP = 32


class CudaBackend(Backend):
    """The walk of intersect.cu, one thread a ray; only hits come back from the device."""

    name: ClassVar[str] = "cuda"
    chunk: ClassVar[int] = 1 << 22  # rays: some 150 MB on the device

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
        return ""

    def __init__(
        self, mesh: LocalMesh, threads: int | None = None, device: int | None = None
    ) -> None:
        super().__init__(mesh, threads, device)
        self._cupy = cupy = self._library()
        self._device = _device(cupy, device)
        layout = lay_out(mesh)
        with self._device:
            _check_memory(cupy, layout.nbytes)
            tables = (layout.nodes, layout.triangles, layout.corners, layout.faces, layout.frame)
            self._scene = tuple(cupy.asarray(table) for table in tables)
            self._corners, self._faces, self._frame = self._scene[2:]
            # In steps, so that scenes share what is compiled.
            self._stack = -(-max(layout.stack, 1) // _STACK_STEP) * _STACK_STEP
            self._module = _module(cupy, self._device.id, self._stack)
        # {pattern: its directions on the device}
        self._patterns: WeakKeyDictionary[Pattern, Any] = WeakKeyDictionary()

    @staticmethod
    def _library() -> Any:
        """CuPy, loaded when it is needed; the tests put another in its place."""
        import cupy

        return cupy

    def closest(self, rays: Rays, weights: bool) -> Found:
        """See `Backend.closest`."""
        cp = self._cupy
        with self._device:
            stride = np.int32(0 if len(rays.origins) == 1 else 3)
            table = (cp.asarray(rays.origins), stride, cp.asarray(rays.directions))
            limits = (np.float64(t * self._mesh.scale) for t in (rays.t_min, rays.t_max))
            count = np.int64(len(rays))
            ray, t, place = self._hits("cast_table", len(rays), (*table, count, *limits))
            u = v = cp.empty(0)
            if weights:
                u, v = cp.empty(len(ray)), cp.empty(len(ray))
                hits = (ray, place, np.int64(len(ray)), u, v)
                self._launch("weigh_table", len(ray), (self._corners, self._frame, *table, *hits))
            return Found(ray.get(), t.get(), self._faces[place].get(), u.get(), v.get())

    def scan(
        self,
        pattern: Pattern,
        window: tuple[int, int],
        origin: NDArray[np.float64],
        rotation: NDArray[np.float64] | None,
        interval: tuple[float, float],
    ) -> Returns:
        """See `Backend.scan`; the rays are made on the device."""
        cp = self._cupy
        ray = [np.zeros(0, np.int64)]
        distance = [np.zeros(0)]
        triangle = [np.zeros(0, np.int32)]
        turn = np.eye(3) if rotation is None else rotation
        with self._device:
            if pattern not in self._patterns:
                self._patterns[pattern] = cp.asarray(pattern.directions)
            directions = self._patterns[pattern][slice(*window)]
            pose = cp.asarray(np.concatenate([origin.ravel(), turn.ravel()]))
            limits = [np.float64(t * self._mesh.scale) for t in interval]
            for start in range(0, len(directions), self.chunk):
                part = directions[start : start + self.chunk]
                rays = (pose, np.int32(rotation is not None), part, np.int64(len(part)), *limits)
                hit, t, place = self._hits("cast_pattern", len(part), rays)
                ray.append(hit.get() + start)
                distance.append(t.get() / self._mesh.scale)
                triangle.append(self._faces[place].get())
        return Returns(np.concatenate(ray), np.concatenate(distance), np.concatenate(triangle))

    def _hits(self, kernel: str, n: int, rays: tuple[Any, ...]) -> tuple[Any, Any, Any]:
        """Run a cast and keep the hits: ray, local distance, place; on the device."""
        cp = self._cupy
        t, place = cp.empty(n), cp.empty(n, np.int32)
        self._launch(kernel, n, (*self._scene, *rays, t, place))
        # Compacted by a scan in ray order, not by atomics: the same bytes on every run.
        ray = cp.flatnonzero(place >= 0)  # int64, as weigh_table takes it
        return ray, t[ray], place[ray]

    def _launch(self, kernel: str, n: int, arguments: tuple[Any, ...]) -> None:
        if n:
            self._module.get_function(kernel)((-(-n // _BLOCK),), (_BLOCK,), arguments)


def source() -> str:
    """Text of intersect.cu, with its name for the compiler's messages."""
    text = importlib.resources.files(__package__).joinpath("intersect.cu").read_text("utf-8")
    return f'#line 1 "intersect.cu"\n{text}'


def options(stack: int) -> tuple[str, ...]:
    """Compiler options for `source`; `stack` is the most nodes that may wait in a walk."""
    return ("-std=c++17", "-fmad=false", f"-DSTACK={stack}")


@lru_cache(maxsize=32)
def _module(cupy: Any, device: int, stack: int) -> Any:
    """Compile for the current device, once."""
    module = cupy.RawModule(code=source(), options=options(stack))
    module.compile()
    return module


def _device(cupy: Any, number: int | None) -> Any:
    """Return the device of that number, or the current one; raises ValueError if it is none."""
    count = cupy.cuda.runtime.getDeviceCount()
    if number is not None and not 0 <= number < count:
        raise ValueError(f"There is no CUDA device {number}: this process sees {count}, from 0.")
    return cupy.cuda.Device(number)


def _check_memory(cupy: Any, need: int) -> None:
    """Raise MemoryError when the tables, and room to work, do not fit on the device."""
    free = cupy.cuda.runtime.memGetInfo()[0] + cupy.get_default_memory_pool().free_bytes()
    work = 1 << 28
    if need + work > free:
        raise MemoryError(
            f"The mesh needs {(need + work) / 2**20:.0f} MiB on the CUDA device and "
            f"{free / 2**20:.0f} MiB are free: use a smaller mesh or backend 'embree'."
        )
