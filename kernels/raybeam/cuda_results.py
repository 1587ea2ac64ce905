"""Hits on their way from the device to the caller's arrays."""

from __future__ import annotations

import ctypes
import threading
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cuda_module import Kernels
from .hits import Part, joined

_PINNED = 1 << 30  # bytes that are page-locked, at most
_LEAST = 1 << 16
_DTYPES = (np.uint32, np.float64, np.int32)  # ray, distance, triangle


class PinnedRoom:
    """Arrays in page-locked memory, to which the device copies at the full rate of its bus.

    Fresh ordinary memory is several times slower: the driver stages it through memory of its
    own, and the system has to hand out each page. Page-locked memory is scarce, so callers who
    keep more than `limit` bytes get ordinary arrays from then on. What they let go is used again.

    Blocks are powers of two in size, so that one fits many calls. CuPy's own pool keeps every
    size that was ever asked for, without a limit.
    """

    def __init__(self, cupy: Any, limit: int = _PINNED) -> None:
        self._allocate = cupy.cuda.PinnedMemory
        self._refused = cupy.cuda.runtime.CUDARuntimeError
        self._limit = limit
        self._held = 0  # bytes, free ones included
        self._free: dict[int, list[Any]] = {}  # {bytes: blocks of that size}
        self._lock = threading.RLock()  # a loan may end while this thread holds it

    def __repr__(self) -> str:
        return f"PinnedRoom({self._held} of {self._limit} bytes held)"

    def empty(self, n: int, dtype: type) -> NDArray[Any]:
        """Return an array of n numbers, page-locked while there is room."""
        need = n * np.dtype(dtype).itemsize
        size = max(_LEAST, 1 << (need - 1).bit_length()) if need else 0
        block = self._take(size)
        if block is None:
            return np.empty(n, dtype)
        # Views of the array keep this alive; when the last is gone, so is the loan.
        loan = (ctypes.c_char * size).from_address(block.ptr)
        weakref.finalize(loan, self._give_back, size, block)
        return np.ndarray((n,), dtype, memoryview(loan))

    def _take(self, size: int) -> Any:
        """Return a block, or None when there is no room for it."""
        with self._lock:
            if self._free.get(size):
                return self._free[size].pop()
            if self._held + size > self._limit:
                # Free blocks of other sizes are in the way.
                self._held -= sum(each * len(blocks) for each, blocks in self._free.items())
                self._free.clear()
            if not size or self._held + size > self._limit:
                return None
            self._held += size
        try:
            return self._allocate(size)
        except self._refused:  # the system locks no more pages: ordinary ones will do
            with self._lock:
                self._held -= size
            return None

    def _give_back(self, size: int, block: Any) -> None:
        with self._lock:
            self._free.setdefault(size, []).append(block)


class Packer:
    """Hits of one call, closed up on the device and fetched together.

    Parameters
    ----------
    cupy
        CuPy, or what stands in for it.
    kernels
        Those of intersect.cu.
    faces
        The caller's number of each triangle, on the device.
    room
        Where the arrays for the caller come from.
    limit
        Bytes of hits kept on the device before they are fetched.
    """

    def __init__(
        self, cupy: Any, kernels: Kernels, faces: Any, room: PinnedRoom, limit: int
    ) -> None:
        self._cupy, self._kernels, self._faces, self._room = cupy, kernels, faces, room
        self._limit = limit
        self._waiting: list[tuple[Any, ...]] = []  # on the device: ray, distance, triangle
        self._bytes = 0
        self._fetched: list[Part] = []

    def add(self, distance: Any, place: Any, first: int, scale: float) -> tuple[Any, ...]:
        """Take the results of a cast, one entry a ray; distances are divided by `scale`.

        Returns what is kept of them, on the device: rays numbered from `first`, distances, and
        the caller's triangles, one entry a hit.
        """
        cp, n = self._cupy, len(place)
        # Closed up by sums in ray order, not by atomics: the same bytes on every run.
        ends = cp.cumsum(place >= 0, dtype=np.int32) if n else place
        hits = tuple(cp.empty(int(ends[-1]) if n else 0, dtype) for dtype in _DTYPES)
        given = (self._faces, distance, place, ends, np.int64(n), np.int64(first))
        self._kernels.run("pack", n, *given, np.float64(scale), *hits)
        self._waiting.append(hits)
        self._bytes += sum(part.nbytes for part in hits)
        if self._bytes > self._limit:
            self._fetch()
        return hits

    def returns(self) -> Part:
        """Everything taken, on the host."""
        self._fetch()
        return joined(self._fetched)

    def _fetch(self) -> None:
        total = sum(len(ray) for ray, _, _ in self._waiting)
        ray, distance, triangle = arrays = [self._room.empty(total, dtype) for dtype in _DTYPES]
        start = 0
        for parts in self._waiting:
            stop = start + len(parts[0])
            if stop > start:
                for part, array in zip(parts, arrays, strict=True):
                    # Waits for the copy: page-locked memory may be lent again, and the device's
                    # used by another stream, once this returns.
                    part.get(out=array[start:stop])
            start = stop
        self._fetched.append((ray, distance, triangle))
        self._waiting, self._bytes = [], 0
