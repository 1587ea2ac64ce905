"""The ray caster of a whole world: of the scene, which stands, and of actors, which move.

Each ray is taken into an actor's axes at its own time, so that no tree is ever built again; and an
actor is asked only about rays that come near the sphere that holds it meanwhile.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, RayCaster, ScanReturns

from ..scene.actors import Actor
from ..scene.scene import Scene
from ..sensor import Sensor
from .motion import Poses, into_axes

CHUNK_RAYS = 1 << 16  # that are made at a time to be taken to actors
SAMPLES = 32  # of an actor's way while the rays of a chunk are fired

Float = NDArray[np.float64]


class World:
    """Casts scans as `RayCaster.scan` does, hits of actors among the others.

    Triangles of actors are numbered after those of the scene, see `Scene.solid`. What no actor
    touches has the bits that it has without actors.

    Parameters
    ----------
    scene
        With its actors.
    backend, threads, device
        As of `RayCaster`.
    """

    def __init__(
        self, scene: Scene, backend: str, threads: int | None = None, device: int | None = None
    ) -> None:
        options: dict[str, Any] = {"backend": backend, "threads": threads, "device": device}
        self._caster = RayCaster(scene.vertices, scene.faces, **options)
        self._actors, faces = [], len(scene.faces)
        for actor in scene.actors:
            self._actors.append(_Cast(actor, faces, options))
            faces += len(actor.mesh.faces)
        self._faces = faces

    def scan(
        self,
        pattern: Pattern,
        poses: Poses,
        *,
        window: tuple[int, int] | None = None,
        t_min: float = 0.0,
        t_max: float = np.inf,
        keep_every: int = 1,
        groups: NDArray[np.int64] | None = None,
        tally: bool = False,
    ) -> ScanReturns:
        """See `RayCaster.scan`; the poses have a clock where there are actors."""
        start, stop = (0, len(pattern)) if window is None else window
        limits = {"t_min": t_min, "t_max": t_max}
        common: dict[str, Any] = {**poses.given, "window": (start, stop), **limits}
        if not self._actors:
            return self._caster.scan(
                pattern, **common, keep_every=keep_every, groups=groups, tally=tally
            )
        found = self._caster.scan(pattern, **common)
        distance = np.full(stop - start, np.inf)
        triangle = np.full(stop - start, -1, np.int32)
        distance[found.ray], triangle[found.ray] = found.distance, found.triangle
        for first in range(0, stop - start, CHUNK_RAYS):
            ray = np.arange(first, min(first + CHUNK_RAYS, stop - start))
            origins, directions = map(_by_axis, poses.rays(pattern, ray, start))
            times = poses.times(ray)
            for actor in self._actors:
                rows, t, face = actor.hits(origins, directions, times, **limits)
                nearer = t < distance[ray[rows]]
                distance[ray[rows[nearer]]], triangle[ray[rows[nearer]]] = t[nearer], face[nearer]
        ray = np.flatnonzero(triangle >= 0)
        begins = np.zeros(1, np.int64) if groups is None else groups
        cuts = np.append(np.searchsorted(ray, begins), len(ray))
        counts = np.diff(cuts)
        kept = (np.arange(len(ray)) - np.repeat(cuts[:-1], counts)) % keep_every == 0
        counted = np.bincount(triangle[ray], minlength=self._faces) if tally else None
        ray = ray[kept]
        return ScanReturns(ray.astype(np.uint32), distance[ray], triangle[ray], counts, counted)

    def returns(
        self,
        sensor: Sensor,
        keep_every: int,
        pattern: Pattern,
        poses: Poses,
        window: tuple[int, int],
        groups: NDArray[np.int64],
    ) -> ScanReturns:
        """Cast what a sensor fires, each group a scan: hits in its range, counted and thinned."""
        return self.scan(
            pattern,
            poses,
            window=window,
            t_min=sensor.min_range_m,
            t_max=sensor.max_range_m,
            keep_every=keep_every,
            groups=groups,
            tally=True,
        )


def _by_axis(vectors: Float) -> Float:
    """Return vectors (m, 3) in memory axis by axis."""
    return np.ascontiguousarray(vectors.T).T


class _Cast:
    """An actor with its ray caster."""

    def __init__(self, actor: Actor, first: int, options: dict[str, Any]) -> None:
        self._way, vertices = actor.trajectory, actor.mesh.vertices
        self._first = first  # number of its first triangle
        self._caster = RayCaster(vertices, actor.mesh.faces, **options)
        self._centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self._radius = float(np.linalg.norm(vertices - self._centre, axis=1).max())

    def hits(
        self, origins: Float, directions: Float, times: Float, *, t_min: float, t_max: float
    ) -> tuple[NDArray[np.intp], Float, NDArray[np.int32]]:
        """Where rays (m, 3) meet it that are fired at times (m,), nanoseconds.

        Returns
        -------
        Numbers of the rays that do (h,), distances in lengths of their directions, and triangles.
        """
        rows = np.flatnonzero(self._near(origins, directions, times, t_max))
        if not len(rows):
            return rows, np.zeros(0), np.zeros(0, np.int32)
        starts = np.broadcast_to(origins, directions.shape)[rows]
        ahead = directions[rows]
        positions, rotations = self._way.poses(0, times[rows])
        starts = into_axes(starts - positions, rotations)
        hits = self._caster.cast(starts, into_axes(ahead, rotations), t_min, t_max)
        on = np.flatnonzero(hits.hit)
        # Directions of a sensor that turns meanwhile are not quite of unit length.
        lengths = np.linalg.norm(ahead[on], axis=1)
        return rows[on], hits.distance[on] / lengths, hits.triangle[on] + np.int32(self._first)

    def _near(
        self, origins: Float, directions: Float, times: Float, t_max: float
    ) -> NDArray[np.bool_]:
        """Which rays meet the sphere that holds the actor at all of these times: (m,)."""
        positions, rotations = self._way.poses(0, np.linspace(times.min(), times.max(), SAMPLES))
        centre = self._centre if rotations is None else rotations @ self._centre
        way = centre + positions
        middle = (way.min(axis=0) + way.max(axis=0)) / 2
        between = np.linalg.norm(np.diff(way, axis=0), axis=1).max()
        radius = self._radius + np.linalg.norm(way - middle, axis=1).max() + between + 1e-3
        # By axis: sums over rows of three take several times as long.
        x, y, z = np.subtract(middle[:, None], origins.T)
        squared = x * x + y * y + z * z
        if squared.min() > (t_max + radius) ** 2:
            return np.zeros(len(directions), np.bool_)
        a, b, c = directions.T
        along = x * a + y * b + z * c
        past = squared - along * along / (a * a + b * b + c * c)
        return np.asarray((past <= radius * radius) & (along >= -radius))
