"""The interface of a ray casting engine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .arrays import Floats, Integers, Ints, Ints32
from .body_rays import NearestHits, RayBodyPairs, TimedBodies, cast_pairs
from .device import DeviceHits, DeviceNearestHits, ExternalHits
from .hits import HitColumns, Hits, ScanReturns, TallyCounts, join_hits
from .instances import LocalScene
from .rays import Rays
from .scan import HitCollector, Scan


class BackendUnavailable(RuntimeError):  # noqa: N818 - a state, not a mishap
    """Raised when the requested backend cannot be used; the message states the reason."""


@dataclass(frozen=True)
class ClosestHits:
    """Closest hits of a chunk of rays, without misses, in ray order.

    Attributes
    ----------
    ray
        (k,): number of the ray within the chunk.
    t
        float64 (k,): distance in local units.
    triangle
        int32 (k,): row of the `faces` of the mesh.
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
    """A ray casting engine, bound to the meshes of a scene.

    A backend is created with the scene, the maximum number of CPU threads (None for the default of
    the backend) and the number of the CUDA device (None for the current device); a backend without
    threads or device ignores the number. The constructor builds the trees of the meshes, and calls
    `update_scene` for all that depends on transforms. A backend must implement `closest_hits`; it may
    override `scan` to be faster.
    """

    name: ClassVar[str]
    # Maximum rays of a call of `closest_hits`: limits the memory. The result of a ray does not depend
    # on its chunk.
    chunk: ClassVar[int]

    on_device: ClassVar[bool] = False  # whether hits can stay on a CUDA device (`scan_on_device`)

    @classmethod
    @abstractmethod
    def unavailable_reason(cls) -> str:
        """Return why this backend cannot be used and the remedy, or "" if it can be used."""

    @classmethod
    def versions(cls) -> str:
        """Return the versions besides NumPy's that the bits of results depend on, "" for none."""
        return ""

    @classmethod  # noqa: B027 - other backends have nothing to limit
    def limit_memory(cls, device: int | None, share: float) -> None:
        """Have this process take at most a share of a device's memory.

        Without a device, nothing is limited.

        A share of 1 or more sets no limit.
        """

    def __init__(self, scene: LocalScene, threads: int | None, device: int | None) -> None:
        self._scene = scene

    def update_scene(self, scene: LocalScene) -> None:
        """Replace the scene by a scene of the same instances with new transforms."""
        self._scene = scene

    @property
    def device_lost(self) -> bool:
        """Whether the device answers no call of this process any more, after an error of it."""
        return False

    @abstractmethod
    def closest_hits(self, rays: Rays) -> ClosestHits:
        """Return the closest hits of at most `chunk` rays."""

    def hit_columns(self, rays: Rays) -> HitColumns:
        """Return the closest hits of rays, without weights and misses, in ray order."""
        parts: list[HitColumns] = []
        for start in range(0, len(rays), self.chunk):
            hits = self.closest_hits(rays.normalized(start, start + self.chunk))
            ray = hits.ray.astype(np.uint32) + np.uint32(start)
            distance = hits.t / self._scene.frame.scale
            parts.append((ray, distance, hits.triangle, hits.instance))
        return join_hits(parts)

    def cast_pairs(self, pairs: RayBodyPairs, nearest: NearestHits) -> None:
        """Cast rays on bodies of this shape, and write nearer hits to `nearest`."""
        cast_pairs(self.hit_columns, pairs, nearest)

    def upload_rays(
        self, scan: Scan, start: int, stop: int, time_index: Ints32, end: float
    ) -> DeviceNearestHits:
        """Put rays `start` to `stop` of a scan on the device, as `RayCaster.upload_rays`."""
        raise BackendUnavailable(
            f"Backend {self.name!r} does not support devices. Use cast_crossing."
        )

    def cast_bodies(self, bodies: TimedBodies, nearest: DeviceNearestHits) -> None:
        """Cast rays on bodies of this shape on the device, and write nearer hits to `nearest`."""
        raise BackendUnavailable(
            f"Backend {self.name!r} does not support devices. Use cast_crossing."
        )

    def cast(self, rays: Rays) -> Hits:
        """Return the closest hit of every ray, misses included."""
        n = len(rays)
        hits = Hits(
            np.full(n, np.inf),
            np.full(n, -1, np.int32),
            np.zeros(n),
            np.zeros(n),
            np.full(n, -1, np.int32),
        )
        for start in range(0, n, self.chunk):
            chunk_hits = self.closest_hits(rays.normalized(start, start + self.chunk))
            row = start + chunk_hits.ray.astype(np.int64)
            hits.distance[row] = chunk_hits.t / self._scene.frame.scale
            hits.triangle[row] = chunk_hits.triangle
            hits.u[row] = chunk_hits.u
            hits.v[row] = chunk_hits.v
            hits.instance[row] = chunk_hits.instance
        return hits

    def scan(self, scan: Scan) -> ScanReturns:
        """Return the kept hits of the rays of a scan, and counts of all hits."""
        collector = HitCollector(scan, self._scene.face_count if scan.tally else 0)
        for start, stop, (ray, distance, triangle, instance) in self.scan_parts(scan):
            if scan.tally:
                collector.count_triangles(self._scene.tally_rows(instance, triangle))
            selected = collector.select_kept(ray, start, stop)
            collector.add_hits(
                start, ray[selected], distance[selected], triangle[selected], instance[selected]
            )
        return collector.result()

    def scan_parts(self, scan: Scan) -> Iterator[tuple[int, int, HitColumns]]:
        """Yield start and stop of each part of a scan, and its hits, numbered from start."""
        for start, stop in scan.chunks(self.chunk):
            hits = self.closest_hits(scan.rays(start, stop))
            distance = hits.t / self._scene.frame.scale
            ray = hits.ray.astype(np.uint32, copy=False)
            yield start, stop, (ray, distance, hits.triangle, hits.instance)

    def scan_on_device(
        self,
        scan: Scan,
        use: Callable[[DeviceHits], object],
        counters: tuple[Ints, int] | None = None,
        external_hits: ExternalHits | None = None,
    ) -> tuple[Ints, TallyCounts | None]:
        """Cast a scan, and pass its hits to `use` on the device, as `RayCaster.scan_on_device` does.

        BackendUnavailable if this backend has no device.
        """
        raise BackendUnavailable(
            f"The hits of backend {self.name!r} are not on a device. Use scan, or backend='cuda'."
        )
