"""The interface of a ray casting engine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .arrays import Floats, Integers, Ints, Ints32
from .crossing import Crossing, Nearest, Swept, strike
from .device import DeviceHits, OtherHits
from .hits import Counted, Hits, Part, ScanReturns, joined
from .instances import Scene
from .rays import Rays
from .scan import Collector, Scan


class BackendUnavailable(RuntimeError):  # noqa: N818 - a state, not a mishap
    """The requested backend cannot be used on this machine; the message says why."""


@dataclass(frozen=True)
class Found:
    """Closest hits of a chunk of rays, misses left out, in ray order.

    Attributes
    ----------
    ray
        (k,): number of the ray within the chunk.
    t
        float64 (k,): distance in local units.
    triangle
        int32 (k,): row of its mesh's `faces`.
    u, v
        float64 (k,): weights of the second and third corner.
    instance
        int32 (k,): number of the instance.
    """

    ray: Integers
    t: Floats
    triangle: Ints32
    u: Floats
    v: Floats
    instance: Ints32


class Backend(ABC):
    """One engine, bound to the meshes of a scene.

    A backend is made with the scene, the most CPU threads to use (None for its own choice) and
    the number of the CUDA device (None for the current one); it ignores those it does not need.
    It builds the trees of the meshes once, and calls `place` for what depends on where they are.
    It must implement `closest`; it may override `scan` to be faster.
    """

    name: ClassVar[str]
    # Most rays of a call of `closest`: limits the memory. A ray's result does not depend on its
    # chunk.
    chunk: ClassVar[int]

    on_device: ClassVar[bool] = False  # whether hits can stay on a CUDA device, see `visit`

    @classmethod
    @abstractmethod
    def missing(cls) -> str:
        """Why this backend cannot be used here and what to install; "" when it can."""

    @classmethod
    def build(cls) -> str:
        """Versions, and the like, that its bits depend on, beside NumPy's; "" for none."""
        return ""

    def __init__(self, scene: Scene, threads: int | None, device: int | None) -> None:
        self._scene = scene

    def place(self, scene: Scene) -> None:
        """Take another scene of the same instances, some of which have moved."""
        self._scene = scene

    @abstractmethod
    def closest(self, rays: Rays) -> Found:
        """Closest hits of at most `chunk` rays."""

    def nearest(self, rays: Rays) -> Part:
        """Closest hits of rays, without weights, misses left out, in ray order."""
        parts: list[Part] = []
        for start in range(0, len(rays), self.chunk):
            found = self.closest(rays.part(start, start + self.chunk))
            ray = found.ray.astype(np.uint32) + np.uint32(start)
            distance = found.t / self._scene.frame.scale
            parts.append((ray, distance, found.triangle, found.instance))
        return joined(parts)

    def strike(self, crossing: Crossing, nearest: Nearest) -> None:
        """Note where rays hit bodies of this shape, if that is nearer."""
        strike(self.nearest, crossing, nearest)

    def sweep(self, sweep: Swept, nearest: Nearest) -> None:
        """Note where rays hit bodies of this shape, if that is nearer, on the device."""
        raise BackendUnavailable(f"Backend {self.name!r} has no device: use strike.")

    def cast(self, rays: Rays) -> Hits:
        """Closest hit of every ray."""
        n = len(rays)
        hits = Hits(
            np.full(n, np.inf), np.full(n, -1, np.int32), np.zeros(n), np.zeros(n),
            np.full(n, -1, np.int32),
        )  # fmt: skip
        for start in range(0, n, self.chunk):
            found = self.closest(rays.part(start, start + self.chunk))
            row = start + found.ray.astype(np.int64)
            hits.distance[row] = found.t / self._scene.frame.scale
            hits.triangle[row] = found.triangle
            hits.u[row] = found.u
            hits.v[row] = found.v
            hits.instance[row] = found.instance
        return hits

    def scan(self, scan: Scan) -> ScanReturns:
        """Closest hits of a scan's rays: the kept ones, and counts of all."""
        collector = Collector(scan, self._scene.face_count)
        for start, stop, (ray, distance, triangle, instance) in self.parts(scan):
            if scan.tally:
                collector.tally(self._scene.tally_rows(instance, triangle))
            kept = collector.keep(ray, start, stop)
            collector.add(start, ray[kept], distance[kept], triangle[kept], instance[kept])
        return collector.result()

    def parts(self, scan: Scan) -> Iterator[tuple[int, int, Part]]:
        """Rays of a scan, from one to another in ray order, and their hits, numbered from these."""
        for start, stop in scan.chunks(self.chunk):
            found = self.closest(scan.rays(start, stop))
            distance = found.t / self._scene.frame.scale
            ray = found.ray.astype(np.uint32, copy=False)
            yield start, stop, (ray, distance, found.triangle, found.instance)

    def visit(
        self,
        scan: Scan,
        use: Callable[[DeviceHits], object],
        counters: tuple[Ints, int] | None = None,
        others: OtherHits | None = None,
    ) -> tuple[Ints, Counted | None]:
        """See `RayCaster.visit`."""
        raise BackendUnavailable(
            f"Hits of backend {self.name!r} are on no device: use scan, or backend='cuda'."
        )
