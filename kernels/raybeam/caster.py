"""The ray caster that users see."""

from __future__ import annotations

from operator import index

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .hits import Hits, Returns
from .mesh import local_mesh
from .rays import (
    Pattern,
    check_interval,
    check_origins,
    check_rays,
    check_rotation,
    check_window,
)
from .registry import choose


class RayCaster:
    """Closest hits of rays with a triangle mesh.

    Both sides of a triangle count. A ray that runs in a triangle's plane does not meet that
    triangle. A ray through an edge or a corner meets every triangle there, so closed meshes
    do not leak. The same ray gives the same bits in every batch.

    Parameters
    ----------
    vertices
        (v, 3) real numbers, metres. Large coordinates are fine: work is done near the mesh.
    faces
        (f, 3) integers, rows of `vertices`. A triangle without an area is never hit.
    backend
        "cuda", "embree", "numpy", or "auto" for the first of these that can be used.
    threads
        Most CPU threads to cast with; None leaves it to the backend.
    device
        Number of the CUDA device; None for the current one. Other backends ignore it.

    Raises
    ------
    ValueError
        If the mesh is empty, not finite, of a wrong shape, or has faces without vertices.
    BackendUnavailable
        If the backend asked for cannot be used; the message says what to install.

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
        if threads is not None and index(threads) < 1:
            raise ValueError(f"threads is {threads}; it must be at least 1, or None.")
        engine = choose(backend)
        self._mesh = local_mesh(vertices, faces)
        self._engine = engine(self._mesh, threads, device)

    def __repr__(self) -> str:
        return f"RayCaster({self.face_count} triangles, backend={self.backend!r})"

    @property
    def backend(self) -> str:
        """Name of the backend in use."""
        return self._engine.name

    @property
    def face_count(self) -> int:
        """Number of triangles given, those without an area included."""
        return self._mesh.face_count

    def cast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        t_min: float = 0.0,
        t_max: float = np.inf,
    ) -> Hits:
        """Closest hit of every ray.

        Parameters
        ----------
        origins
            (n, 3) or (3,), metres.
        directions
            (n, 3), any length but zero.
        t_min, t_max
            Hits with ``t_min <= distance <= t_max`` count, metres. With `t_min` 0 a surface
            that the ray starts on is a hit at distance 0; the embree backend, which decides in
            single precision, may see or miss it.

        Raises
        ------
        ValueError
            If a direction is zero, anything is NaN or infinite (the message names the first
            such row), or the shapes do not fit.
        """
        return self._engine.cast(check_rays(origins, directions, t_min, t_max))

    def returns(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        t_min: float = 0.0,
        t_max: float = np.inf,
    ) -> Returns:
        """Closest hits of the rays that have one; less to make and to move than `cast`.

        Parameters and errors are those of `cast`.
        """
        return self._engine.returns(check_rays(origins, directions, t_min, t_max))

    def scan(
        self,
        pattern: Pattern,
        origin: ArrayLike,
        rotation: ArrayLike | None = None,
        *,
        window: tuple[int, int] | None = None,
        t_min: float = 0.0,
        t_max: float = np.inf,
    ) -> Returns:
        """Cast a pattern of directions from one pose: the fastest way for a lidar.

        In the result, rays are numbered from 0 at the window's start.

        Parameters
        ----------
        pattern
            Directions in the sensor's axes, checked once; the cuda backend keeps them on the
            device and makes the rays there.
        origin
            (3,), metres.
        rotation
            (3, 3) from the sensor's axes to the mesh's; None when they are the same.
        window
            Rows ``start <= row < stop`` of the pattern to cast; None for all.
        t_min, t_max
            As in `cast`.

        Raises
        ------
        ValueError
            If the origin is not finite, the rotation is none, or the window is not within the
            pattern.
        TypeError
            If the pattern is none, or the window not two whole numbers.
        """
        return self._engine.scan(
            pattern,
            check_window(pattern, window),
            check_origins(origin, 1),
            check_rotation(rotation),
            check_interval(t_min, t_max),
        )

    def count(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        t_min: float = 0.0,
        t_max: float = np.inf,
        *,
        every: bool = False,
    ) -> NDArray[np.int64]:
        """How many of the rays hit each triangle: (face_count,).

        Parameters and errors are those of `cast`, and:

        Parameters
        ----------
        every
            Count a ray for every triangle that it meets, not only for the closest. Of triangles
            that a ray meets at one distance, as at a common edge, all are counted; the embree
            backend counts one of them.

        Examples
        --------
        >>> caster = RayCaster([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], backend="numpy")
        >>> caster.count([0.25, 0.25, 3], [[0, 0, -1], [0, 0, 1]]).tolist()
        [1]
        """
        return self._engine.count(check_rays(origins, directions, t_min, t_max), every)

    def count_scan(
        self,
        pattern: Pattern,
        origin: ArrayLike,
        rotation: ArrayLike | None = None,
        *,
        window: tuple[int, int] | None = None,
        t_min: float = 0.0,
        t_max: float = np.inf,
        every: bool = False,
    ) -> NDArray[np.int64]:
        """Count as `count` does, for a pattern cast from one pose as by `scan`."""
        return self._engine.count_scan(
            pattern,
            check_window(pattern, window),
            check_origins(origin, 1),
            check_rotation(rotation),
            check_interval(t_min, t_max),
            every,
        )
