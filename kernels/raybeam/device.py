"""Hits that stay on a CUDA device, and the way of arrays from there to the host."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from .arrays import AnyArray, Floats, Ints32, UInts32
from .hits import Part

_UNDER_WAY = 2  # copies: one runs while the arrays of the next are made


@dataclass(frozen=True, eq=False)
class DeviceHits:
    """Kept hits of some rays of a scan, as CuPy arrays on the current device and stream.

    Attributes
    ----------
    ray, distance, triangle, instance
        (k,): as in `ScanReturns`.
    cupy
        The module, for arrays and kernels of your own.
    make_rays
        Function of numbers of rays that returns their origins and directions, see `rays`.
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
        """Origins, metres, and unit directions of the rays: float64 (3, k) on the device.

        They have the bits of `pattern_rays`.
        """
        return self.make_rays(self.ray)

    def get(self) -> Part:
        """Copy the hits to the host."""
        return self.ray.get(), self.distance.get(), self.triangle.get(), self.instance.get()


@dataclass(frozen=True, eq=False)
class OtherHits:
    """Hits of a scan's rays on surfaces that the caster does not know, such as those that move.

    Attributes
    ----------
    ray
        uint32 (k,): number of the ray, ascending, each at most once.
    distance
        float64 (k,): metres.
    triangle
        int32 (k,): any number.
    """

    ray: UInts32
    distance: Floats
    triangle: Ints32


def to_device(cupy: Any, array: AnyArray) -> Any:
    """Copy an array to the current device, and wait for that: any stream may read it then.

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


class Outbox:
    """Copies arrays to the host in a stream of its own, while the device goes on.

    Parameters
    ----------
    cupy
        The module.
    """

    def __init__(self, cupy: Any) -> None:
        self._cupy = cupy
        self._stream = cupy.cuda.Stream(non_blocking=True)
        # Events after copies, and arrays that the device still reads.
        self._under_way: deque[tuple[Any, Sequence[Any]]] = deque()

    def room(self, count: int, kind: DTypeLike) -> AnyArray:
        """Make an array (count,) in page-locked memory, to which the device writes by itself.

        It goes back to CuPy's pool when the last view of it has gone.
        """
        size = count * np.dtype(kind).itemsize
        memory = self._cupy.cuda.alloc_pinned_memory(max(size, 1))
        return np.frombuffer(memory, kind, count)

    def send(self, pairs: Sequence[tuple[Any, AnyArray]]) -> None:
        """Begin to copy arrays that the current stream makes: pairs of one here, one in `room`."""
        self._stream.wait_event(self._cupy.cuda.get_current_stream().record())
        for given, out in pairs:
            given.get(stream=self._stream, out=out, blocking=False)
        self._under_way.append((self._stream.record(), pairs))
        self._wait(_UNDER_WAY)

    def wait(self) -> None:
        """Wait until all copies are done."""
        self._wait(0)

    def _wait(self, most: int) -> None:
        while len(self._under_way) > most:
            done, _ = self._under_way.popleft()
            done.synchronize()
