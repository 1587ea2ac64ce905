"""The ray caster of a whole scene: the static scene, its instances, and moving actors.

Each ray is transformed to an actor's axes at its own time, so that no tree is ever rebuilt: see
`raybeam.moving`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

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
from ..scene.actors import Actor, shapes_of
from ..scene.scene import Scene
from ..scene.scene_instances import Instances, MeshPart, parts_of
from .actor_trajectories import ActorTrajectories
from .motion import CastPoses, Clock
from .surfaces import Surfaces

AUTO_TAKES = "Backend 'auto' takes one that works."
SHORT = 1e-3  # of the distance: a ray that ends so much before a point has reached it


def check_backend_here(wanted: str, advice: str = AUTO_TAKES) -> None:
    """Refuse a backend that this machine lacks, before a local cluster is started for it."""
    # An interrupt during the import of an extension module would look like a missing one.
    with deferred_interrupts():
        backends = {"auto": "", **available_backends()}
    if wanted not in backends:
        hint = did_you_mean(wanted, backends) or f" There are {', '.join(backends)}."
        raise LidarError(f"There is no backend {wanted!r}.{hint}")
    if backends[wanted]:
        raise LidarError(f"Backend {wanted!r} cannot be used here: {backends[wanted]}. {advice}")


class SceneCaster:
    """Casts scans like `RayCaster.scan`, including hits on actors.

    Triangles of instances are numbered after those of the scene, and those of actors after both.
    Rays that touch no actor give the same bits as without actors. Where the actors are, the poses
    of a scan say. A tally is by the counters of `surfaces`. `options` are those of `RayCaster`. The
    caster of another `like` this one, of the same scene but for actors, is shared.
    """

    def __init__(
        self, scene: Scene, surfaces: Surfaces, like: SceneCaster | None = None, **options: Any
    ) -> None:
        self._surfaces = surfaces
        self._shared = scene.instances
        self._begins: Ints32 | None = None  # of each body of the caster
        self._faces = faces = len(scene.faces)
        if self._shared is not None:
            begins = faces + np.cumsum([0, *self._shared.sizes[:-1]])
            self._begins = np.append([0] * bool(faces), begins).astype(np.int32)
            faces += self._shared.triangles
        # Light continues so far behind a surface, not to hit it again: Embree rounds to a quarter.
        reach = np.float32(np.abs(scene.bounds).max())
        self.clear_m = max(1e-5, 4 * float(np.spacing(reach)))
        self._media = surfaces.media
        if like is None or like._media != self._media:
            vertices = surfaces.spread_out(1.5 * self.clear_m)
            self.caster: RayCaster = _caster_of(scene, vertices, options)
        else:
            self.caster = like.caster
        self._shapes = _shapes(scene.actors, options)
        sizes = [len(actor.mesh.faces) for actor in scene.actors]
        self._firsts = (faces + np.cumsum([0, *sizes[:-1]])).astype(np.int32)  # triangles

    def place(self, surfaces: Surfaces, shared: Instances, rows: Indices) -> None:
        """Move some instances to where they are now; no scan may be under way."""
        first = self.caster.instance_count - len(shared)
        for row in rows:
            self.caster.move(first + int(row), shared.transforms[row])
        self._surfaces = surfaces
        self._shared = shared

    def counters(self) -> tuple[Ints, int]:
        """Return counters of bodies as `RayCaster.visit` takes them, see `Scene.counters`."""
        shared = 0 if self._shared is None else len(self._shared)
        own = self.caster.instance_count - shared
        rows = [[0, 1]] * own + [[self._faces + number, 0] for number in range(shared)]
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
        """See `RayCaster.scan`; the poses have a clock if there are actors."""
        start, stop = (0, len(pattern)) if window is None else window
        common: dict[str, Any] = {
            **poses.caster_arguments, "window": (start, stop), "t_min": t_min, "t_max": t_max, "room": room,
        }  # fmt: skip
        if self._begins is None and self._shapes is None:
            return self.caster.scan(
                pattern, **common, keep_every=keep_every, groups=groups, tally=tally
            )
        found = self.caster.scan(pattern, **common)
        if self._begins is not None:
            found = replace(found, triangle=found.triangle + self._begins[found.instance])
        ray = found.ray.astype(np.int64)
        distance = found.distance
        triangle = found.triangle
        if self._shapes is not None:
            scan = check_scan(pattern, **common)
            ray, distance, triangle = self._with_actors(found, scan, poses)
        begins = np.zeros(1, np.int64) if groups is None else groups
        cuts = np.append(np.searchsorted(ray, begins), len(ray))
        counts = np.diff(cuts)
        counted = None
        if tally:
            counted = np.bincount(
                self._surfaces.counter(triangle), minlength=self._surfaces.counters
            )
        if keep_every > 1:
            place = np.arange(len(ray)) - np.repeat(cuts[:-1], counts)
            kept = np.flatnonzero(place % keep_every == 0)
            ray = ray[kept]
            distance = distance[kept]
            triangle = triangle[kept]
        none = np.zeros(len(ray), np.int32)
        return ScanReturns(ray.astype(np.uint32), distance, triangle, counts, counted, none)

    def free(
        self,
        origins: Floats,
        towards: Floats,
        distance: Floats,
        times: Floats,
        ways: ActorTrajectories,
    ) -> Bools:
        """Whether nothing stands before points (n, 3), seen from origins, at times (n,)."""
        free = np.ones(len(distance), np.bool_)
        if len(distance):
            now = CastPoses(np.zeros(3), clock=Clock(times, np.zeros(1), ways))
            found = self.scan(Pattern(towards / distance[:, None], origins), now)
            free[found.ray] = found.distance > distance[found.ray] * (1 - SHORT)
        return free

    def _with_actors(
        self, found: ScanReturns, scan: Scan, poses: CastPoses
    ) -> tuple[Ints, Floats, Ints32]:
        """Rays, distances and triangles of all hits, those on actors among them."""
        from . import surface_loops  # not before: numba takes half a second to import

        before = np.full(len(scan), np.inf)
        before[found.ray] = found.distance
        on, numbers = self._nearest(scan, poses, before)
        ray = np.empty(len(scan), np.int64)
        distance = np.empty(len(scan))
        triangle = np.empty(len(scan), np.int32)
        given = found.ray, found.triangle, *on, *numbers
        count = surface_loops.merge(*given, ray, distance, triangle)
        return ray[:count], distance[:count], triangle[:count]

    def on_actors(self, scan: Scan, poses: CastPoses) -> OtherHits:
        """Find the nearest hits of rays on actors."""
        hits, (parts, shape, firsts) = self._nearest(scan, poses)
        ray = np.flatnonzero(hits.body >= 0)
        body = hits.body[ray]
        triangle = hits.triangle[ray]
        triangle = triangle + parts[shape[body], hits.instance[ray]] + firsts[body]
        return OtherHits(ray.astype(np.uint32), hits.distance[ray], triangle)

    def _nearest(
        self, scan: Scan, poses: CastPoses, before: Floats | None = None
    ) -> tuple[Nearest, tuple[Ints32, Indices, Ints32]]:
        """Nearest hits on actors, before distances (n,), and what makes their triangles' numbers.

        First triangles of parts, (s, p), shapes (a,) and first triangles (a,) of actors.
        """
        assert self._shapes is not None
        casters, boxes, parts, shape = self._shapes
        ways = poses.actor_trajectories
        frames = lambda body, times: ways.played(body, times)[0]  # noqa: E731
        moving = Moving(casters, boxes, shape, ways.presence_ns, ways.table, frames)
        return hits_on(moving, scan, poses.times, before), (parts, shape, self._firsts)


def _caster_of(scene: Scene, vertices: Floats, options: dict[str, Any]) -> RayCaster:
    """Build the trees of all that stands still, with vertices of the scene's faces."""
    if scene.instances is None:
        return RayCaster(vertices, scene.faces, **options)
    own = [Instance(Mesh(vertices, scene.faces))] if len(scene.faces) else []
    meshes = [_mesh_of(part) for part in scene.instances.parts]
    placed = zip(scene.instances.part, scene.instances.transforms, strict=True)
    return RayCaster.of(
        [*own, *(Instance(meshes[part], matrix) for part, matrix in placed)], **options
    )


def _mesh_of(part: MeshPart) -> Mesh:
    opacity = None if part.mask is None or part.uv is None else Opacity(part.mask, part.uv)
    return Mesh(part.vertices, part.faces, opacity)


def _shapes(
    actors: tuple[Actor, ...], options: dict[str, Any]
) -> tuple[tuple[RayCaster | Deforming, ...], Floats, Ints32, Indices] | None:
    """Shapes of actors: casters, boxes (s, 2, 3), first triangles of parts (s, p), and whose (a,).

    None without actors.
    """
    if not actors:
        return None
    meshes, shape = shapes_of(actors)
    parts = [[*parts_of(mesh)] for mesh in meshes]
    firsts = np.zeros((len(meshes), max(map(len, parts))), np.int32)
    for row, own in zip(firsts, parts, strict=True):
        row[1 : len(own)] = np.cumsum([len(part.faces) for part in own])[:-1]
    casters = tuple(
        Deforming(mesh.animation.vertices, mesh.faces)
        if mesh.animation
        else RayCaster.of([Instance(_mesh_of(part)) for part in own], **options)
        for mesh, own in zip(meshes, parts, strict=True)
    )
    boxes = np.array([(mesh.animation or mesh).bounds for mesh in meshes])
    return casters, boxes, firsts, shape
