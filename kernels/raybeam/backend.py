"""What a ray casting engine must offer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .collector import Collector
from .hits import RAY_BYTES, Gathering, Hits, Returns, ScanReturns
from .memory import require
from .mesh import LocalMesh
from .rays import Rays
from .scan import Scan


class BackendUnavailable(RuntimeError):  # noqa: N818 - a state, not a mishap
    """The backend asked for cannot be used on this machine; the message says why."""


@dataclass(frozen=True)
class Found:
    """Closest hits of a chunk of rays, misses left out, in ray order.

    Attributes
    ----------
    ray
        intp (k,): number of the ray within the chunk.
    t
        float64 (k,): distance in local units.
    triangle
        int32 (k,): row of `faces`.
    u, v
        float64 (k,): weights of the second and third corner; empty when not asked for.
    """

    ray: NDArray[np.intp]
    t: NDArray[np.float64]
    triangle: NDArray[np.int32]
    u: NDArray[np.float64]
    v: NDArray[np.float64]


class Backend(ABC):
    """One engine, bound to one mesh.

    A backend is made with the mesh, the most CPU threads to use (None for its own choice) and
    the number of the CUDA device (None for the current one); each ignores what it has no use
    for. It must offer `closest` and `along`; the rest may be overridden where the engine can do
    better.
    """

    name: ClassVar[str]
    # Rays given to `closest` at a time: bounds the memory in use. A ray's result does not
    # depend on the chunk that it is in.
    chunk: ClassVar[int]

    @classmethod
    @abstractmethod
    def missing(cls) -> str:
        """Why this backend cannot be used here and what to install; "" when it can."""

    def __init__(self, mesh: LocalMesh, threads: int | None, device: int | None) -> None:
        self._mesh = mesh

    @abstractmethod
    def closest(self, rays: Rays, weights: bool) -> Found:
        """Closest hits of at most `chunk` rays; `weights` tells whether u and v are wanted."""

    @abstractmethod
    def along(self, rays: Rays) -> NDArray[np.int32]:
        """Triangles that at most `chunk` rays meet, as often as they are met, in any order."""

    def cast(self, rays: Rays) -> Hits:
        """Closest hit of every ray."""
        n = len(rays)
        require(RAY_BYTES * n, f"The answer for {n:,} rays", "cast fewer at a time")
        hits = Hits(np.full(n, np.inf), np.full(n, -1, np.int32), np.zeros(n), np.zeros(n))
        for start in range(0, n, self.chunk):
            found = self.closest(rays.part(start, start + self.chunk), weights=True)
            row = start + found.ray
            hits.distance[row] = found.t / self._mesh.scale
            hits.triangle[row] = found.triangle
            hits.u[row] = found.u
            hits.v[row] = found.v
        return hits

    def returns(self, rays: Rays) -> Returns:
        """Closest hits of the rays that have one."""
        gathering = Gathering()
        for start in range(0, len(rays), self.chunk):
            found = self.closest(rays.part(start, start + self.chunk), weights=False)
            ray = found.ray.astype(np.uint32) + np.uint32(start)
            gathering.add(Returns(ray, found.t / self._mesh.scale, found.triangle))
        return gathering.returns()

    def scan(self, scan: Scan) -> ScanReturns:
        """Closest hits of a scan's rays: those that it keeps, and counts of all."""
        collector = Collector(scan, self._mesh.face_count)
        for start, stop in scan.chunks(self.chunk):
            found = self.closest(scan.rays(start, stop), weights=False)
            collector.tally(found.triangle)
            kept = collector.keep(found.ray, start, stop)
            ray = found.ray[kept].astype(np.uint32) + np.uint32(start)
            collector.add(Returns(ray, found.t[kept] / self._mesh.scale, found.triangle[kept]))
        return collector.result()

    def count(self, rays: Rays, every: bool) -> NDArray[np.int64]:
        """How many rays hit each triangle first or, if `every`, meet it at all: (face_count,)."""
        counts = np.zeros(self._mesh.face_count, np.int64)
        for start in range(0, len(rays), self.chunk):
            part = rays.part(start, start + self.chunk)
            np.add.at(counts, self.along(part) if every else self.closest(part, False).triangle, 1)
        return counts
