"""The ray caster of a whole world: the static scene, its instances, and moving actors.

Each ray is transformed to an actor's axes at its own time, so that no tree is ever rebuilt. Only
rays that come near the actor's bounding sphere are made and cast; the position of the sphere in the
axes of each pose selects them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from raybeam import (
    Instance,
    Mesh,
    Opacity,
    OtherHits,
    Pattern,
    RayCaster,
    ScanReturns,
    available_backends,
)

from ..base.arrays import Bools, Floats, Indices, Ints, Ints32
from ..base.errors import LidarpoolError
from ..base.interrupts import deferred_interrupts
from ..base.words import did_you_mean
from ..scene.actors import shapes_of
from ..scene.scene import Scene
from ..scene.scene_instances import Instances, MeshPart, parts_of
from ..scene.scene_mesh import SceneMesh as ActorMesh
from ..sensor import Trajectory
from ..sensor.trajectory import presence_ns
from .motion import Clock, Poses, into_axes, products
from .surfaces import Surfaces

AUTO_TAKES = "Backend 'auto' takes one that works."
CELL_RAYS = 1 << 10  # rays in a cell of a still sensor, which are fired at nearly one time
CELLS = 64  # cells that share one look at an actor's trajectory
SHORT = 1e-3  # of the distance: a ray that ends so much before a point has reached it
NEAR_M = 1.0  # rays of a cell start no farther than this from its position
TURN = 2e-3  # radians: rays of a cell deviate at most so much from the pattern in its pose


def check_backend_here(wanted: str, advice: str = AUTO_TAKES) -> None:
    """Refuse a backend that this machine lacks, before a local cluster is started for it."""
    # An interrupt during the import of an extension module would look like a missing one.
    with deferred_interrupts():
        backends = {"auto": "", **available_backends()}
    if wanted not in backends:
        hint = did_you_mean(wanted, backends) or f" There are {', '.join(backends)}."
        raise LidarpoolError(f"There is no backend {wanted!r}.{hint}")
    if backends[wanted]:
        raise LidarpoolError(
            f"Backend {wanted!r} cannot be used here: {backends[wanted]}. {advice}"
        )


class World:
    """Casts scans like `RayCaster.scan`, including hits on actors.

    Triangles of instances are numbered after those of the scene, and those of actors after both.
    Rays that touch no actor give the same bits as without actors. Where the actors are, the poses
    of a scan say. A tally is by the counters of `surfaces`. `options` are those of `RayCaster`. The
    caster of another world `like` this one, of the same scene but for actors, is shared.
    """

    def __init__(
        self, scene: Scene, surfaces: Surfaces, like: World | None = None, **options: Any
    ) -> None:
        self._surfaces, self._shared = surfaces, scene.instances
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
        moving, self._shape_of = shapes_of(scene.actors)
        self._shapes = [_Shape(mesh, options) for mesh in moving]
        sizes = [len(actor.mesh.faces) for actor in scene.actors]
        self._firsts = (faces + np.cumsum([0, *sizes[:-1]])).astype(np.int32)  # triangles

    def place(self, surfaces: Surfaces, shared: Instances, rows: Indices) -> None:
        """Move some instances to where they are now; no scan may be under way."""
        first = self.caster.instance_count - len(shared)
        for row in rows:
            self.caster.move(first + int(row), shared.transforms[row])
        self._surfaces, self._shared = surfaces, shared

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
        poses: Poses,
        *,
        window: tuple[int, int] | None = None,
        t_min: float = 0.0,
        t_max: float = np.inf,
        keep_every: int = 1,
        groups: Ints | None = None,
        tally: bool = False,
    ) -> ScanReturns:
        """See `RayCaster.scan`; the poses have a clock if there are actors."""
        start, stop = (0, len(pattern)) if window is None else window
        common: dict[str, Any] = {
            **poses.given, "window": (start, stop), "t_min": t_min, "t_max": t_max
        }  # fmt: skip
        if self._begins is None and not self._shapes:
            return self.caster.scan(
                pattern, **common, keep_every=keep_every, groups=groups, tally=tally
            )
        found = self.caster.scan(pattern, **common)
        if self._begins is not None:
            found = replace(found, triangle=found.triangle + self._begins[found.instance])
        ray, distance, triangle = found.ray.astype(np.int64), found.distance, found.triangle
        if self._shapes:
            window, reach = (start, stop), (t_min, t_max)
            ray, distance, triangle = self._with_actors(found, pattern, poses, window, reach)
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
            ray, distance, triangle = ray[kept], distance[kept], triangle[kept]
        none = np.zeros(len(ray), np.int32)
        return ScanReturns(ray.astype(np.uint32), distance, triangle, counts, counted, none)

    def free(
        self,
        origins: Floats,
        towards: Floats,
        distance: Floats,
        times: Floats,
        ways: tuple[Trajectory, ...],
    ) -> Bools:
        """Whether nothing stands before points (n, 3), seen from origins, at times (n,)."""
        free = np.ones(len(distance), np.bool_)
        if len(distance):
            now = Poses(np.zeros(3), clock=Clock(times, np.zeros(1), ways))
            found = self.scan(Pattern(towards / distance[:, None], origins), now)
            free[found.ray] = found.distance > distance[found.ray] * (1 - SHORT)
        return free

    def _with_actors(
        self,
        found: ScanReturns,
        pattern: Pattern,
        poses: Poses,
        window: tuple[int, int],
        reach: tuple[float, float],
    ) -> tuple[Ints, Floats, Ints32]:
        """Rays, distances and triangles of all hits, those on actors among them."""
        rays = window[1] - window[0]
        distance = np.full(rays, np.inf)
        triangle = np.full(rays, -1, np.int32)
        distance[found.ray], triangle[found.ray] = found.distance, found.triangle
        moving = self.on_actors(pattern, poses, window, reach)
        nearer = moving.distance < distance[moving.ray]
        there = moving.ray[nearer]
        distance[there], triangle[there] = moving.distance[nearer], moving.triangle[nearer]
        ray = np.flatnonzero(triangle >= 0)
        return ray, distance[ray], triangle[ray]

    def on_actors(
        self, pattern: Pattern, poses: Poses, window: tuple[int, int], reach: tuple[float, float]
    ) -> OtherHits:
        """Find the nearest hits of rays on actors, whether something stands before them or not."""
        cells = _Cells(pattern, poses, *window)
        found: list[tuple[Any, ...]] = []
        waiting: list[tuple[int, Indices, tuple[Floats, Floats | None]]] = []
        for number, way in enumerate(poses.ways):
            ray = cells.near(self._shapes[self._shape_of[number]], way, reach[1])
            if not len(ray):
                continue
            times = poses.times(ray)
            first, last = presence_ns(way)
            if first > times.min() or times.max() > last:
                there = (first <= times) & (times <= last)
                ray, times = ray[there], times[there]
            waiting.append((number, ray, way.poses(0, times)))
            # Those of several actors together, because most calls have few rays; all would be many.
            if sum(len(ray) for _, ray, _ in waiting) > window[1] - window[0]:
                found += self._cast_near(waiting, pattern, poses, window[0], reach)
                waiting = []
        found += self._cast_near(waiting, pattern, poses, window[0], reach)
        if not found:
            return OtherHits(np.zeros(0, np.uint32), np.zeros(0), np.zeros(0, np.int32))
        ray, t, face = map(np.concatenate, zip(*found, strict=True))
        order = np.lexsort((t, ray))  # of equal distances, that of the first actor comes first
        order = order[np.diff(ray[order], prepend=-1) > 0]
        return OtherHits(ray[order].astype(np.uint32), t[order], face[order])

    def _cast_near(
        self,
        near: list[tuple[int, Indices, tuple[Floats, Floats | None]]],
        pattern: Pattern,
        poses: Poses,
        start: int,
        reach: tuple[float, float],
    ) -> Iterator[tuple[Any, ...]]:
        """Rays, distances and triangles of hits of rays near actors, each with its number."""
        if not near:
            return
        sizes = [len(ray) for _, ray, _ in near]
        numbers = np.repeat([number for number, _, _ in near], sizes)
        ray = np.concatenate([ray for _, ray, _ in near])
        origins, directions = poses.rays(pattern, ray, start)
        places = np.concatenate([places for *_, (places, _) in near])
        starts, ways = origins - places, directions
        if any(turns is not None for *_, (_, turns) in near):
            turns = [np.eye(3)[None].repeat(n, axis=0) if t is None else t
                     for n, (*_, (_, t)) in zip(sizes, near, strict=True)]  # fmt: skip
            rotations = np.concatenate([t.transpose(1, 2, 0) for t in turns], axis=2)
            rotations = rotations.transpose(2, 0, 1)
            starts, ways = into_axes(starts, rotations), into_axes(directions, rotations)
        for shape in np.unique(self._shape_of[numbers]).tolist():
            own = np.flatnonzero(self._shape_of[numbers] == shape)
            on, distance, triangle = self._shapes[shape].hits(starts[own], ways[own], *reach)
            on = own[on]
            # Directions of a sensor that turns during a pose are not quite of unit length.
            lengths = np.linalg.norm(directions[on], axis=1)
            yield ray[on], distance / lengths, triangle + self._firsts[numbers[on]]


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


class _Cells:
    """Cells of the rays of a scan's window, which start and are fired nearly together."""

    def __init__(self, pattern: Pattern, poses: Poses, start: int, stop: int) -> None:
        self._rays, each, places = stop - start, poses.rays_per_pose, poses.positions
        rotations = None if poses.rotations is None else poses.rotations.reshape(-1, 3, 3)
        self._rotations = rotations
        reach = 0.0 if pattern.origins is None else 2 * float(np.abs(pattern.origins).max())
        apart = each is None and reach > NEAR_M
        self._each = each = 1 if apart else each or CELL_RAYS
        cells = -(-self._rays // each)
        rows = (start + np.arange(cells * each)) % len(pattern)
        if apart and pattern.origins is not None:
            origins = pattern.origins.take(rows, axis=0)
            back = None if rotations is None else rotations.transpose(0, 2, 1)
            places, reach = places + into_axes(origins, back), 0.0
        self._reach = reach
        self._places = np.broadcast_to(places, (cells, 3))
        alike = len(pattern) == each and start % each == 0
        directions = pattern.directions if alike else pattern.directions.take(rows, axis=0)
        self._directions = directions.reshape(-1, each, 3).transpose(2, 0, 1)
        # A cone around the rays of a cell.
        middle = self._directions.mean(axis=2)
        self._axes = middle / np.maximum(np.linalg.norm(middle, axis=0), 1e-9)
        cosines = products(self._axes[:, :, None], self._directions)
        self._opening = np.arccos(np.clip(cosines.min(axis=1, initial=1), -1, 1))
        first = np.arange(0, self._rays, each)
        last = np.minimum(first + each, self._rays) - 1
        self._begins = poses.times(first)
        ends = poses.times(last)
        self._lasts, self._end = (ends - self._begins).max(initial=0), ends.max(initial=0)

    def near(self, actor: _Shape, way: Trajectory, t_max: float) -> Indices:
        """Numbers of the rays that come near an actor; no other ray hits it."""
        if not self._rays:
            return np.zeros(0, np.intp)
        low, high = self._begins.min(), self._begins.max()
        first, last = presence_ns(way)
        if self._end < first or last < low:
            return np.zeros(0, np.intp)
        step = max((high - low) * CELLS / len(self._begins), self._lasts, 1.0)
        times = low + step * np.arange((high - low) // step + 1)
        places, rotations = way.poses(0, np.append(times, self._end))
        places = places + (actor.middle if rotations is None else rotations @ actor.middle)
        between = np.linalg.norm(np.diff(places, axis=0), axis=1).max()
        radius = actor.radius + 2 * between + self._reach + 1e-3
        number = ((self._begins - low) // step).astype(np.intp)
        centre = into_axes(places[number] - self._places, self._rotations).T
        far = np.sqrt(products(centre, centre))
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = np.where(far > radius, np.arcsin(radius / far), np.pi) + TURN
            off = np.arccos(np.clip(products(self._axes, centre) / far, -1, 1))
        cell = np.flatnonzero((far <= t_max + radius) & ~(off > self._opening + seen))
        directions = self._directions
        if directions.shape[1] > 1:
            directions = directions[:, cell]
        along = products(centre[:, cell, None], directions)
        least = far[cell] * np.cos(np.minimum(seen[cell], np.pi))
        found = np.flatnonzero(along >= least[:, None])
        ray = cell[found // self._each] * self._each + found % self._each
        return ray[ray < self._rays]


class _Shape:
    """A mesh of actors with its ray caster, and the bounding sphere of its vertices."""

    def __init__(self, mesh: ActorMesh, options: dict[str, Any]) -> None:
        parts = [*parts_of(mesh)]
        self._caster = RayCaster.of([Instance(_mesh_of(part)) for part in parts], **options)
        sizes = [len(part.faces) for part in parts]
        self._parts = np.cumsum([0, *sizes[:-1]]).astype(np.int32)
        self.middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        self.radius = float(np.linalg.norm(mesh.vertices - self.middle, axis=1).max())

    def hits(
        self, origins: Floats, directions: Floats, t_min: float, t_max: float
    ) -> tuple[Indices, Floats, Ints32]:
        """Hits on it of rays (m, 3) in its own axes.

        Returns
        -------
        Numbers of the rays that hit (h,), distances, and triangles.
        """
        hits = self._caster.cast(origins, directions, t_min, t_max)
        on = np.flatnonzero(hits.hit)
        return on, hits.distance[on], hits.triangle[on] + self._parts[hits.instance[on]]
