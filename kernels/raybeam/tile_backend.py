"""Ray casting with tiles of neighboring rays in loops compiled by numba, for any CPU."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar
from weakref import ref

import numpy as np

from .arrays import AnyArray, Floats
from .backend import Backend, ClosestHits
from .body_rays import NearestHits, RayBodyPairs
from .hits import HitColumns, join_hits
from .installation import install_command
from .instances import LocalScene
from .poses import Poses
from .rays import Rays
from .scan import Scan
from .tile_plan import TilePlan, image_rays, plan_consecutive, plan_tiles

if TYPE_CHECKING:
    from .cast_record import CastRecord

_SHARE = 1 << 14  # number of rays that a thread casts at a time, if there are several threads
_BODY_RAYS = 64  # rays per tile if rays are cast at bodies
_MAX_PLANS = 16  # cached tile plans


class TileBackend(Backend):
    """Backend that traverses trees with tiles of rays in float32, but decides hits in float64.

    The margins of the float32 tests exceed all rounding errors, so the hits have the same bits as
    those of the numpy backend.
    """

    name: ClassVar[str] = "tiles"
    chunk: ClassVar[int] = 1 << 17  # Hits take 20 bytes per ray until the chunks are joined.

    @classmethod
    def unavailable_reason(cls) -> str:
        """Return why numba is unavailable and how to fix this, or "" if it is available."""
        if importlib.util.find_spec("numba") is None:
            return f"numba is not installed; run {install_command('numba')}"
        return ""

    def __init__(
        self, scene: LocalScene, threads: int | None = None, device: int | None = None
    ) -> None:
        from . import cast_record, tile_casts, tile_memory, tile_tree

        super().__init__(scene, threads, device)
        self._count = threads or os.cpu_count() or 1
        # Threads are started on first use.
        self._threads = ThreadPoolExecutor(self._count, "tiles")
        self._process = os.getpid()
        self._loops = tile_casts
        self._memory = cast_record
        self._tiles = tile_memory.thread_tiles
        self._top_nodes = tile_tree.build_instance_nodes
        self._trees = [tile_tree.build_tile_tree(mesh.corners) for mesh in scene.meshes]
        self._pending_nodes = 2 + max(tree.stack for tree in self._trees)
        self._corners = [np.ascontiguousarray(mesh.corners) for mesh in scene.meshes]
        self._meshes = self._mesh_records(scene)
        # The index of each triangle in the caller's `faces`, in the order of the corners of all
        # meshes.
        self._index = np.concatenate([mesh.index for mesh in scene.meshes])
        cast = np.zeros(1, cast_record.CAST)
        cast["mesh"] = self._meshes.ctypes.data
        cast["index"] = self._index.ctypes.data
        self._records = self._instance_records(scene)
        if scene.has_matrices:
            cast["instances"] = self._records.ctypes.data
        self._base = cast
        self._plans: dict[tuple[int, int, int], tuple[ref[AnyArray], TilePlan]] = {}
        self.update_scene(scene)

    def _mesh_records(self, scene: LocalScene) -> AnyArray:
        """Create a `MESH` record for each mesh in a scene."""
        records = np.zeros(len(scene.meshes), self._memory.MESH)
        for record, mesh, tree, corners in zip(
            records, scene.meshes, self._trees, self._corners, strict=True
        ):
            record["corners"] = corners.ctypes.data
            record["nodes"] = tree.nodes.ctypes.data
            record["blocks"] = tree.blocks.ctypes.data
            record["leaf_corners"] = tree.corners.ctypes.data
            record["order"] = tree.order.ctypes.data
            if (opacity := mesh.opacity) is not None:
                record["uv"] = opacity.uv.ctypes.data
                record["mask"] = opacity.mask.ctypes.data
                record["mask_height"], record["mask_width"] = opacity.mask.shape
        return records

    def _instance_records(self, scene: LocalScene) -> AnyArray:
        """Create an `INSTANCE` record for each instance in a scene, without its matrix."""
        records = np.zeros(len(scene.mesh), self._memory.INSTANCE)
        first_rows = np.cumsum([0, *(len(corners) for corners in self._corners[:-1])])
        records["mesh"] = self._meshes.ctypes.data + self._meshes.itemsize * scene.mesh
        records["first"] = first_rows[scene.mesh]
        return records

    def update_scene(self, scene: LocalScene) -> None:
        """Replace the scene by one with the same instances but new transforms."""
        super().update_scene(scene)
        frame = scene.frame
        base = self._base
        base["center"] = frame.center
        base["scale"] = frame.scale
        if scene.has_matrices:
            self._top, top_stack = self._top_nodes(scene.boxes)
            self._top_stack = top_stack
            base["top"] = self._top.ctypes.data
            self._records["matrix"] = scene.matrices

    def closest_hits(self, rays: Rays) -> ClosestHits:
        """Return the closest hits of at most `chunk` rays."""
        from . import weight_loops  # imported late because scans need no weights

        cast = self._ray_cast(rays)
        cast.record["index"] = 0  # Return rows of the corners, for `barycentric_weights`.
        ray, distance, row, instance = self._cast(cast, [0, len(rays)], plan_consecutive(1))
        u, v = np.empty((2, len(ray)))
        origins = self._scene.frame.to_local(rays.origins)
        if len(origins) > 1:
            origins = np.ascontiguousarray(origins[ray])
        directions = np.ascontiguousarray(rays.directions[ray])
        weight_loops.barycentric_weights(cast.record, origins, directions, row, instance, u=u, v=v)
        t = distance * self._scene.frame.scale  # exact, because the scale is a power of two
        return ClosestHits(ray, t, self._index[row], u, v, instance)

    def cast_pairs(self, pairs: RayBodyPairs, nearest: NearestHits) -> None:
        """Cast rays at bodies with this shape, and record closer hits in `nearest`."""
        from . import pair_casts  # imported late because static scenes do not need its loops

        record = self._base.copy()
        scale = self._scene.frame.scale
        record["t_min"], record["t_max"] = self._local_limits(pairs.limits, scale)
        record["tile"] = self._tile_address(_BODY_RAYS)
        pair_casts.cast_pairs(record, pairs.contiguous(), nearest)

    def scan_parts(self, scan: Scan) -> Iterator[tuple[int, int, HitColumns]]:
        """Yield (start, stop, hits) for consecutive ranges of rays in a scan.

        The ray indices of the hits start at 0 in each part.
        """
        cast = self._scan_cast(scan)
        plan = self._plan(scan)
        rays = image_rays(scan, plan.firing)
        for start, stop in scan.chunks(self.chunk):
            cuts = range(start - start % rays + rays, stop, rays) if rays else ()
            yield start, stop, self._cast(cast, [start, *cuts, stop], plan)

    def _plan(self, scan: Scan) -> TilePlan:
        """Return the tile plan for a scan, cached for scans with the same beams."""
        beams = np.asarray(scan.pattern.directions.base)  # Copies of a pattern share this array.
        key = id(beams), scan.pattern.subrays_per_beam, len(scan)
        known = self._plans.get(key)
        if known is not None and known[0]() is beams:
            return known[1]
        if len(self._plans) >= _MAX_PLANS:
            self._plans.clear()
        plan = plan_tiles(scan)
        self._plans[key] = ref(beams), plan
        return plan

    def _tile_address(self, rays: int) -> int:
        """Return the address of this thread's tile memory for the given number of rays."""
        nested = self._scene.has_matrices
        pending = self._pending_nodes + (self._top_stack if nested else 0)
        return self._tiles.address(rays, pending, len(self._scene.mesh) if nested else 0)

    @staticmethod
    def _local_limits(limits: tuple[float, float], scale: float) -> tuple[float, float]:
        """Convert the distance limits from meters to local coordinates.

        The maximum distance is made finite, because infinity stands for no hit.
        """
        t_min, t_max = limits
        return t_min * scale, min(t_max * scale, np.finfo(np.float64).max)

    def _ray_cast(self, rays: Rays) -> CastRecord:
        """Create a `CastRecord` for rays that do not belong to a pattern.

        Each ray becomes a beam, and all beams are cast from a single pose.
        """
        origins: Floats | None = rays.origins
        position = np.zeros((1, 3))
        if len(rays.origins) == 1:
            position = rays.origins
            origins = None
        cast = self._memory.CastRecord(self._base)
        poses = Poses(position, None, max(len(rays), 1))
        cast.set_beams(rays.directions, origins, poses, 0)
        self._set_limits(cast, (rays.t_min, rays.t_max))
        return cast

    def _scan_cast(self, scan: Scan) -> CastRecord:
        """Create a `CastRecord` for a scan.

        If the scan has an output array, the compiled loops also write the rays to it.
        """
        cast = self._memory.CastRecord(self._base)
        cast.set_pattern(scan.pattern, scan.poses, scan.first)
        if scan.out is not None:
            cast.record["directions_out"] = scan.out[-3:].ctypes.data
            cast.record["ray_count"] = len(scan)
            if len(scan.out) > 3:
                cast.record["origins_out"] = scan.out.ctypes.data
                if cast.record["shares_origin"]:
                    scan.out[:3] = scan.poses.positions.T
        self._set_limits(cast, (scan.t_min, scan.t_max))
        return cast

    def _set_limits(self, cast: CastRecord, limits: tuple[float, float]) -> None:
        """Set a cast's minimum and maximum distance, given in meters."""
        record = cast.record
        record["t_min"], record["t_max"] = self._local_limits(limits, self._scene.frame.scale)

    def _cast(self, cast: CastRecord, cuts: Sequence[int], plan: TilePlan) -> HitColumns:
        """Cast consecutive ranges of rays, and return their hits in ray order.

        `cuts` contains the first ray of each range, followed by the end of the last range. Rays in
        different ranges do not share a tile. Ray indices are relative to the first ray.

        Distances are in meters. `triangle` contains indices in the caller's faces, or rows of the
        corners if the record's field `index` is 0.
        """
        start = cuts[0]
        n = cuts[-1] - start
        ray = np.empty(n, np.uint32)
        distance = np.empty(n)
        triangle = np.empty(n, np.int32)
        instance = (np.empty if self._scene.has_matrices else np.zeros)(n, np.int32)

        def cast_share(begin: int, stop: int) -> HitColumns:
            """Cast rays `begin` to `stop`. Return views of their hits."""
            record = cast.record.copy()
            row = begin - start
            hits = np.empty(2 * (stop - begin + 1))
            record["hits"] = hits.ctypes.data
            record["tile"] = self._tile_address(plan.rays)
            record["tile_rays"] = plan.rays
            record["lanes"] = plan.lanes.ctypes.data
            record["shifts"] = plan.shifts.ctypes.data
            record["groups"] = len(plan.lanes)
            record["firing"] = plan.firing
            record["firings"] = plan.firings
            record["first_ray"] = start
            record["ray"] = ray[row:].ctypes.data
            record["distance"] = distance[row:].ctypes.data
            record["triangle"] = triangle[row:].ctypes.data
            record["instance"] = instance[row:].ctypes.data
            count = self._loops.cast_rays(record, begin, stop)
            part = slice(row, row + count)
            return ray[part], distance[part], triangle[part], instance[part]

        column = plan.firing * plan.firings
        share = max(_SHARE // column, 1) * column
        if self._count == 1 or n <= share:
            ranges = [*pairwise(cuts)]
            return (
                cast_share(*ranges[0])
                if len(ranges) == 1
                else join_hits([cast_share(*one) for one in ranges])
            )
        # A forked process does not have the threads of its parent.
        if self._process != os.getpid():
            self._threads = ThreadPoolExecutor(self._count, "tiles")
            self._process = os.getpid()
        shares = [
            (begin, min(begin + share, last))
            for first, last in pairwise(cuts)
            for begin in range(first, last, share)
        ]
        return join_hits(list(self._threads.map(cast_share, *zip(*shares, strict=True))))
