"""Hits that stay on a CUDA device, and the copy of arrays from the device to the host."""

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

PINNED_BYTES = 1 << 30  # page-locked, of all outboxes of a process
_MAX_PENDING = 2  # copies: a copy runs while the arrays of the next are computed


@dataclass(frozen=True, eq=False)
class DeviceHits:
    """Kept hits of a part of a scan, as CuPy arrays on the current device and stream.

    Attributes
    ----------
    ray, distance, triangle, instance
        (k,): as in `ScanReturns`.
    cupy
        The module, for further arrays and kernels.
    make_rays
        Function of numbers of rays that returns origins and directions (`rays`).
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
        """Compute origins, meters, and unit directions of the rays: float64 (3, k) on the device.

        Both have the bits of `pattern_rays`.
        """
        return self.make_rays(self.ray)

    def get(self) -> HitColumns:
        """Copy the hits to the host."""
        return self.ray.get(), self.distance.get(), self.triangle.get(), self.instance.get()


@dataclass(frozen=True, eq=False)
class ExternalHits:
    """Hits of a scan's rays on surfaces outside the caster, such as moving bodies.

    Attributes
    ----------
    ray
        uint32 (k,): number of the ray, ascending, each at most once.
    distance
        float64 (k,): meters.
    triangle
        int32 (k,): any number of a triangle.
    """

    ray: UInts32
    distance: Floats
    triangle: Ints32


@dataclass(frozen=True, eq=False)
class DeviceNearestHits:
    """Rays on a CUDA device, and their nearest hits on moving bodies so far, as CuPy arrays.

    Attributes
    ----------
    rays
        float64 (6, n): origins, meters, and directions.
    time_index
        int32 (n,): number of each ray's time.
    distance, body, instance, triangle
        (n,): as in `NearestHits`.
    cupy
        The module.
    """

    rays: Any
    time_index: Any
    distance: Any
    body: Any
    instance: Any
    triangle: Any
    cupy: Any

    def compact(self) -> BodyHits:
        """Copy the hits to the host, without the rays that hit no body."""
        ray = self.cupy.flatnonzero(self.body >= 0)
        columns = (self.distance, self.body, self.instance, self.triangle)
        return BodyHits(ray.get(), *(column[ray].get() for column in columns))


def to_device(cupy: Any, array: AnyArray) -> Any:
    """Copy an array to the current device, and wait: any stream may read the copy then.

    A device that reads ordinary memory itself, as Grace Hopper does, may still read after `set`
    returns: hence the wait, after which the caller may release the array.

    `asarray` would copy through page-locked memory as large as the array and keep it: fine for
    the rays of a chunk, too much for a scene.
    """
    copy = cupy.empty(array.shape, array.dtype)
    if array.size:
        copy.set(array)
        cupy.cuda.get_current_stream().synchronize()
    return copy


class _Pinned:
    """Count of page-locked bytes in use by this process, for threads to share."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # a finalizer may run while its thread holds the lock
        self._bytes = 0

    def reserve(self, size: int) -> bool:
        """Count bytes and return True, unless there would be too many."""
        with self._lock:
            fits = self._bytes + size <= PINNED_BYTES
            self._bytes += size * fits
            return fits

    def release(self, size: int) -> None:
        """Count bytes that are no longer in use."""
        with self._lock:
            self._bytes -= size


_pinned = _Pinned()


def pinned_array(cupy: Any, count: int, kind: DTypeLike) -> AnyArray:
    """Return an array (count,) in page-locked memory, for the device to write to directly.

    The memory goes back to CuPy's pool when the last view of it has gone. While readers hold
    `PINNED_BYTES`, further arrays are in ordinary memory. Copies to ordinary memory take longer,
    but page-locked memory is lost to all other processes of the machine.
    """
    size = max(count * np.dtype(kind).itemsize, 1)
    if not _pinned.reserve(size):
        return np.empty(count, kind)
    try:
        memory = cupy.cuda.alloc_pinned_memory(size)
    except BaseException:
        _pinned.release(size)
        raise
    array = np.frombuffer(memory, kind, count)
    weakref.finalize(array, _pinned.release, size)  # views of the array keep the array
    return array


class PendingCopy:
    """A small copy to the host, in the current stream, for which the host waits later.

    Parameters
    ----------
    cupy
        The module.
    array
        CuPy array (n,), which the current stream computes.
    """

    def __init__(self, cupy: Any, array: Any) -> None:
        stream = cupy.cuda.get_current_stream()
        self._values = pinned_array(cupy, len(array), array.dtype)
        array.get(stream=stream, out=self._values, blocking=False)
        self._copied = stream.record()
        self._source = array  # the device still reads the array

    def values(self) -> AnyArray:
        """Wait for the copy, and return the values (n,)."""
        self._copied.synchronize()
        return self._values


class CopyQueue:
    """Queue of copies of arrays to the host, in a separate stream, while the device goes on.

    Parameters
    ----------
    cupy
        The module.
    """

    def __init__(self, cupy: Any) -> None:
        self._cupy = cupy
        self._stream = cupy.cuda.Stream(non_blocking=True)
        # Events after copies, and arrays that the device still reads.
        self._pending: deque[tuple[Any, Sequence[Any]]] = deque()

    def send(self, pairs: Sequence[tuple[Any, AnyArray]]) -> None:
        """Start to copy arrays that the current stream computes: pairs of source and target.

        Targets are arrays from `pinned_array`.
        """
        self._stream.wait_event(self._cupy.cuda.get_current_stream().record())
        for source, target in pairs:
            source.get(stream=self._stream, out=target, blocking=False)
        self._pending.append((self._stream.record(), pairs))
        self._wait(_MAX_PENDING)

    def wait(self) -> None:
        """Wait until all copies have ended."""
        self._wait(0)

    def _wait(self, max_pending: int) -> None:
        """Wait until at most `max_pending` copies remain."""
        while len(self._pending) > max_pending:
            copied, _ = self._pending.popleft()
            copied.synchronize()


class HitTransfer:
    """Sends the hits of a scan to the host, part by part, while the device casts further rays.

    Parameters
    ----------
    cupy
        The module.
    max_hits
        Number of hits for which there is room.
    nested
        Whether the scene has instances; without instances, all hits are on instance 0.
    """

    def __init__(self, cupy: Any, max_hits: int, *, nested: bool) -> None:
        self._outbox = CopyQueue(cupy)
        kinds = (np.uint32, np.float64, np.int32, *([np.int32] if nested else []))
        self._arrays = [pinned_array(cupy, max_hits, kind) for kind in kinds]
        self._max_hits = max_hits
        self._count = 0

    def send(self, hits: DeviceHits) -> None:
        """Start to copy the next hits, in ray order."""
        rows = slice(self._count, self._count + len(hits))
        columns = (hits.ray, hits.distance, hits.triangle, hits.instance)
        pairs = zip(columns, self._arrays, strict=False)
        self._outbox.send([(column, array[rows]) for column, array in pairs])
        self._count += len(hits)

    def finish(self) -> HitColumns:
        """Wait for all copies, and return the hits."""
        self._outbox.wait()
        ray, distance, triangle, *instances = (
            trim_to_count(array, self._count, self._max_hits) for array in self._arrays
        )
        instance = instances[0] if instances else np.zeros(self._count, np.int32)
        return ray, distance, triangle, instance


def trim_to_count(array: AnyArray, count: int, capacity: int) -> AnyArray:
    """Return the first `count` values of an array from `pinned_array`, which has `capacity` values.

    If less than half of the capacity is in use, the values are a copy: the page-locked memory is given
    back.
    """
    return array[:count].copy() if 2 * count < capacity else array[:count]
