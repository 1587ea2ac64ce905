"""Cast rays against the faces, the instances and the moving actors of a scene.

Each ray is transformed into the frame of an actor at the firing time of the ray, so trees are never
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

from ..environment.interrupts import defer_interrupts
from ..errors import LidarError
from ..numerics.arrays import Bools, Floats, Indices, Ints, Ints32
from ..scene.actors import Actor, distinct_meshes
from ..scene.scene import Scene
from ..scene.scene_instances import Instances, split_by_masks
from ..survey.survey import Survey
from ..words import did_you_mean
from .actor_trajectories import ActorTrajectories
from .motion import CastPoses, FiringClock
from .static_bodies import StaticBodies, largest_range_m, mesh_of
from .surfaces import SceneSurfaces
from .visibility import static_key, unseen_objects

AUTO_ADVICE = "The backend 'auto' selects one that is available."
_MAX_ROOM_RAYS = 1 << 18  # maximum number of rays that are stored for both casts: 13 MB
NEVER_NS = np.array([np.inf, -np.inf])  # presence of an actor that is never in the scene
REACHED = 1e-3  # a ray reaches a point if it gets this close, as a fraction of the distance


class _NearestHits(NamedTuple):
    """Nearest hits of the k rays that hit something, sorted by ray."""

    ray: Ints  # ray number, counted from the start of the window
    distance: Floats  # meters
    triangle: Ints32


class _ActorShapes(NamedTuple):
    """Distinct shapes of the actors in a scene.

    There are s shapes of a actors, because actors with the same mesh share a shape. A mesh has a
    part for its opaque triangles and a part for each mask (`split_by_masks`). Each part is an
    instance in the shape's caster.
    """

    casters: tuple[RayCaster | DeformingMesh, ...]  # (s,): in the mesh frame
    boxes: Floats  # (s, 2, 3): bounds of the shapes over all animation frames, meters
    part_triangles: Ints32  # (s, p): first triangle of each part, numbered within its mesh
    shape: Indices  # (a,): shape of each actor


class CastBodies(NamedTuple):
    """Trees of the static bodies of a scene, and the shapes of its actors."""

    static: StaticBodies
    key: tuple[object, ...]  # identifies the static bodies within a scene
    shapes: _ActorShapes | None  # None without actors


def check_backend_here(backend: str, advice: str = AUTO_ADVICE) -> None:
    """Raise LidarError if a backend is not available on this machine.

    The error message ends with `advice`.
    """
    # An interrupt during the import of an extension module would look like a missing module.
    with defer_interrupts():
        backends = {"auto": "", **available_backends()}
    if backend not in backends:
        hint = did_you_mean(backend, backends) or f" Available backends: {', '.join(backends)}."
        raise LidarError(f"Unknown backend {backend!r}.{hint}")
    if backends[backend]:
        raise LidarError(f"Backend {backend!r} cannot be used: {backends[backend]}. {advice}")


class SceneCaster:
    """Ray caster of a scene, which extends `RayCaster.scan` with hits on actors.

    Triangles of instances are numbered after the faces of the scene, and triangles of actors after
    both. Rays that hit no actor return bit-identical results with and without actors. The poses of
    a scan include the trajectories of the actors. Use `casters_of_sensors` to create the casters of
    a survey.

    Parameters
    ----------
    scene
        Faces, instances and actors to cast rays at.
    surfaces
        Surfaces of the scene, whose `StoredTriangles.counter` defines the hit counters.
    bodies
        Trees of the static bodies, and shapes of the actors.
    range_m
        Largest range of the sensors in meters. In a scene of hundreds of kilometers, bodies far
        beyond this range are omitted. Call `ensure_trees` before each scan.
    unseen
        (objects,): True for objects that rays pass through. `bodies` does not contain the static
        objects among them. None if all objects are visible.
    """

    def __init__(
        self,
        scene: Scene,
        surfaces: SceneSurfaces,
        bodies: CastBodies,
        range_m: float = np.inf,
        unseen: Bools | None = None,
    ) -> None:
        self.bodies = bodies
        self.unseen = unseen
        # Casters of all sensors of the survey by sensor number, set by `casters_of_sensors`.
        self.by_sensor: Sequence[SceneCaster] = ()
        self.clear_m = _clearance_m(scene)
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

    def update_instances(self, surfaces: SceneSurfaces, instances: Instances) -> None:
        """Replace the surfaces and instances after instances in the scene have moved.

        The trees are not updated. To update them, use the function `move_instances`.
        """
        self._surfaces = surfaces
        self._instances = instances

    def ensure_trees(self, positions: Floats) -> None:
        """Build missing trees of bodies within range of sensors at the given positions."""
        self._static.ensure_trees(positions, self._range_m)

    @property
    def caster(self) -> RayCaster:
        """Caster of the static bodies, some of whose triangles may be clipped or omitted."""
        return self._static.trees.caster

    def counters(self) -> tuple[Ints, int]:
        """Return the counter table for `RayCaster.scan_on_device`, and the number of counters.

        The table is an int64 array (bodies, 2). A hit on triangle t of body i increments counter
        ``table[i, 0] + table[i, 1] * t`` (`Scene.counters`). The bodies are the faces of the scene,
        if any, with one counter per triangle, followed by each instance with a single counter, and
        finally by all actors as one body, whose triangles are numbered after the faces of the
        scene. Bodies that the caster omits have no row.
        """
        instance_count = 0 if self._instances is None else len(self._instances)
        table = [[0, 1]] * bool(self._face_count) + [
            [self._face_count + number, 0] for number in range(instance_count)
        ]
        counters = np.array([*table, [instance_count, 1]], np.int64)
        return counters[self.body_rows], self._surfaces.triangles.counters

    @property
    def body_rows(self) -> Indices:
        """Rows of this caster's bodies in `StoredTriangles.bodies`.

        These are the faces of the scene, the instances that are cast, and all actors as one body.
        Static bodies that no ray can hit are omitted.
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
        """Whether hits can remain in the memory of a CUDA device."""
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
        """Cast the rays of a pattern against static bodies and actors.

        The arguments are those of `RayCaster.scan`. If there are actors, `poses` must have a clock.
        `window` has the start and stop of the pattern rows to cast, by default all rows. Hits are
        accepted at distances from `t_min` to `t_max` in meters. Of each group of rays, every
        `keep_every`-th hit is returned. `groups` contains the first ray of each group. The origins
        and directions of all rays are written to `out` (6, n). Without actors, `out` can also have
        shape (3, n) and then receives only directions.

        Returns
        -------
        ScanReturns
            Rays are numbered from 0 at the start of the window. Triangles are numbered as described
            in `SceneCaster`, and the tally as in `StoredTriangles.counter`. With instances or
            actors, `instance` is 0.
        """
        window = (0, len(pattern)) if window is None else window
        if out is None and self._shapes is not None and window[1] - window[0] <= _MAX_ROOM_RAYS:
            out = np.empty((6, window[1] - window[0]))  # computes the rays only once
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
        hits = replace(hits, triangle=trees.to_scene_triangles(hits))
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
        instance = np.zeros(len(ray), np.int32)  # not needed, because triangles imply instances
        return ScanReturns(ray.astype(np.uint32), distance, triangle, counts, counted, instance)

    def is_visible(
        self,
        origins: Floats,
        towards: Floats,
        distance: Floats,
        times: Floats,
        actor_trajectories: ActorTrajectories,
    ) -> Bools:
        """Return whether each point is visible from its origin in the scene frame.

        `towards` (n, 3) are vectors from the origins to the points, and `distance` (n,) their
        lengths in meters. `times` (n,) determine the poses of actors, in nanoseconds since the
        start of the survey.
        """
        visible = np.ones(len(distance), np.bool_)
        if len(distance):
            poses = CastPoses(
                np.zeros(3), clock=FiringClock(times, np.zeros(1), actor_trajectories)
            )
            hits = self.scan(Pattern(towards / distance[:, None], origins), poses)
            visible[hits.ray] = hits.distance > distance[hits.ray] * (1 - REACHED)
        return visible

    def _with_actors(self, static_hits: ScanReturns, scan: Scan, poses: CastPoses) -> _NearestHits:
        """Merge a scan's hits on static bodies with hits on actors.

        Each ray keeps the nearest hit.
        """
        from . import surface_loops  # imported here because numba takes half a second to import

        static_distance = np.full(len(scan), np.inf)
        static_distance[static_hits.ray] = static_hits.distance
        moving, shapes = self._moving_actors(poses)
        nearest = nearest_body_hits(moving, scan, poses.times, static_distance)
        joined = surface_loops.JoinedHits(
            np.empty(len(scan), np.int64), np.empty(len(scan)), np.empty(len(scan), np.int32)
        )
        count = surface_loops.merge_hits(
            static_hits.ray,
            static_hits.triangle,
            nearest,
            surface_loops.ActorTriangles(
                shapes.part_triangles, shapes.shape, self._actor_triangles
            ),
            joined,
        )
        return _NearestHits(joined.ray[:count], joined.distance[:count], joined.triangle[:count])

    def find_actor_hits(self, scan: Scan, poses: CastPoses) -> ExternalHits:
        """Find the nearest hit of each ray on an actor, even if static bodies are closer."""
        if self._shapes is None:
            return ExternalHits(np.zeros(0, np.uint32), np.zeros(0), np.zeros(0, np.int32))
        moving, shapes = self._moving_actors(poses)
        ray, distance, actor, instance, triangle = body_hits(moving, scan, poses.times)
        part_triangle = shapes.part_triangles[shapes.shape[actor], instance]
        triangle = triangle + part_triangle + self._actor_triangles[actor]
        return ExternalHits(ray.astype(np.uint32), distance, triangle)

    def rays_on_actor(self, actor: int, scan: Scan, poses: CastPoses) -> Ints:
        """Return the rays of a scan that would hit an actor if nothing else were in the scene."""
        moving, _ = self._moving_actors(poses)

        def table(body: Ints, times: Floats) -> Floats:
            return moving.poses(np.full(len(body), actor), times)

        def frames(body: Ints, times: Floats) -> Floats:
            assert moving.frames is not None
            return moving.frames(np.full(len(body), actor), times)

        alone = replace(
            moving,
            shape=moving.shape[[actor]],
            presence=moving.presence[[actor]],
            poses=table,
            frames=frames,
        )
        return body_hits(alone, scan, poses.times).ray.astype(np.int64)

    def _moving_actors(self, poses: CastPoses) -> tuple[MovingBodies, _ActorShapes]:
        """Return the actors as moving bodies, together with their shapes."""
        shapes = self._shapes
        assert shapes is not None, "without actors"
        trajectories = poses.actor_trajectories

        def frames(actor: Ints, times: Floats) -> Floats:
            return trajectories.animation_frames(actor, times)[0]

        presence_ns = trajectories.presence_ns
        if self._unseen_actors is not None:
            presence_ns = np.where(self._unseen_actors[:, None], NEVER_NS, presence_ns)
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
    surfaces: SceneSurfaces,
    known: Iterable[SceneCaster] = (),
    **options: Any,
) -> tuple[SceneCaster, ...]:
    """Return a caster for each sensor of a survey, shared by sensors that see the same objects.

    Parameters
    ----------
    scene
        Faces, instances and actors to cast rays at.
    survey
        Survey whose sensors need casters.
    surfaces
        Surfaces of the scene.
    known
        Casters of the same scene, possibly with different actors. Their trees of static bodies are
        reused if the same surfaces enclose media and the same static objects are unseen.
    options
        Arguments of `RayCaster`.

    Raises
    ------
    LidarError
        If a sensor lists an unseen object that is not in the scene.
    """
    range_m = largest_range_m(survey)
    media = surfaces.media_bodies.static_kinds
    shapes = _shapes(scene.actors, options)
    static_bodies = {caster.bodies.key: caster.bodies.static for caster in known}

    @cache
    def vertices() -> Floats:
        # Surfaces of media are moved outward so that light hits both of two touching surfaces.
        return surfaces.media_bodies.offset_vertices(1.5 * _clearance_m(scene))

    def bodies_without(unseen: Bools | None) -> CastBodies:
        """Return the scene's bodies, except the static objects that a mask marks as unseen."""
        objects = static_key(scene, unseen)
        key = media, objects
        if key not in static_bodies:
            # Light in media can travel beyond the range, so their bodies must stay whole.
            cut_range_m = np.inf if media else range_m
            unseen_static = unseen[: len(scene.names)] if objects and unseen is not None else None
            static_bodies[key] = StaticBodies(
                scene, vertices(), cut_range_m, options, unseen_static
            )
        return CastBodies(static_bodies[key], key, shapes)

    casters: dict[bytes, SceneCaster] = {}  # {unseen objects: caster}
    by_sensor = []
    for unseen in unseen_objects(scene, survey):
        key = b"" if unseen is None else unseen.tobytes()
        if key not in casters:
            bodies = bodies_without(unseen)
            casters[key] = SceneCaster(scene, surfaces, bodies, range_m, unseen)
        by_sensor.append(casters[key])
    for caster in casters.values():
        caster.by_sensor = by_sensor
    return tuple(by_sensor)


def move_instances(
    casters: Sequence[SceneCaster],
    surfaces: SceneSurfaces,
    instances: Instances,
    instance_indices: Indices,
) -> None:
    """Move instances in the casters to their new transforms.

    No scan may be in progress.

    Parameters
    ----------
    casters
        Casters of the sensors of a survey.
    surfaces, instances
        Surfaces and instances of the scene after the move.
    instance_indices
        (m,): rows of the instances that have moved.
    """
    for static in dict.fromkeys(caster.bodies.static for caster in casters):
        static.move_instances(instances, instance_indices)
    for caster in dict.fromkeys(casters):
        caster.update_instances(surfaces, instances)


def _clearance_m(scene: Scene) -> float:
    """Return the distance in meters behind a surface at which transmitted light continues.

    At this distance, rounding the ray's start cannot make the ray hit the same surface again.
    """
    reach = np.float32(np.abs(scene.bounds).max())
    return max(1e-5, 4 * float(np.spacing(reach)))


def _rows_to_keep(counts: Ints, keep_every: int) -> Indices:
    """Return the indices of every n-th row in each group, starting with its first row."""
    starts = np.cumsum(counts) - counts
    number_in_group = np.arange(int(counts.sum())) - np.repeat(starts, counts)
    return np.flatnonzero(number_in_group % keep_every == 0)


def _shapes(actors: tuple[Actor, ...], options: dict[str, Any]) -> _ActorShapes | None:
    """Build the casters of the actors' shapes. Return None if there are no actors.

    `options` are arguments of `RayCaster`.
    """
    if not actors:
        return None
    meshes, shape = distinct_meshes(actor.mesh for actor in actors)
    parts_of_meshes = [[*split_by_masks(mesh)] for mesh in meshes]
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
