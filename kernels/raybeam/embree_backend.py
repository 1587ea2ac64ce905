"""Ray casting with Embree, as embreex ships it."""

from __future__ import annotations

import ctypes
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import files, version
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .backend import Backend, Found
from .hits import ScanReturns
from .mesh import LocalMesh
from .rays import Rays
from .refine import Refiner
from .scan import Collector, Scan
from .workspace import Starts, Workspace

Float = NDArray[np.float64]

# Embree decides in float32, and may find a hit again that refinement put just before the start. So
# the start moves on, in local units: a little for most surfaces, and as far as necessary for
# surfaces that a ray grazes, where float32 is less accurate.
_STARTS = (0.0, *(4.0**k * 2**-20 for k in range(6)))

# A ray that starts farther from zero than this, in local units, is started at the scene's box:
# float32 then rounds by the scene's size, not by the distance to it.
_NEAR = 2.0

# Local units. A float32 distance that is farther than this from the limits decides whether the hit
# counts, so that only kept hits have to be refined. Its error is larger only if the cosine between
# ray and normal is below some 1e-4; then a refined distance beyond a limit is ignored.
_CLEAR = 2.0**-8

_SHARE = 1 << 13  # rays that a thread takes at a time, where there are several

# RTC_DEVICE_PROPERTY_NATIVE_RAY…_SUPPORTED, and the rays.
_WIDTHS = ((34, 16), (33, 8), (32, 4))


@dataclass(frozen=True)
class _Limits:
    """Limits of distances, in local units.

    Attributes
    ----------
    t_min, t_max
        Hits between these count.
    near
        A rough distance behind this is not before `t_min`.
    far
        A rough distance before this is not behind `t_max`.
    last
        A rough distance behind this is behind `t_max`.
    """

    t_min: float
    t_max: float
    near: float
    far: float
    last: float


@dataclass(frozen=True)
class _Hits:
    """Closest hits of a chunk of n rays.

    Attributes
    ----------
    counts
        bool (n,): rays whose hits count.
    t
        (n,): local distance of each ray's hit; where it does not count, anything.
    place
        int32 (n,): row of the mesh's corners; likewise.
    """

    counts: NDArray[np.bool_]
    t: NDArray[np.floating[Any]]
    place: NDArray[np.int32]


class EmbreeBackend(Backend):
    """Embree's closest hits; their distances are recomputed in float64.

    Embree decides in float32 which triangle is hit. It does not distinguish surfaces that are
    nearer to each other, or to the ray's start, than about 1e-6 of the scene's size. Casting
    uses the given number of threads; the tree is built by all cores.
    """

    name: ClassVar[str] = "embree"
    # Smaller chunks would fit a core's level 2 cache, but more calls cost more than that gains.
    chunk: ClassVar[int] = 1 << 16

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        try:
            import embreex.rtcore_scene  # noqa: F401
        except ImportError as error:
            return f"embreex does not load ({error}): pip install embreex"
        return ""

    @classmethod
    def build(cls) -> str:
        """See `Backend.build`: embreex, its copy of Embree, and the width of Embree's vectors."""
        [library] = [file for file in files("embreex") or () if "libembree4" in file.name]
        embree = ctypes.CDLL(str(library.locate()))
        embree.rtcNewDevice.restype = ctypes.c_void_p
        embree.rtcGetDeviceProperty.restype = ctypes.c_ssize_t
        device = ctypes.c_void_p(embree.rtcNewDevice(None))
        # By the processor: native packets of 16 rays need AVX-512, of 8 rays AVX.
        width = next((n for p, n in _WIDTHS if embree.rtcGetDeviceProperty(device, p)), 1)
        embree.rtcReleaseDevice(device)
        digest = library.hash.value[:8] if library.hash else ""
        return f"{version('embreex')} ({digest}, vectors of {width})"

    def __init__(
        self, mesh: LocalMesh, threads: int | None = None, device: int | None = None
    ) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        super().__init__(mesh, threads, device)
        self._threads = ThreadPoolExecutor(threads or os.cpu_count(), "embree")
        self._one = threads == 1
        self._scene = EmbreeScene()  # robust: rays between two triangles hit one of them
        TriangleMesh(self._scene, mesh.points, mesh.rows)
        self._trace(np.empty((0, 6), np.float32))  # builds the tree, which threads may not
        self._refine = Refiner(mesh)

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        desk, limits = _desk(len(rays)), self._limits(rays.t_min, rays.t_max)
        unit, starts = rays.directions.T.copy(), Starts(self._mesh.to_local(rays.origins))
        desk.aim(unit)
        hits = self._within(desk, unit, starts, limits)
        ray = np.flatnonzero(hits.counts)
        t, place = self._distance(hits, ray, unit, starts, limits)
        u, v = self._refine.weights(starts.of(ray), rays.directions[ray], place)
        return Found(ray, t, self._mesh.index[place], u, v)

    def scan(self, scan: Scan) -> ScanReturns:
        """See `Backend.scan`; rays are made where Embree reads them, a chunk at a time."""
        collector = Collector(scan, self._mesh.face_count)
        limits = self._limits(scan.t_min, scan.t_max)
        for start, stop in scan.chunks(self.chunk):
            desk = _desk(stop - start)
            order, unit, starts = desk.make(scan, start, stop, self._mesh)
            hits = self._within(desk, unit, starts, limits)
            ray = np.flatnonzero(order.by_ray(hits.counts))
            slot = order.of(ray)
            if scan.tally:
                collector.tally(self._mesh.index.take(hits.place.take(slot)))
            keep = collector.keep(ray, start, stop)
            kept, slot = ray[keep], slot[keep]
            t, place = self._distance(hits, slot, unit, starts, limits)
            t /= self._mesh.scale
            collector.add(start, kept, t, self._mesh.index.take(place))
        return collector.result()

    def _limits(self, t_min: float, t_max: float) -> _Limits:
        t_min, t_max = t_min * self._mesh.scale, t_max * self._mesh.scale
        # Float32 numbers, so that float32 and float64 distances compare with them alike.
        with np.errstate(over="ignore"):
            rough = np.array([t_min + _CLEAR, t_max - _CLEAR, t_max + _CLEAR]).astype(np.float32)
        return _Limits(t_min, t_max, *rough.tolist())

    def _within(self, desk: Workspace, unit: Float, starts: Starts, limits: _Limits) -> _Hits:
        """Closest hits, refined where that decides whether they count; see `_CLEAR`.

        The rows of `desk` hold the directions already; `unit`, (3, n), are the same in float64.
        """
        t, place = self._cast(desk, unit, starts, 0.0)
        counts = t < np.inf if limits.last == np.inf else t <= limits.last
        unclear = t < limits.near
        if limits.far < np.inf:
            unclear |= t > limits.far
            unclear &= counts
        ray = np.flatnonzero(unclear)
        if not len(ray):
            return _Hits(counts, t, place)
        exact = self._refined(ray, t[ray], place[ray], unit, starts)
        t = t.astype(np.float64)
        t[ray] = exact
        early = exact < limits.t_min  # a refined distance may be just below 0 as well
        counts[ray] = ~early & (exact <= limits.t_max)
        if early.any():
            again, t[again], place[again] = self._beyond(desk, ray[early], unit, starts, limits)
            counts[again] = t[again] <= limits.t_max
        return _Hits(counts, t, place)

    def _beyond(
        self,
        desk: Workspace,
        ray: NDArray[np.intp],
        unit: Float,
        starts: Starts,
        limits: _Limits,
    ) -> tuple[NDArray[np.intp], Float, NDArray[np.int32]]:
        """Find the next hits, beyond `t_min`, of rays that hit something before it.

        Returns the rays that have one, in any order; refined distances; places.
        """
        rays, distances, places = [], [], []
        for ahead in _STARTS:
            directions, at = _columns_of(unit, ray), Starts(starts.of(ray))
            desk.aim(directions)
            rough, place = self._cast(desk, directions, at, limits.t_min + ahead)
            hit = np.flatnonzero(rough < np.inf)
            t = self._refined(hit, rough[hit], place[hit], directions, at)
            good = t >= limits.t_min
            rays.append(ray[hit[good]])
            distances.append(t[good])
            places.append(place[hit[good]])
            ray = ray[hit[t < limits.t_min]]
            if not len(ray):
                break
        return np.concatenate(rays), np.concatenate(distances), np.concatenate(places)

    def _cast(
        self, desk: Workspace, unit: Float, starts: Starts, begin: float
    ) -> tuple[NDArray[np.floating[Any]], NDArray[np.int32]]:
        """Closest hits at or behind a distance `begin`, up to float32 rounding; see `_within`.

        Returns rough distances (n,), local, inf for a miss; and rows of the mesh's corners (n,).
        """
        n = unit.shape[1]
        ways: Float | None = None
        if begin > 0 or starts.reach > _NEAR:
            points = starts.of(np.arange(n))
            entry, _ = self._mesh.clip(points, unit.T)
            near = np.abs(points).max(axis=1) <= _NEAR
            ways = np.maximum(np.where(near, 0, entry), begin)
            # If the ray is too far away for float64 to place the start, it stays near the scene.
            starts = Starts(np.clip(points + ways[:, None] * unit.T, -_NEAR, _NEAR))
        t, place = self._trace(desk.start(n, starts))
        return t if ways is None else t + ways, place

    def _trace(self, rows: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Closest hits of rows (n, 6), origins and directions; distances are inf for a miss."""
        t = np.full(len(rows), np.inf, np.float32)  # longest distance; embreex writes hits to it

        def part(share: slice) -> NDArray[np.int32]:
            origins, directions = rows[share, :3], rows[share, 3:]
            found = self._scene.run(origins, directions, dists=t[share], output=True)
            place: NDArray[np.int32] = found["primID"]
            return place

        if self._one or len(rows) <= _SHARE:
            return t, part(slice(None))
        shares = [slice(start, start + _SHARE) for start in range(0, len(rows), _SHARE)]
        return t, np.concatenate(list(self._threads.map(part, shares)))

    def _refined(
        self,
        ray: NDArray[np.intp],
        rough: NDArray[np.floating[Any]],
        place: NDArray[np.int32],
        unit: Float,
        starts: Starts,
    ) -> Float:
        """Distances of some rays in float64 accuracy, from their `rough` and `place`."""
        directions = _columns_of(unit, ray)
        return self._refine.distance(starts.of(ray), directions, place.astype(np.intp), rough)

    def _distance(
        self, hits: _Hits, ray: NDArray[np.intp], unit: Float, starts: Starts, limits: _Limits
    ) -> tuple[Float, NDArray[np.intp]]:
        """Refined distances of some hits that count, and their places."""
        rough, place = hits.t.take(ray), hits.place.take(ray)
        if 2 * len(ray) > len(hits.t):  # selecting directions and starts takes longer
            every = hits.place.astype(np.intp)
            t = self._refine.distance(starts.points, unit, every, hits.t).take(ray)
        else:
            t = self._refined(ray, rough, place, unit, starts)
        beyond = np.flatnonzero((t < limits.t_min) | (t > limits.t_max))
        t[beyond] = rough[beyond]
        return t, place.astype(np.intp)


_desks = threading.local()  # threads of one worker may cast at the same time


def _desk(rays: int) -> Workspace:
    """Workspace of this thread, for at least that many rays; its casters share it."""
    kept: Workspace | None = getattr(_desks, "desk", None)
    if kept is None or kept.size < rays:
        kept = _desks.desk = Workspace(rays)
    return kept


def _columns_of(unit: Float, ray: NDArray[np.intp]) -> Float:
    """Select columns of (3, n); faster than `take` along the axis, which copies all columns."""
    out = np.empty((3, len(ray)))
    for row, axis in zip(unit, out, strict=True):
        row.take(ray, out=axis, mode="clip")  # the mode in which it writes straight to `out`
    return out
