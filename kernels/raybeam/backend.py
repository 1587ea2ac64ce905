"""The interface that a ray-casting backend implements."""

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


class BackendUnavailable(RuntimeError):  # noqa: N818 - describes a state, not an error
    """Raised if the requested backend cannot be used. The message states the reason."""


@dataclass(frozen=True)
class ClosestHits:
    """Closest hits of the rays in a chunk, in ray order.

    Rays that miss have no row.

    Attributes
    ----------
    ray
        (k,): index of the ray within the chunk.
    t
        float64 (k,): distance in local units.
    triangle
        int32 (k,): index of the triangle in the `faces` of its mesh.
    u, v
        float64 (k,): barycentric weights of the second and third vertex.
    instance
        int32 (k,): index of the instance.
    """

    ray: Integers
    t: Floats
    triangle: Ints32
    u: Floats
    v: Floats
    instance: Ints32


class Backend(ABC):
    """A ray-casting engine for one scene.

    The constructor takes the scene, the maximum number of CPU threads (None for the default of the
    backend) and the index of the CUDA device (None for the current device). A backend that uses no
    threads or no device ignores these arguments. The constructor builds the acceleration structures
    of the meshes and calls `update_scene`, which does everything that depends on transforms.

    A backend must implement `closest_hits` and `unavailable_reason`. It may override `scan` and
    other methods with faster versions.
    """

    name: ClassVar[str]
    # Maximum number of rays per call to `closest_hits`, which bounds memory use. How rays are
    # divided into chunks does not affect the results.
    chunk: ClassVar[int]

    on_device: ClassVar[bool] = False  # whether `scan_on_device` is supported

    @classmethod
    @abstractmethod
    def unavailable_reason(cls) -> str:
        """Return why this backend is unavailable and how to fix this, or "" if it is available."""

    @classmethod
    def versions(cls) -> str:
        """Return the versions of software, except NumPy, that affect the results, or ""."""
        return ""

    @classmethod  # noqa: B027 - most backends have nothing to limit
    def limit_memory(cls, device: int | None, share: float) -> None:
        """Limit the device memory of this process to a fraction of the total.

        If `share` is 1 or more, there is no limit. Backends without a device ignore this call.
        """

    def __init__(self, scene: LocalScene, threads: int | None, device: int | None) -> None:
        self._scene = scene

    def update_scene(self, scene: LocalScene) -> None:
        """Replace the scene by one with the same instances but new transforms."""
        self._scene = scene

    @property
    def device_lost(self) -> bool:
        """Whether the device has stopped responding to this process after an error."""
        return False

    @abstractmethod
    def closest_hits(self, rays: Rays) -> ClosestHits:
        """Return the closest hits of at most `chunk` rays."""

    def hit_columns(self, rays: Rays) -> HitColumns:
        """Return the closest hits of any number of rays, in ray order.

        The result omits rays that miss, and barycentric weights.
        """
        parts: list[HitColumns] = []
        for start in range(0, len(rays), self.chunk):
            hits = self.closest_hits(rays.normalize_range(start, start + self.chunk))
            ray = hits.ray.astype(np.uint32) + np.uint32(start)
            distance = hits.t / self._scene.frame.scale
            parts.append((ray, distance, hits.triangle, hits.instance))
        return join_hits(parts)

    def cast_pairs(self, pairs: RayBodyPairs, nearest: NearestHits) -> None:
        """Cast rays at bodies with this shape, and record closer hits in `nearest`."""
        cast_pairs(self.hit_columns, pairs, nearest)

    def upload_rays(
        self, scan: Scan, start: int, stop: int, time_index: Ints32, end: float
    ) -> DeviceNearestHits:
        """Copy rays `start` to `stop` of a scan to the device. See `RayCaster.upload_rays`."""
        raise BackendUnavailable(f"Backend {self.name!r} does not support devices. Use cast_pairs.")

    def cast_bodies(self, bodies: TimedBodies, nearest: DeviceNearestHits) -> None:
        """Cast rays at bodies on the device, and record closer hits in `nearest`.

        This scene is the shape of the bodies.
        """
        raise BackendUnavailable(f"Backend {self.name!r} does not support devices. Use cast_pairs.")

    def cast(self, rays: Rays) -> Hits:
        """Return the closest hit of each ray, including rays that miss."""
        n = len(rays)
        hits = Hits(
            np.full(n, np.inf),
            np.full(n, -1, np.int32),
            np.zeros(n),
            np.zeros(n),
            np.full(n, -1, np.int32),
        )
        for start in range(0, n, self.chunk):
            chunk_hits = self.closest_hits(rays.normalize_range(start, start + self.chunk))
            row = start + chunk_hits.ray.astype(np.int64)
            hits.distance[row] = chunk_hits.t / self._scene.frame.scale
            hits.triangle[row] = chunk_hits.triangle
            hits.u[row] = chunk_hits.u
            hits.v[row] = chunk_hits.v
            hits.instance[row] = chunk_hits.instance
        return hits

    def scan(self, scan: Scan) -> ScanReturns:
        """Return the hits to store for a scan, and the counts of all hits."""
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
        """Yield (start, stop, hits) for consecutive ranges of rays in a scan.

        The ray indices of the hits start at 0 in each part.
        """
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
        """Cast a scan and pass its hits to `use` on the device. See `RayCaster.scan_on_device`.

        Raises BackendUnavailable if this backend does not use a device.
        """
        raise BackendUnavailable(
            f"The hits of backend {self.name!r} are not on a device. Use scan, or backend='cuda'."
        )
