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
    Moving,
    OtherHits,
    Pattern,
    RayCaster,
    Scan,
    ScanReturns,
    available_backends,
    check_scan,
    hits_on,
    listed_hits_on,
)

from ..base.arrays import Bools, Floats, Indices, Ints, Ints32
from ..base.errors import LidarError
from ..base.interrupts import deferred_interrupts
from ..base.words import did_you_mean
from ..scene.actors import Actor, distinct_meshes
from ..scene.scene import Scene
from ..scene.scene_instances import Instances, parts_of
from .actor_trajectories import ActorTrajectories
from .motion import CastPoses, Clock
from .static_bodies import StaticBodies, mesh_of
from .surfaces import Surfaces

AUTO_TAKES = "Backend 'auto' takes one that works."
_MAX_ROOM_RAYS = 1 << 18  # rays that are stored for casts on static bodies and on actors: 13 MB
REACHED = 1e-3  # share of a distance: a ray that ends this close before a point reaches the point


class _NearestHits(NamedTuple):
    """Nearest hits of the rays that hit: arrays (k,), in the order of rays."""

    ray: Ints  # number of the ray, from 0 at the window's start
    distance: Floats  # metres
    triangle: Ints32


class _ActorShapes(NamedTuple):
    """The s shapes of the a actors of a scene; actors of the same mesh share a shape.

    A mesh has a part for its opaque triangles, and a part for each mask, see `parts_of`; a part is
    an instance of the shape's caster.
    """

    casters: tuple[RayCaster | Deforming, ...]  # (s,): in the frame of the mesh
    boxes: Floats  # (s, 2, 3): bounds of the shapes, metres, also of all frames of animations
    part_triangles: Ints32  # (s, p): first triangle of each part, among the triangles of its mesh
    shape: Indices  # (a,): shape of each actor


def check_backend_here(backend: str, advice: str = AUTO_TAKES) -> None:
    """Raise LidarError if this machine lacks a backend of casting; `advice` ends the message."""
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

    Triangles of instances are numbered after the faces of the scene, triangles of actors after
    both. Rays that touch no actor give the same bits as without actors. The poses of a scan have
    the trajectories of the actors.

    Parameters
    ----------
    scene
        Faces, instances and actors to hit.
    surfaces
        Surfaces of the scene; a tally counts hits by `Surfaces.counter`.
    shared_caster
        Caster of the same scene, possibly with other actors. Its trees of static bodies are shared
        if the same surfaces enclose media.
    range_m
        Largest range of the sensors, metres: of a scene of hundreds of kilometres, what is far
        beyond the range is left out. Before scans, `cover` says where sensors are.
    options
        Arguments of `RayCaster`.
    """

    def __init__(
        self,
        scene: Scene,
        surfaces: Surfaces,
        shared_caster: SceneCaster | None = None,
        range_m: float = np.inf,
        **options: Any,
    ) -> None:
        self._surfaces = surfaces
        self._instances = scene.instances
        self._face_count = static_triangles = len(scene.faces)
        if self._instances is not None:
            static_triangles += self._instances.triangles
        # Distance behind a surface at which light continues, so as not to hit the surface again:
        # Embree's rounding is up to a quarter of this distance.
        reach = np.float32(np.abs(scene.bounds).max())
        self.clear_m = max(1e-5, 4 * float(np.spacing(reach)))
        self._range_m = range_m
        self._media = surfaces.media
        if shared_caster is None or shared_caster._media != self._media:
            # Surfaces of media are moved outwards, so that light meets both surfaces that touch.
            vertices = surfaces.spread_out(1.5 * self.clear_m)
            # Media are searched beyond the range: their bodies stay whole.
            cut_range_m = np.inf if self._media else range_m
            self._static = StaticBodies(scene, vertices, cut_range_m, options)
        else:
            self._static = shared_caster._static
        self._shapes = _shapes(scene.actors, options)
        sizes = [len(actor.mesh.faces) for actor in scene.actors]
        # First triangle of each actor.
        self._actor_triangles = (static_triangles + np.cumsum([0, *sizes[:-1]])).astype(np.int32)

    def move_instances(self, surfaces: Surfaces, instances: Instances, rows: Indices) -> None:
        """Move instances `rows` to their transforms in `instances`; no scan may be under way.

        `surfaces` are the surfaces of the scene with the moved instances.
        """
        self._static.move(instances, rows)
        self._surfaces = surfaces
        self._instances = instances

    def cover(self, positions: Floats) -> None:
        """Build the trees of all bodies in the range of sensors at positions (p, 3), if missing."""
        self._static.cover(positions, self._range_m)

    @property
    def caster(self) -> RayCaster:
        """Caster of the static bodies, of which triangles may be cut or left out."""
        return self._static.trees.caster

    def counters(self) -> tuple[Ints, int]:
        """Return the table of hit counters for `RayCaster.visit`, and the number of counters.

        The table is int64 (bodies, 2): a hit of triangle t of body i counts in the counter
        ``table[i, 0] + table[i, 1] * t``, see `Scene.counters`. The bodies are the faces of the
        scene, if any, with a counter for each triangle; then each instance, with one counter; and
        last all actors as one body, whose triangles are numbered after the scene's faces alone.
        """
        instance_count = 0 if self._instances is None else len(self._instances)
        static_count = self.caster.instance_count - instance_count
        table = [[0, 1]] * static_count + [
            [self._face_count + number, 0] for number in range(instance_count)
        ]
        return np.array([*table, [instance_count, 1]], np.int64), self._surfaces.counters

    @property
    def backend(self) -> str:
        """Name of the backend in use."""
        return self._static.backend

    @property
    def on_device(self) -> bool:
        """Whether hits can stay on a CUDA device."""
        return self._static.on_device

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

        The arguments are those of `RayCaster.scan`; if there are actors, `poses` have a clock.
        `window` are start and stop of the rows of `pattern`, by default all. Hits are at distances
        `t_min` to `t_max`, metres; of each group of rays every n-th is returned, by `keep_every`.
        `groups` are the first rays of the groups. `room` (6, n) receives origins and
        directions of all rays; without actors also (3, n), directions alone.

        Returns
        -------
        ScanReturns
            Ray numbers are from 0 at the window's start. Triangles are numbered as in
            `SceneCaster`, and the tally is by `Surfaces.counter`. With instances or actors,
            `instance` is 0.
        """
        window = (0, len(pattern)) if window is None else window
        if room is None and self._shapes is not None and window[1] - window[0] <= _MAX_ROOM_RAYS:
            room = np.empty((6, window[1] - window[0]))  # so that the rays are computed once
        common: dict[str, Any] = {
            **poses.caster_arguments,
            "window": window,
            "t_min": t_min,
            "t_max": t_max,
            "room": room,
        }
        trees = self._static.trees
        if self._instances is None and self._shapes is None and not trees.origins:
            return trees.caster.scan(
                pattern, **common, keep_every=keep_every, groups=groups, tally=tally
            )
        hits = trees.caster.scan(pattern, **common)
        hits = replace(hits, triangle=trees.numbered(hits))
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
            rows = _rows_to_keep(counts, keep_every)
            ray = ray[rows]
            distance = distance[rows]
            triangle = triangle[rows]
        instance = np.zeros(len(ray), np.int32)  # not needed: triangles tell the instance
        return ScanReturns(ray.astype(np.uint32), distance, triangle, counts, counted, instance)

    def is_visible(
        self,
        origins: Floats,
        towards: Floats,
        distance: Floats,
        times: Floats,
        actor_trajectories: ActorTrajectories,
    ) -> Bools:
        """Return whether points are visible from origins (n, 3), in the scene frame: (n,).

        `towards` are vectors from the origins to the points, (n, 3), of lengths `distance` (n,),
        metres. `times` (n,) are the times of the actors, nanoseconds since the survey's start.
        """
        visible = np.ones(len(distance), np.bool_)
        if len(distance):
            poses = CastPoses(np.zeros(3), clock=Clock(times, np.zeros(1), actor_trajectories))
            hits = self.scan(Pattern(towards / distance[:, None], origins), poses)
            visible[hits.ray] = hits.distance > distance[hits.ray] * (1 - REACHED)
        return visible

    def _with_actors(self, static_hits: ScanReturns, scan: Scan, poses: CastPoses) -> _NearestHits:
        """Return the nearest hits of a scan on static bodies, which are known, and on actors."""
        from . import surface_loops  # not before: numba takes half a second to import

        static_distance = np.full(len(scan), np.inf)
        static_distance[static_hits.ray] = static_hits.distance
        moving, shapes = self._moving_actors(poses)
        nearest = hits_on(moving, scan, poses.times, static_distance)
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
        """Find the nearest hits of rays on actors, whether or not static bodies are nearer."""
        moving, shapes = self._moving_actors(poses)
        ray, distance, actor, instance, triangle = listed_hits_on(moving, scan, poses.times)
        part_triangle = shapes.part_triangles[shapes.shape[actor], instance]
        triangle = triangle + part_triangle + self._actor_triangles[actor]
        return OtherHits(ray.astype(np.uint32), distance, triangle)

    def _moving_actors(self, poses: CastPoses) -> tuple[Moving, _ActorShapes]:
        """Return the actors as moving bodies, and their shapes."""
        shapes = self._shapes
        assert shapes is not None, "without actors"
        trajectories = poses.actor_trajectories

        def frames(actor: Ints, times: Floats) -> Floats:
            """Return the positions in the animations of actors at times, in animation frames."""
            return trajectories.played(actor, times)[0]

        moving = Moving(
            shapes.casters,
            shapes.boxes,
            shapes.shape,
            trajectories.presence_ns,
            trajectories.table,
            frames,
        )
        return moving, shapes


def _rows_to_keep(counts: Ints, keep_every: int) -> Indices:
    """Return the rows of the first and then every n-th hit of groups with `counts` (g,) hits."""
    starts = np.cumsum(counts) - counts
    number_in_group = np.arange(int(counts.sum())) - np.repeat(starts, counts)
    return np.flatnonzero(number_in_group % keep_every == 0)


def _shapes(actors: tuple[Actor, ...], options: dict[str, Any]) -> _ActorShapes | None:
    """Build the casters of the shapes of actors; None without actors.

    `options` are arguments of `RayCaster`.
    """
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
        else RayCaster.from_instances([Instance(mesh_of(part)) for part in mesh_parts], **options)
        for mesh, mesh_parts in zip(meshes, parts, strict=True)
    )
    boxes = np.array([(mesh.animation or mesh).bounds for mesh in meshes])
    return _ActorShapes(casters, boxes, part_triangles, shape)
