"""The ray caster of a whole scene: the static scene, its instances, and moving actors.

Each ray is transformed to the frame of an actor at the time of the ray, so that no tree is ever
rebuilt: see `raybeam.moving`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from raybeam import (
    Deforming,
    Instance,
    Mesh,
    Moving,
    Opacity,
    OtherHits,
    Pattern,
    RayCaster,
    Scan,
    ScanReturns,
    available_backends,
    check_scan,
    hits_on,
)
from raybeam.crossing import Nearest

from ..base.arrays import Bools, Floats, Indices, Ints, Ints32
from ..base.errors import LidarError
from ..base.interrupts import deferred_interrupts
from ..base.words import did_you_mean
from ..scene.actors import Actor, distinct_meshes
from ..scene.scene import Scene
from ..scene.scene_instances import Instances, MeshPart, parts_of
from .actor_trajectories import ActorTrajectories
from .motion import CastPoses, Clock
from .surfaces import Surfaces

AUTO_TAKES = "Backend 'auto' takes one that works."
REACHED = 1e-3  # share of a distance: a ray that ends this close before a point reaches the point


class _NearestHits(NamedTuple):
    """Nearest hits of rays: arrays (k,), in the order of rays."""

    ray: Ints
    distance: Floats  # metres
    triangle: Ints32


class _ActorShapes(NamedTuple):
    """Shapes of actors; actors of the same mesh share a shape."""

    casters: tuple[RayCaster | Deforming, ...]
    boxes: Floats  # (s, 2, 3): bounds of the shapes, metres
    part_triangles: Ints32  # (s, p): first triangle of each part of a shape
    shape: Indices  # (a,): shape of each actor


def check_backend_here(backend: str, advice: str = AUTO_TAKES) -> None:
    """Refuse a backend that this machine lacks, before a local cluster is started."""
    # An interrupt during the import of an extension module would look like a missing module.
    with deferred_interrupts():
        backends = {"auto": "", **available_backends()}
    if backend not in backends:
        hint = did_you_mean(backend, backends) or f" There are {', '.join(backends)}."
        raise LidarError(f"There is no backend {backend!r}.{hint}")
    if backends[backend]:
        raise LidarError(f"Backend {backend!r} cannot be used here: {backends[backend]}. {advice}")


class SceneCaster:
    """Casts scans like `RayCaster.scan`, including hits on actors.

    Triangles of instances are numbered after the triangles of the scene, triangles of actors after
    both. Rays that touch no actor give the same bits as without actors. The poses of a scan have
    the trajectories of the actors. A tally is by the counters of `surfaces`. `options` are
    arguments of `RayCaster`. `like` is a caster of the same scene, possibly with other actors,
    whose trees are shared.
    """

    def __init__(
        self,
        scene: Scene,
        surfaces: Surfaces,
        shared_caster: SceneCaster | None = None,
        **options: Any,
    ) -> None:
        self._surfaces = surfaces
        self._shared = scene.instances
        self._first_triangles: Ints32 | None = None  # of each body of the caster
        self._faces = faces = len(scene.faces)
        if self._shared is not None:
            first_triangles = faces + np.cumsum([0, *self._shared.sizes[:-1]])
            self._first_triangles = np.append([0] * bool(faces), first_triangles).astype(np.int32)
            faces += self._shared.triangles
        # Distance behind a surface at which light continues, so as not to hit the surface again:
        # Embree's rounding is up to a quarter of this distance.
        reach = np.float32(np.abs(scene.bounds).max())
        self.clear_m = max(1e-5, 4 * float(np.spacing(reach)))
        self._media = surfaces.media
        if shared_caster is None or shared_caster._media != self._media:
            vertices = surfaces.spread_out(1.5 * self.clear_m)
            self.caster: RayCaster = _caster_of(scene, vertices, options)
        else:
            self.caster = shared_caster.caster
        self._shapes = _shapes(scene.actors, options)
        sizes = [len(actor.mesh.faces) for actor in scene.actors]
        # First triangle of each actor.
        self._actor_triangles = (faces + np.cumsum([0, *sizes[:-1]])).astype(np.int32)

    def move_instances(self, surfaces: Surfaces, shared: Instances, rows: Indices) -> None:
        """Move instances `rows` to their transforms in `shared`; no scan may be under way."""
        first = self.caster.instance_count - len(shared)
        for row in rows:
            self.caster.move(first + int(row), shared.transforms[row])
        self._surfaces = surfaces
        self._shared = shared

    def counters(self) -> tuple[Ints, int]:
        """Return the counters of bodies for `RayCaster.visit`, and their number.

        Each instance has a counter, see `Scene.counters`. Array (bodies, 2).
        """
        shared = 0 if self._shared is None else len(self._shared)
        static_count = self.caster.instance_count - shared
        rows = [[0, 1]] * static_count + [[self._faces + number, 0] for number in range(shared)]
        return np.array([*rows, [shared, 1]], np.int64), self._surfaces.counters

    @property
    def backend(self) -> str:
        """Name of the backend in use."""
        return self.caster.backend

    def scan(
        self,
        pattern: Pattern,
        poses: CastPoses,
        *,
        window: tuple[int, int] | None = None,
        t_min: float = 0.0,
        t_max: float = np.inf,
        keep_every: int = 1,
        groups: Ints | None = None,
        tally: bool = False,
        room: Floats | None = None,
    ) -> ScanReturns:
        """Cast rays of a pattern as `RayCaster.scan`, and also on actors.

        The arguments are those of `RayCaster.scan`. If there are actors, the poses have a clock.
        """
        common: dict[str, Any] = {
            **poses.caster_arguments,
            "window": (0, len(pattern)) if window is None else window,
            "t_min": t_min,
            "t_max": t_max,
            "room": room,
        }
        if self._first_triangles is None and self._shapes is None:
            return self.caster.scan(
                pattern, **common, keep_every=keep_every, groups=groups, tally=tally
            )
        hits = self.caster.scan(pattern, **common)
        if self._first_triangles is not None:
            hits = replace(hits, triangle=hits.triangle + self._first_triangles[hits.instance])
        if self._shapes is None:
            ray = hits.ray.astype(np.int64)
            distance = hits.distance
            triangle = hits.triangle
        else:
            scan = check_scan(pattern, **common)
            ray, distance, triangle = self._with_actors(hits, scan, poses)
        group_starts = np.zeros(1, np.int64) if groups is None else groups
        cuts = np.append(np.searchsorted(ray, group_starts), len(ray))
        counts = np.diff(cuts)
        counted = None
        if tally:
            counted = np.bincount(
                self._surfaces.counter(triangle), minlength=self._surfaces.counters
            )
        if keep_every > 1:
            number_in_group = np.arange(len(ray)) - np.repeat(cuts[:-1], counts)
            rows = np.flatnonzero(number_in_group % keep_every == 0)
            ray = ray[rows]
            distance = distance[rows]
            triangle = triangle[rows]
        none = np.zeros(len(ray), np.int32)
        return ScanReturns(ray.astype(np.uint32), distance, triangle, counts, counted, none)

    def is_visible(
        self,
        origins: Floats,
        towards: Floats,
        distance: Floats,
        times: Floats,
        actor_trajectories: ActorTrajectories,
    ) -> Bools:
        """Return whether points are visible from origins (n, 3), at firing times (n,): (n,).

        `towards` are vectors from the origins to the points, (n, 3), of lengths `distance` (n,).
        """
        visible = np.ones(len(distance), np.bool_)
        if len(distance):
            poses = CastPoses(np.zeros(3), clock=Clock(times, np.zeros(1), actor_trajectories))
            hits = self.scan(Pattern(towards / distance[:, None], origins), poses)
            visible[hits.ray] = hits.distance > distance[hits.ray] * (1 - REACHED)
        return visible

    def _with_actors(self, static_hits: ScanReturns, scan: Scan, poses: CastPoses) -> _NearestHits:
        """Return the nearest hits on static bodies and actors."""
        from . import surface_loops  # not before: numba takes half a second to import

        static_distance = np.full(len(scan), np.inf)
        static_distance[static_hits.ray] = static_hits.distance
        nearest, shapes = self._nearest(scan, poses, static_distance)
        joined = surface_loops.JoinedHits(
            np.empty(len(scan), np.int64), np.empty(len(scan)), np.empty(len(scan), np.int32)
        )
        count = surface_loops.merge(
            static_hits.ray,
            static_hits.triangle,
            nearest,
            surface_loops.ActorTriangles(
                shapes.part_triangles, shapes.shape, self._actor_triangles
            ),
            joined,
        )
        return _NearestHits(joined.ray[:count], joined.distance[:count], joined.triangle[:count])

    def on_actors(self, scan: Scan, poses: CastPoses) -> OtherHits:
        """Find the nearest hits of rays on actors."""
        hits, shapes = self._nearest(scan, poses)
        ray = np.flatnonzero(hits.body >= 0)
        actor = hits.body[ray]
        triangle = hits.triangle[ray]
        part_triangle = shapes.part_triangles[shapes.shape[actor], hits.instance[ray]]
        triangle = triangle + part_triangle + self._actor_triangles[actor]
        return OtherHits(ray.astype(np.uint32), hits.distance[ray], triangle)

    def _nearest(
        self, scan: Scan, poses: CastPoses, limit: Floats | None = None
    ) -> tuple[Nearest, _ActorShapes]:
        """Return the nearest hits on actors, before distances `limit` (n,), and the shapes."""
        assert self._shapes is not None
        trajectories = poses.actor_trajectories

        def frames(actor: Ints, times: Floats) -> Floats:
            """Return the frames of animations of actors at times, which deform their meshes."""
            return trajectories.played(actor, times)[0]

        moving = Moving(
            self._shapes.casters,
            self._shapes.boxes,
            self._shapes.shape,
            trajectories.presence_ns,
            trajectories.table,
            frames,
        )
        return hits_on(moving, scan, poses.times, limit), self._shapes


def _caster_of(scene: Scene, vertices: Floats, options: dict[str, Any]) -> RayCaster:
    """Build the trees of static bodies, with `vertices` of the scene's faces."""
    if scene.instances is None:
        return RayCaster(vertices, scene.faces, **options)
    static_instances = [Instance(Mesh(vertices, scene.faces))] if len(scene.faces) else []
    meshes = [_mesh_of(part) for part in scene.instances.parts]
    instances = [
        Instance(meshes[part], matrix)
        for part, matrix in zip(scene.instances.part, scene.instances.transforms, strict=True)
    ]
    return RayCaster.from_instances([*static_instances, *instances], **options)


def _mesh_of(part: MeshPart) -> Mesh:
    """Return the mesh of a part, with the mask of its texture, if any."""
    opacity = None if part.mask is None or part.uv is None else Opacity(part.mask, part.uv)
    return Mesh(part.vertices, part.faces, opacity)


def _shapes(actors: tuple[Actor, ...], options: dict[str, Any]) -> _ActorShapes | None:
    """Build the casters of the shapes of actors; None without actors."""
    if not actors:
        return None
    meshes, shape = distinct_meshes(actors)
    parts = [[*parts_of(mesh)] for mesh in meshes]
    part_triangles = np.zeros((len(meshes), max(map(len, parts))), np.int32)
    for row, mesh_parts in zip(part_triangles, parts, strict=True):
        row[1 : len(mesh_parts)] = np.cumsum([len(part.faces) for part in mesh_parts])[:-1]
    casters = tuple(
        Deforming(mesh.animation.vertices, mesh.faces)
        if mesh.animation
        else RayCaster.from_instances([Instance(_mesh_of(part)) for part in mesh_parts], **options)
        for mesh, mesh_parts in zip(meshes, parts, strict=True)
    )
    boxes = np.array([(mesh.animation or mesh).bounds for mesh in meshes])
    return _ActorShapes(casters, boxes, part_triangles, shape)
