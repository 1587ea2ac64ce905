"""Hits on a CUDA device, and how they are copied to the host."""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from .arrays import AnyArray, Floats, Ints32, UInts32
from .body_rays import BodyHits
from .hits import HitColumns

PINNED_BYTES = 1 << 30  # limit for the page-locked memory of a process
_MAX_PENDING = 2  # pending copies, so that one runs while the next arrays are computed


@dataclass(frozen=True, eq=False)
class DeviceHits:
    """Stored hits in one part of a scan, as CuPy arrays on the current device and stream.

    Attributes
    ----------
    ray, distance, triangle, instance
        (k,): as in `ScanReturns`.
    cupy
        The CuPy module.
    make_rays
        Function that computes the origins and directions of rays from their indices.
    """

    ray: Any
    distance: Any
    triangle: Any
    instance: Any
    cupy: Any
    make_rays: Callable[[Any], tuple[Any, Any]]

    def __len__(self) -> int:
        return len(self.ray)

    def rays(self) -> tuple[Any, Any]:
        """Compute the origins in meters and the unit directions of the rays.

        The arrays are float64 (3, k) and on the device. They are bit-identical to the result of
        `pattern_rays`.
        """
        return self.make_rays(self.ray)

    def get(self) -> HitColumns:
        """Copy the hits to the host."""
        return self.ray.get(), self.distance.get(), self.triangle.get(), self.instance.get()


@dataclass(frozen=True, eq=False)
class ExternalHits:
    """Hits of a scan's rays on surfaces that the caster does not contain, such as moving bodies.

    Attributes
    ----------
    ray
        uint32 (k,): index of the ray, in ascending order and without duplicates.
    distance
        float64 (k,): distance in meters.
    triangle
        int32 (k,): value that is returned as the triangle of the hit.
    """

    ray: UInts32
    distance: Floats
    triangle: Ints32


@dataclass(frozen=True, eq=False)
class DeviceNearestHits:
    """Rays on a CUDA device and their closest hits on moving bodies, as CuPy arrays.

    Attributes
    ----------
    rays
        float64 (6, n): origins in meters and directions.
    time_index
        int32 (n,): index of the firing time of each ray.
    distance, body, instance, triangle
        (n,): as in `NearestHits`.
    cupy
        The CuPy module.
    """

    rays: Any
    time_index: Any
    distance: Any
    body: Any
    instance: Any
    triangle: Any
    cupy: Any

    def compact(self) -> BodyHits:
        """Copy the recorded hits to the host, without rays that hit no body."""
        ray = self.cupy.flatnonzero(self.body >= 0)
        columns = (self.distance, self.body, self.instance, self.triangle)
        return BodyHits(ray.get(), *(column[ray].get() for column in columns))


def to_device(cupy: Any, array: AnyArray) -> Any:
    """Copy an array to the current device and wait until the copy is complete.

    After that, any stream may read the copy, and the caller may release the array. The wait is
    necessary on devices that read ordinary host memory themselves, such as Grace Hopper, because
    `set` may return before they have finished.

    `cupy.asarray` would allocate page-locked memory of the same size as the array and keep it,
    which is acceptable for the rays of a chunk but not for a scene.
    """
    copy = cupy.empty(array.shape, array.dtype)
    if array.size:
        copy.set(array)
        cupy.cuda.get_current_stream().synchronize()
    return copy


class _Pinned:
    """Thread-safe counter of the page-locked memory used by this process, in bytes."""

    def __init__(self) -> None:
        # Reentrant, because a finalizer may run while its thread holds the lock.
        self._lock = threading.RLock()
        self._bytes = 0

    def reserve(self, size: int) -> bool:
        """Reserve bytes, or return False if they would exceed the limit."""
        with self._lock:
            fits = self._bytes + size <= PINNED_BYTES
            self._bytes += size * fits
            return fits

    def release(self, size: int) -> None:
        with self._lock:
            self._bytes -= size


_pinned = _Pinned()


def pinned_array(cupy: Any, count: int, dtype: DTypeLike) -> AnyArray:
    """Allocate an array in page-locked memory, to which the device can write directly.

    The memory returns to CuPy's pool when the last view of the array is released. If `PINNED_BYTES`
    are in use, the array is in ordinary memory instead. Copies to ordinary memory are slower, but
    page-locked memory is not available to other processes on the machine.
    """
    size = max(count * np.dtype(dtype).itemsize, 1)
    if not _pinned.reserve(size):
        return np.empty(count, dtype)
    try:
        memory = cupy.cuda.alloc_pinned_memory(size)
    except BaseException:
        _pinned.release(size)
        raise
    array = np.frombuffer(memory, dtype, count)
    weakref.finalize(array, _pinned.release, size)  # views of the array keep the array
    return array


class PendingCopy:
    """A small copy to the host that the current stream performs without blocking.

    Parameters
    ----------
    cupy
        The CuPy module.
    array
        CuPy array (n,) that the current stream computes.
    """

    def __init__(self, cupy: Any, array: Any) -> None:
        stream = cupy.cuda.get_current_stream()
        self._values = pinned_array(cupy, len(array), array.dtype)
        array.get(stream=stream, out=self._values, blocking=False)
        self._copied = stream.record()
        self._source = array  # must stay alive while the device reads it

    def values(self) -> AnyArray:
        """Wait until the copy is complete and return the values."""
        self._copied.synchronize()
        return self._values


class CopyQueue:
    """Queue of copies to the host in a separate stream, so that the device can keep computing.

    Parameters
    ----------
    cupy
        The CuPy module.
    """

    def __init__(self, cupy: Any) -> None:
        self._cupy = cupy
        self._stream = cupy.cuda.Stream(non_blocking=True)
        # The event after each copy, and the arrays that the device reads until then.
        self._pending: deque[tuple[Any, Sequence[Any]]] = deque()

    def send(self, pairs: Sequence[tuple[Any, AnyArray]]) -> None:
        """Start copying arrays that the current stream computes.

        `pairs` contains the source and target of each copy. The targets must come from
        `pinned_array`.
        """
        self._stream.wait_event(self._cupy.cuda.get_current_stream().record())
        for source, target in pairs:
            source.get(stream=self._stream, out=target, blocking=False)
        self._pending.append((self._stream.record(), pairs))
        self._wait(_MAX_PENDING)

    def wait(self) -> None:
        """Wait until all copies are complete."""
        self._wait(0)

    def _wait(self, max_pending: int) -> None:
        """Wait until at most `max_pending` copies are pending."""
        while len(self._pending) > max_pending:
            copied, _ = self._pending.popleft()
            copied.synchronize()


class HitTransfer:
    """Copies a scan's hits to the host in parts while the device casts further rays.

    Parameters
    ----------
    cupy
        The CuPy module.
    max_hits
        Maximum number of hits.
    nested
        Whether the scene has instances. Otherwise, all hits belong to instance 0.
    """

    def __init__(self, cupy: Any, max_hits: int, *, nested: bool) -> None:
        self._outbox = CopyQueue(cupy)
        dtypes = (np.uint32, np.float64, np.int32, *([np.int32] if nested else []))
        self._arrays = [pinned_array(cupy, max_hits, dtype) for dtype in dtypes]
        self._max_hits = max_hits
        self._count = 0

    def send(self, hits: DeviceHits) -> None:
        """Start copying the next hits in ray order."""
        rows = slice(self._count, self._count + len(hits))
        columns = (hits.ray, hits.distance, hits.triangle, hits.instance)
        pairs = zip(columns, self._arrays, strict=False)
        self._outbox.send([(column, array[rows]) for column, array in pairs])
        self._count += len(hits)

    def finish(self) -> HitColumns:
        """Wait until all copies are complete, and return the hits."""
        self._outbox.wait()
        ray, distance, triangle, *instances = (
            trim_to_count(array, self._count, self._max_hits) for array in self._arrays
        )
        instance = instances[0] if instances else np.zeros(self._count, np.int32)
        return ray, distance, triangle, instance


def trim_to_count(array: AnyArray, count: int, capacity: int) -> AnyArray:
    """Return the first `count` values of an array that `pinned_array` has allocated.

    If the values occupy less than half of the array's `capacity`, they are copied to ordinary
    memory, so that the page-locked memory can be released.
    """
    return array[:count].copy() if 2 * count < capacity else array[:count]
