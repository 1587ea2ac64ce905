"""The ray caster, which is the main class of this package."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Ints, Ints32
from .backend import Backend
from .body_rays import NearestHits, RayBodyPairs, TimedBodies
from .device import DeviceHits, DeviceNearestHits, ExternalHits
from .hits import Hits, ScanReturns, TallyCounts
from .instances import Instance, Mesh, build_scene, check_transforms
from .pattern import Pattern
from .poses import PoseMotion, Poses
from .rays import check_rays
from .registry import choose_backend
from .scan import Scan, check_scan


class RayCaster:
    """Ray caster for a triangle mesh, or for instances of meshes (see `from_instances`).

    Both sides of a triangle can be hit. A ray in the plane of a triangle does not hit it. A ray
    through an edge or a vertex hits every adjacent triangle, so closed meshes do not leak. The
    result for a ray is bit-identical, regardless of the other rays in the batch.

    Parameters
    ----------
    vertices
        (v, 3) real numbers, in meters. Large coordinates do not lose precision, because they are
        stored relative to a local origin.
    faces
        (f, 3) integers, indices into `vertices`. Triangles with zero area are never hit.
    backend
        "cuda", "tiles", "numpy", or "auto" for the first of these three that can be used.
    threads
        Maximum number of CPU threads; None for the backend's default.
    device
        Index of the CUDA device; None for the current device. Other backends ignore it.

    Raises
    ------
    ValueError
        If the arrays have wrong shapes or contain values that are not finite, if faces refer to
        missing vertices, or if the mesh has no area.
    BackendUnavailable
        If the requested backend cannot be used. The message states what to install.

    Examples
    --------
    >>> caster = RayCaster([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], backend="numpy")
    >>> hits = caster.cast([0.25, 0.25, 3], [[0, 0, -2], [0, 0, 1]])
    >>> hits.distance.tolist(), hits.triangle.tolist()
    ([3.0, inf], [0, -1])
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        backend: str = "auto",
        *,
        threads: int | None = None,
        device: int | None = None,
    ) -> None:
        self._start([Instance(Mesh(vertices, faces))], backend, threads, device)

    @classmethod
    def from_instances(
        cls,
        instances: Sequence[Instance],
        backend: str = "auto",
        *,
        threads: int | None = None,
        device: int | None = None,
    ) -> RayCaster:
        """Create a ray caster for mesh instances, numbered from 0 in the given order.

        Each mesh has a single acceleration structure, so memory use and build time depend on the
        meshes and hardly at all on the number of instances. A caster for a single instance without
        a transform is equivalent to a caster for its mesh.

        Parameters
        ----------
        instances
            Instances of meshes. At least one is required.
        backend, threads, device
            As for `RayCaster`.

        Raises
        ------
        ValueError
            If there are no instances, or if a transform is not an invertible, finite (3, 4) or
            (4, 4) matrix. The message contains the index of the instance.
        BackendUnavailable
            If the requested backend cannot be used. The message states what to install.

        Examples
        --------
        >>> mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> above = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]]
        >>> instances = [Instance(mesh), Instance(mesh, above)]
        >>> caster = RayCaster.from_instances(instances, backend="numpy")
        >>> hits = caster.cast([0.25, 0.25, 3], [[0, 0, -1]])
        >>> hits.distance.tolist(), hits.instance.tolist()
        ([1.0], [1])
        """
        caster = cls.__new__(cls)
        caster._start(instances, backend, threads, device)
        return caster

    def _start(
        self,
        instances: Sequence[Instance],
        backend: str,
        threads: int | None,
        device: int | None,
    ) -> None:
        if threads is not None and index(threads) < 1:
            raise ValueError(f"threads must be at least 1 or None, but is {threads}.")
        engine = choose_backend(backend)
        self._scene, self._transforms = build_scene(instances)
        self._engine = engine(self._scene, threads, device)
        self._moved = False
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        instances = f" in {self.instance_count} instances" if self._scene.has_matrices else ""
        return f"RayCaster({self.face_count} triangles{instances}, backend={self.backend!r})"

    @property
    def backend(self) -> str:
        """Name of the backend in use."""
        return self._engine.name

    @property
    def on_device(self) -> bool:
        """Whether hits can remain on a CUDA device, as `scan_on_device` requires."""
        return self._engine.on_device

    @property
    def device_lost(self) -> bool:
        """Whether the CUDA device has stopped responding to this process after an error."""
        return self._engine.device_lost

    @property
    def face_count(self) -> int:
        """Number of triangles in all meshes, including triangles with zero area."""
        return self._scene.face_count

    @property
    def instance_count(self) -> int:
        """Number of instances."""
        return len(self._scene.mesh)

    def cast_pairs(self, pairs: RayBodyPairs, nearest: NearestHits) -> None:
        """Cast rays at bodies that have this shape, and record closer hits in `nearest`."""
        self.engine.cast_pairs(pairs, nearest)

    def upload_rays(
        self, scan: Scan, start: int, stop: int, time_index: Ints32, end: float
    ) -> DeviceNearestHits:
        """Copy rays `start` to `stop` of a scan to the device. No hits are recorded yet.

        `time_index` (n,) contains the index of each ray's time. Only hits at a distance of less
        than `end` meters are recorded. Raises BackendUnavailable if this backend does not use a
        device.
        """
        return self.engine.upload_rays(scan, start, stop, time_index, end)

    def cast_bodies(self, bodies: TimedBodies, nearest: DeviceNearestHits) -> None:
        """Cast rays on the device at bodies with this shape, and record closer hits in `nearest`.

        Raises BackendUnavailable if this backend does not use a device.
        """
        self.engine.cast_bodies(bodies, nearest)

    def set_transforms(self, instance: int | ArrayLike, transform: ArrayLike) -> None:
        """Set new instance transforms for all subsequent casts.

        Only the acceleration structure over the instances is rebuilt, which happens once before the
        next cast. The results are the same as those of a new caster. Do not call this method while
        a cast is in progress.

        Parameters
        ----------
        instance
            Index of the instance, or indices (k,) without duplicates.
        transform
            (3, 4) or (4, 4), as for `Instance`; for k instances (k, 3, 4) or (k, 4, 4).

        Raises
        ------
        IndexError
            If an instance does not exist. In this case, no instance is moved.
        ValueError
            If a transform is invalid, or if the caster has a single mesh without a transform. In
            this case, no instance is moved.

        Examples
        --------
        >>> mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> instances = [Instance(mesh), Instance(mesh)]
        >>> caster = RayCaster.from_instances(instances, backend="numpy")
        >>> caster.set_transforms([0, 1], np.stack([np.eye(4), np.diag([1, 1, -1, 1])]))
        """
        single = np.ndim(instance) == 0
        numbers = np.asarray([index(instance)] if single else instance)  # type: ignore[arg-type]
        outside = numbers[(numbers < 0) | (numbers >= self.instance_count)]
        if len(outside):
            raise IndexError(
                f"Instance {outside[0]} does not exist. This caster has {self.instance_count} "
                "instances, numbered from 0."
            )
        if not self._scene.has_matrices:
            raise ValueError(
                "A single mesh without a transform cannot be moved. Create the caster with "
                "RayCaster.from_instances([Instance(mesh, numpy.eye(4))]) instead."
            )
        matrices = check_transforms(numbers, np.asarray(transform)[None] if single else transform)
        with self._lock:
            self._transforms[numbers] = matrices
            self._moved = True

    @property
    def engine(self) -> Backend:
        """Backend for the scene. If instances have moved, the scene is updated first."""
        with self._lock:
            if self._moved:
                self._scene = self._scene.with_transforms(self._transforms)
                self._engine.update_scene(self._scene)
                self._moved = False
        return self._engine

    def cast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        t_min: float = 0.0,
        t_max: float = np.inf,
    ) -> Hits:
        """Return the closest hit of each ray.

        Parameters
        ----------
        origins
            (n, 3), or (3,) for all rays, in meters.
        directions
            (n, 3), of any length greater than zero.
        t_min, t_max
            Minimum and maximum distance of hits in meters, both inclusive. With a `t_min` of 0, a
            ray that starts on a surface hits it at distance 0.

        Raises
        ------
        ValueError
            If a direction is zero, a value is NaN or infinite, or the shapes do not match. The
            message contains the index of the first invalid row.
        """
        return self.engine.cast(check_rays(origins, directions, t_min, t_max))

    def scan(
        self,
        pattern: Pattern,
        positions: ArrayLike | Poses,
        rotations: ArrayLike | None = None,
        *,
        window: tuple[int, int] | None = None,
        rays_per_pose: int | None = None,
        t_min: float = 0.0,
        t_max: float = np.inf,
        keep_every: int = 1,
        groups: ArrayLike | None = None,
        tally: bool = False,
        motion: PoseMotion | None = None,
        out: Floats | None = None,
    ) -> ScanReturns:
        """Cast a ray pattern from a pose or a series of poses.

        This is the fastest way to simulate a lidar.

        Rays are numbered from 0 at the start of the window. Use `pattern_rays` to compute their
        origins and directions.

        Parameters
        ----------
        pattern
            Rays in the sensor frame, which are validated once. The cuda backend stores and rotates
            the directions on the device.
        positions
            (3,) or (k, 3), in meters; or poses from `check_poses`, which replace `rotations`,
            `rays_per_pose` and `motion`.
        rotations
            (3, 3) or (k, 3, 3): rotations from the sensor frame to mesh coordinates; None if the
            axes of the two frames are parallel.
        window
            Rows ``start <= row < stop`` of the pattern to cast; None for all rows. The pattern
            repeats beyond its end, so row r is row ``r % len(pattern)``.
        rays_per_pose
            Number of consecutive rays that share a pose, so that ray i is cast from pose
            ``i // rays_per_pose``. Use the number of beams if a moving lidar has one pose per
            firing. A single pose applies to all rays.
        t_min, t_max
            Minimum and maximum distance of hits in meters, both inclusive.
        keep_every
            Store the first hit of each group and then every n-th hit, in ray order.
        groups
            Index of the first ray of each group, in ascending order and starting at 0, for several
            scans that are cast together. None for a single group.
        tally
            Whether to count the hits on each triangle, including hits that are not stored.
        motion
            Motion of the lidar while the rays that share a pose are fired, if these rays have
            different delays.
        out
            Output array for the origins and directions of all rays, as returned by `pattern_rays`:
            float64 (6, rays), contiguous, or (3, rays) for the directions only. None if they are
            not needed.

        Raises
        ------
        ValueError
            If a position is not finite, a rotation is invalid, there are too few poses for the
            rays, the window is not a valid range of rows, or there are more than 2**32 rays.

        Examples
        --------
        A head with two beams moves between its three firings. The pattern contains one firing.

        >>> caster = RayCaster([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]], backend="numpy")
        >>> down = Pattern([[0, 0, -1], [0.1, 0, -1]])
        >>> track = [[1, 1, 3], [2, 1, 3], [3, 1, 3]]
        >>> hits = caster.scan(down, track, window=(0, 6), rays_per_pose=2, keep_every=2)
        >>> hits.ray.tolist(), hits.hit_counts.tolist()
        ([0, 2, 4], [6])
        """
        return self.engine.scan(
            check_scan(
                pattern,
                positions,
                rotations,
                window=window,
                rays_per_pose=rays_per_pose,
                t_min=t_min,
                t_max=t_max,
                keep_every=keep_every,
                groups=groups,
                tally=tally,
                motion=motion,
                out=out,
            )
        )

    def scan_on_device(
        self,
        scan: Scan,
        use: Callable[[DeviceHits], object],
        counters: tuple[Ints, int] | None = None,
        external_hits: ExternalHits | None = None,
    ) -> tuple[Ints, TallyCounts | None]:
        """Cast a scan and pass its hits to a function on the CUDA device.

        Parameters
        ----------
        scan
            Scan from `check_scan`, which accepts the arguments of `RayCaster.scan`.
        use
            Function that is called with the stored hits of consecutive parts of the scan, in ray
            order, on the device of the caster. The arrays remain valid after the call.
        counters
            Table and length of the scan's tally. The table is int64 (instances, 2): hits on
            triangle t of instance i are counted in row ``table[i, 0] + table[i, 1] * t`` of the
            tally. None for the rows of `ScanReturns.tally`.
        external_hits
            Hits that replace more distant hits of the caster. They are assigned to an additional
            instance after the last one. With a tally, the table in `counters` must have a row for
            this instance.

        Returns
        -------
        hit_counts
            int64 (g,): number of hits in each group, including hits that are not stored.
        counted
            Indices of the nonzero counters and their numbers of hits, int64 (k,) each. None without
            a tally.

        Raises
        ------
        BackendUnavailable
            If the backend of this caster is not cuda.
        """
        return self.engine.scan_on_device(scan, use, counters, external_hits)
