"""The ray caster of a whole scene: the static scene, its instances, and moving actors.

Each ray is transformed to the frame of an actor at the time of the ray, so that no tree is ever
rebuilt (`raybeam.moving`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from raybeam import (
    DeformingMesh,
    Instance,
    MovingBodies,
    Pattern,
    RayCaster,
    ScanReturns,
    available_backends,
)
from raybeam.device import ExternalHits
from raybeam.moving import body_hits, nearest_body_hits
from raybeam.scan import Scan, check_scan

from ...base.arrays import Bools, Floats, Indices, Ints, Ints32
from ...base.errors import LidarError
from ...base.interrupts import deferred_interrupts
from ...base.words import did_you_mean
from ...scene.actors import Actor, distinct_meshes
from ...scene.scene import Scene
from ...scene.scene_instances import Instances, parts_of
from ...survey.survey import Survey
from .actor_trajectories import ActorTrajectories
from .motion import CastPoses, Clock
from .static_bodies import StaticBodies, largest_range_m, mesh_of
from .surfaces import Surfaces
from .visibility import static_key, unseen_objects

AUTO_TAKES = "The backend 'auto' selects one that is available."
_MAX_ROOM_RAYS = 1 << 18  # rays that are stored for casts on static bodies and on actors: 13 MB
_NEVER_NS = np.array([np.inf, -np.inf])  # first and last time of an actor that is never present
REACHED = 1e-3  # share of a distance: a ray that ends this close before a point reaches the point


class _NearestHits(NamedTuple):
    """Nearest hits of the rays that hit: arrays (k,), in the order of rays."""

    ray: Ints  # number of the ray, from 0 at the window's start
    distance: Floats  # meters
    triangle: Ints32


class _ActorShapes(NamedTuple):
    """The s shapes of the a actors of a scene, where actors of the same mesh share a shape.

    A mesh has a part for its opaque triangles, and a part for each mask (`parts_of`); a part is
    an instance of the shape's caster.
    """

    casters: tuple[RayCaster | DeformingMesh, ...]  # (s,): in the frame of the mesh
    boxes: Floats  # (s, 2, 3): bounds of the shapes in all frames of animations, meters
    part_triangles: Ints32  # (s, p): first triangle of each part, among the triangles of its mesh
    shape: Indices  # (a,): shape of each actor


class CastBodies(NamedTuple):
    """Trees of the static bodies of a scene, and shapes of its actors."""

    static: StaticBodies
    key: tuple[object, ...]  # static bodies of the same scene with the same key are the same
    shapes: _ActorShapes | None  # None without actors


def check_backend_here(backend: str, advice: str = AUTO_TAKES) -> None:
    """Raise LidarError if this machine lacks a backend of casting, with `advice` at the end."""
    # An interrupt during the import of an extension module would look like a missing module.
    with deferred_interrupts():
        backends = {"auto": "", **available_backends()}
    if backend not in backends:
        hint = did_you_mean(backend, backends) or f" Available backends: {', '.join(backends)}."
        raise LidarError(f"Unknown backend {backend!r}.{hint}")
    if backends[backend]:
        raise LidarError(f"Backend {backend!r} cannot be used: {backends[backend]}. {advice}")


class SceneCaster:
    """Casts scans like `RayCaster.scan`, including hits on actors.

    Triangles of instances are numbered after the faces of the scene, triangles of actors after
    both. Rays that touch no actor give the same bits as without actors. The poses of a scan have
    the trajectories of the actors. `casters_of_sensors` makes the casters of a survey.

    Parameters
    ----------
    scene
        Faces, instances and actors to hit.
    surfaces
        Surfaces of the scene; a tally counts hits by `StoredTriangles.counter`.
    bodies
        Trees of the static bodies and shapes of the actors.
    range_m
        Largest range of the sensors, meters: of a scene of hundreds of kilometers, what is far
        beyond the range is left out. Before scans, `cover` says where sensors are.
    unseen
        (objects,): True for objects that rays pass through; `bodies` lacks the static objects among
        them. None for no object.
    """

    def __init__(
        self,
        scene: Scene,
        surfaces: Surfaces,
        bodies: CastBodies,
        range_m: float = np.inf,
        unseen: Bools | None = None,
    ) -> None:
        self.bodies = bodies
        self.unseen = unseen
        # Casters of all sensors of the survey, by their numbers; set by `casters_of_sensors`.
        self.of_sensors: Sequence[SceneCaster] = ()
        self.clear_m = _clear_m(scene)
        self._surfaces = surfaces
        self._instances = scene.instances
        self._face_count = static_triangles = len(scene.faces)
        if self._instances is not None:
            static_triangles += self._instances.triangles
        self._range_m = range_m
        self._static = bodies.static
        self._shapes = bodies.shapes
        self._unseen_actors: Bools | None = None
        if unseen is not None and unseen[len(scene.names) :].any():
            self._unseen_actors = unseen[len(scene.names) :]
            if self._unseen_actors.all():
                self._shapes = None
        sizes = [len(actor.mesh.faces) for actor in scene.actors]
        # First triangle of each actor.
        self._actor_triangles = (static_triangles + np.cumsum([0, *sizes[:-1]])).astype(np.int32)

    def with_moved_instances(self, surfaces: Surfaces, instances: Instances) -> None:
        """Take surfaces and instances from the scene with moved instances.

        `move_instances` moves the trees.
        """
        self._surfaces = surfaces
        self._instances = instances

    def cover(self, positions: Floats) -> None:
        """Build the trees of all bodies in the range of sensors at positions (p, 3), if missing."""
        self._static.cover(positions, self._range_m)

    @property
    def caster(self) -> RayCaster:
        """Caster of the static bodies, with some triangles cut or left out."""
        return self._static.trees.caster

    def counters(self) -> tuple[Ints, int]:
        """Return the counter table for `RayCaster.scan_on_device`, and the number of counters.

        The table is int64 (bodies, 2): a hit of triangle t of body i counts in the counter
        ``table[i, 0] + table[i, 1] * t`` (`Scene.counters`). The bodies are the faces of the
        scene, if any, with a counter for each triangle; then each instance, with one counter; and
        last all actors as one body, whose triangles are numbered after the scene's faces alone.
        Bodies that the caster leaves out have no row.
        """
        instance_count = 0 if self._instances is None else len(self._instances)
        table = [[0, 1]] * bool(self._face_count) + [
            [self._face_count + number, 0] for number in range(instance_count)
        ]
        counters = np.array([*table, [instance_count, 1]], np.int64)
        return counters[self.body_rows], self._surfaces.triangles.counters

    @property
    def body_rows(self) -> Indices:
        """Rows in `StoredTriangles.bodies` of instances that are cast, and of all actors.

        Shape (instances + 1,). The static bodies that no ray hits are missing.
        """
        trees = self._static.trees
        first_instance = min(1, self._face_count)
        last = first_instance + (0 if self._instances is None else len(self._instances))
        return np.concatenate(
            [np.arange(trees.face_bodies), first_instance + trees.instance_indices, [last]]
        )

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
        out: Floats | None = None,
    ) -> ScanReturns:
        """Cast rays of a pattern as `RayCaster.scan`, at actors too.

        The arguments are as in `RayCaster.scan`; if there are actors, `poses` have a clock.
        `window` are start and stop of the rows of `pattern`, by default all. Hits are at distances
        `t_min` to `t_max`, meters; of each group of rays every n-th is returned, by `keep_every`.
        `groups` are the first rays of the groups. `out` (6, n) receives origins and
        directions of all rays; without actors also (3, n), directions alone.

        Returns
        -------
        ScanReturns
            Ray numbers are from 0 at the window's start. Triangles are numbered as in
            `SceneCaster`, and the tally is by `StoredTriangles.counter`. With instances or actors,
            `instance` is 0.
        """
        window = (0, len(pattern)) if window is None else window
        if out is None and self._shapes is not None and window[1] - window[0] <= _MAX_ROOM_RAYS:
            out = np.empty((6, window[1] - window[0]))  # so that the rays are computed once
        common: dict[str, Any] = {
            **poses.caster_arguments,
            "window": window,
            "t_min": t_min,
            "t_max": t_max,
            "out": out,
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
            counted = self._surfaces.triangles.count(triangle)
        if keep_every > 1:
            row_indices = _rows_to_keep(counts, keep_every)
            ray = ray[row_indices]
            distance = distance[row_indices]
            triangle = triangle[row_indices]
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
        meters. `times` (n,) are the times of the actors, nanoseconds since the survey's start.
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
        nearest = nearest_body_hits(moving, scan, poses.times, static_distance)
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

    def on_actors(self, scan: Scan, poses: CastPoses) -> ExternalHits:
        """Find the nearest hits of rays on actors, whether or not static bodies are nearer."""
        if self._shapes is None:
            return ExternalHits(np.zeros(0, np.uint32), np.zeros(0), np.zeros(0, np.int32))
        moving, shapes = self._moving_actors(poses)
        ray, distance, actor, instance, triangle = body_hits(moving, scan, poses.times)
        part_triangle = shapes.part_triangles[shapes.shape[actor], instance]
        triangle = triangle + part_triangle + self._actor_triangles[actor]
        return ExternalHits(ray.astype(np.uint32), distance, triangle)

    def _moving_actors(self, poses: CastPoses) -> tuple[MovingBodies, _ActorShapes]:
        """Return the actors as moving bodies, and their shapes."""
        shapes = self._shapes
        assert shapes is not None, "without actors"
        trajectories = poses.actor_trajectories

        def frames(actor: Ints, times: Floats) -> Floats:
            """Return the positions in the animations of actors at times, in animation frames."""
            return trajectories.played(actor, times)[0]

        presence_ns = trajectories.presence_ns
        if self._unseen_actors is not None:
            presence_ns = np.where(self._unseen_actors[:, None], _NEVER_NS, presence_ns)
        moving = MovingBodies(
            shapes.casters,
            shapes.boxes,
            shapes.shape,
            presence_ns,
            trajectories.table,
            frames,
        )
        return moving, shapes


def casters_of_sensors(
    scene: Scene,
    survey: Survey,
    surfaces: Surfaces,
    known: Iterable[SceneCaster] = (),
    **options: Any,
) -> tuple[SceneCaster, ...]:
    """Return the casters of the sensors of a survey, shared by sensors that see the same objects.

    Parameters
    ----------
    scene
        Faces, instances and actors to hit.
    survey
        The sensors.
    surfaces
        Surfaces of the scene.
    known
        Casters of the same scene, possibly with other actors. Their trees of static bodies are
        shared if the same surfaces enclose media, and if the same static objects are unseen.
    options
        Arguments of `RayCaster`.

    Raises
    ------
    LidarError
        If a sensor does not see an object that is not in the scene.
    """
    range_m = largest_range_m(survey)
    media = surfaces.media_bodies.static_kinds
    shapes = _shapes(scene.actors, options)
    static_bodies = {caster.bodies.key: caster.bodies.static for caster in known}

    @cache
    def vertices() -> Floats:
        # Surfaces of media are moved outwards, so that light meets both surfaces that touch.
        return surfaces.media_bodies.spread_out(1.5 * _clear_m(scene))

    def bodies_without(unseen: Bools | None) -> CastBodies:
        """Return the bodies of the scene without the static objects of a mask (objects,)."""
        objects = static_key(scene, unseen)
        key = media, objects
        if key not in static_bodies:
            # Media are searched beyond the range: their bodies stay whole.
            cut_range_m = np.inf if media else range_m
            unseen_static = unseen[: len(scene.names)] if objects and unseen is not None else None
            static_bodies[key] = StaticBodies(
                scene, vertices(), cut_range_m, options, unseen_static
            )
        return CastBodies(static_bodies[key], key, shapes)

    casters: dict[bytes, SceneCaster] = {}  # {unseen objects: caster}
    of_sensors = []
    for unseen in unseen_objects(scene, survey):
        key = b"" if unseen is None else unseen.tobytes()
        if key not in casters:
            bodies = bodies_without(unseen)
            casters[key] = SceneCaster(scene, surfaces, bodies, range_m, unseen)
        of_sensors.append(casters[key])
    for caster in casters.values():
        caster.of_sensors = of_sensors
    return tuple(of_sensors)


def move_instances(
    casters: Sequence[SceneCaster],
    surfaces: Surfaces,
    instances: Instances,
    instance_indices: Indices,
) -> None:
    """Move instances to their transforms in `instances`, while no scan is under way.

    Parameters
    ----------
    casters
        Casters of the sensors of a survey.
    surfaces, instances
        Of the scene with the moved instances.
    instance_indices
        (m,): rows of the instances that have moved.
    """
    for static in dict.fromkeys(caster.bodies.static for caster in casters):
        static.move(instances, instance_indices)
    for caster in dict.fromkeys(casters):
        caster.with_moved_instances(surfaces, instances)


def _clear_m(scene: Scene) -> float:
    """Return the distance behind a surface at which light continues, meters.

    At this distance a ray does not hit the surface again, wherever its start is rounded to.
    """
    reach = np.float32(np.abs(scene.bounds).max())
    return max(1e-5, 4 * float(np.spacing(reach)))


def _rows_to_keep(counts: Ints, keep_every: int) -> Indices:
    """Return the rows of the first and then every n-th hit of groups with `counts` (g,) hits."""
    starts = np.cumsum(counts) - counts
    number_in_group = np.arange(int(counts.sum())) - np.repeat(starts, counts)
    return np.flatnonzero(number_in_group % keep_every == 0)


def _shapes(actors: tuple[Actor, ...], options: dict[str, Any]) -> _ActorShapes | None:
    """Build the casters of the shapes of actors, or return None without actors.

    `options` are arguments of `RayCaster`.
    """
    if not actors:
        return None
    meshes, shape = distinct_meshes(actors)
    parts_of_meshes = [[*parts_of(mesh)] for mesh in meshes]
    part_triangles = np.zeros((len(meshes), max(map(len, parts_of_meshes))), np.int32)
    for row, mesh_parts in zip(part_triangles, parts_of_meshes, strict=True):
        row[1 : len(mesh_parts)] = np.cumsum([len(part.faces) for part in mesh_parts])[:-1]
    casters = tuple(
        DeformingMesh(mesh.animation.vertices, mesh.faces)
        if mesh.animation
        else RayCaster.from_instances([Instance(mesh_of(part)) for part in mesh_parts], **options)
        for mesh, mesh_parts in zip(meshes, parts_of_meshes, strict=True)
    )
    boxes = np.array([(mesh.animation or mesh).bounds for mesh in meshes])
    return _ActorShapes(casters, boxes, part_triangles, shape)
