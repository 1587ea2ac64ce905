"""What a receiver adds to the returns of its pulses: false alarms, stray light, other pulses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from raybeam import Pattern, any_axes

from ..base.arrays import Bools, Floats, Indices, Integers, Ints, Ints32
from ..base.elementary import arccos, arcsin, arctan2, cos
from ..base.vectors import hypot, into_axes, length, products, turned
from ..scene.colours import GREY, packed
from ..scene.scene import Scene
from ..sensor import Survey
from ..sensor.noise import Purpose
from ..sensor.optics import LIGHT_M_NS
from .crosstalk import Crosstalk
from .hits import BLOOMING, CROSSTALK, FALSE_ALARM, NO_SURFACE, Hits, Keys, joined, numbers
from .motion import Poses
from .paths import Paths
from .surfaces import Surfaces
from .world import World

CELL_RAYS = 1 << 8  # consecutive rays that are compared with retro-reflectors at a time
TRIANGLES_NEAR = 4  # of a cluster are asked where a ray is nearest to them
CLUSTER_M = 1.0  # triangles of retro-reflectors so near to each other are looked for at a time
STRAY_MOST = np.radians(30.0)  # no stray light comes from farther aside
FAINTEST = 0.1  # of the threshold: less is never detected, see `Noise.detected`
INWARDS = 0.02  # of the way to the middle of a triangle: rays to its edge end there, to hit it


def unreal(
    ray: Ints, distance: Floats, energy: Floats, cause: int, *, coloured: bool = False
) -> Hits:
    """Make returns that are from no surface, in the order of rays and distances."""
    order = np.lexsort((distance, ray))
    count = len(ray)
    return Hits(
        ray[order],
        distance[order],
        np.full(count, NO_SURFACE, np.int32),
        energy[order],
        np.full(count, packed(GREY[0])[0]) if coloured else None,
        np.full(count, cause, np.uint8),
    )


def merged(parts: list[Hits]) -> Hits:
    """Join returns, each part in the order of rays and distances, to one in that order."""
    hits = joined(parts)
    return hits.take(np.lexsort((hits.distance, hits.ray)))


class Receiver:
    """Adds false alarms, stray light and pulses of other sensors to the returns of one sensor."""

    def __init__(
        self,
        number: int,
        survey: Survey,
        world: World,
        scene: Scene,
        surfaces: Surfaces,
        paths: Paths,
    ) -> None:
        self._noise = noise = survey.noise_each[number]
        self._sensor = survey.carried[number].sensor
        _, self._gap_m = survey.returns_each[number].of(self._sensor.optics)
        self._world, self._surfaces, self._paths = world, surfaces, paths
        self._alarms = noise.false_alarm_hz > 0
        self._retros = [*_retros(scene, surfaces)] if noise.stray_light else []
        self._others: Crosstalk | None = None
        if noise.crosstalk:
            self._others = Crosstalk(number, survey, world, surfaces)

    @property
    def adds(self) -> bool:
        """Whether it adds anything."""
        return self._alarms or bool(self._retros) or self._others is not None

    def added(
        self,
        returns: Hits,
        keys: Keys,
        rays: Ints,
        beams: Pattern,
        poses: Poses,
        rows: Ints,
        start: int,
    ) -> Hits:
        """Return the detected returns of consecutive rays (n,), and what else is detected.

        `rows` are the rays of `beams` in their middles, from `start` on, as `Poses.rays` takes
        them.
        """
        parts = [returns]
        coloured = returns.colour is not None

        def add(ray: Ints, distance: Floats, energy: Floats, cause: int) -> None:
            parts.append(unreal(ray, distance, energy, cause, coloured=coloured))

        if self._alarms:
            row, since, energy = self._noise.false_alarms(self._sensor.gate_s, *keys.of(rays))
            distance = self._sensor.min_range_m + since * (LIGHT_M_NS * 1e9 / 2)
            add(rays[row], distance, energy, FALSE_ALARM)
        if self._retros or self._others is not None:
            origins, directions = poses.rays(beams, rows, start)
            origins = np.broadcast_to(origins, directions.shape)
            if self._retros:
                times = poses.times(rows)
                found = self._stray(returns, rays, origins, directions, times, poses, keys)
                row, distance, energy = found
                add(rays[row], distance, energy, BLOOMING)
            if self._others is not None:
                own = origins, directions, poses
                row, distance, energy = self._others.received(keys.scan, rays, *own)
                order = np.lexsort((distance, row))
                row, distance, energy = row[order], distance[order], energy[order]
                key = *keys.of(rays[row]), numbers(row)
                seen = self._noise.passes(Purpose.OTHER, energy, *key)
                add(rays[row[seen]], distance[seen], energy[seen], CROSSTALK)
        if sum(len(part.ray) for part in parts) == len(returns.ray):
            return returns
        return merged(parts)

    def _stray(
        self,
        returns: Hits,
        rays: Ints,
        origins: Floats,
        directions: Floats,
        times: Floats,
        poses: Poses,
        keys: Keys,
    ) -> tuple[Indices, Floats, Floats]:
        """Stray light of retro-reflectors that is detected: rows of rays, distances, energies."""
        best = np.zeros(len(rays))
        ends = np.zeros((len(rays), 3))  # seen from the origins
        cells: _Cells | None = None
        actor, turns = None, None
        for retro in self._retros:  # those of an actor follow each other
            if cells is None or retro.actor != actor:
                actor, turns, places = retro.actor, None, np.zeros(3)
                if actor is not None:
                    places, turns = poses.ways[actor].poses(0, times)
                cells = _Cells(into_axes(origins - places, turns), into_axes(directions, turns))
            near = self._near(retro, cells)
            if not len(near):
                continue
            energy, towards = self._leaks(retro, cells.starts[near], cells.ahead[near])
            if turns is not None:  # back to the axes of the scene
                towards = into_axes(towards, turns[near].transpose(0, 2, 1))
            more = energy > best[near]
            best[near[more]], ends[near[more]] = energy[more], towards[more]
        row = np.flatnonzero(best > FAINTEST * self._noise.threshold)
        row = row[self._noise.passes(Purpose.STRAY, best[row], *keys.of(rays[row]))]
        distance = np.sqrt(products(ends[row].T, ends[row].T))
        low, high = self._sensor.min_range_m, self._sensor.max_range_m
        within = (distance >= low) & (distance <= high)
        row, distance = row[within], distance[within]
        seen = self._world.free(origins[row], ends[row], distance, times[row], poses.ways)
        seen &= ~self._beside(returns, rays[row], distance)
        row = row[seen]
        return row, distance[seen], best[row]

    def _near(self, retro: _Retro, cells: _Cells) -> Indices:
        """Rays that may receive enough of the light of a retro-reflector, and perhaps others."""
        centre = retro.middle - cells.begins
        far = np.sqrt(products(centre.T, centre.T))
        radius = retro.radius + cells.moved
        with np.errstate(invalid="ignore", divide="ignore"):
            wide = np.where(far > radius, arcsin(radius / far), np.pi)
            off = arccos(np.clip(products(cells.axes.T, centre.T) / far, -1, 1))
        least = np.maximum(far - radius, max(self._sensor.min_range_m, 1e-3))
        reach = np.minimum(self._reach(retro, least), STRAY_MOST) + wide
        near = np.flatnonzero(~(off > cells.opening + reach)[cells.number])
        # Of those cells, the rays themselves.
        which = cells.number[near]
        centre = retro.middle - cells.starts[near]
        off = products(cells.ahead[near].T, centre.T) / np.sqrt(products(centre.T, centre.T))
        inside = ~(off < cos(np.minimum(reach[which], np.pi)))
        return near[inside]

    def _reach(self, retro: _Retro, distance: Floats) -> Floats:
        """Angles at which the light of a retro-reflector becomes too faint, radians: (n,)."""
        whole = self._whole(np.repeat(retro.triangles[:1], len(distance)), distance)
        share = FAINTEST * self._noise.threshold / np.maximum(whole, 1e-300)
        return np.radians(np.sqrt(self._noise.stray_light / share))

    def _whole(self, triangle: Ints32, distance: Floats) -> Floats:
        """Energies of beams that hit a retro-reflector: (n,)."""
        white = np.full(len(distance), 0xFFFFFFFF, np.uint32)
        return self._paths.energy(triangle, np.ones(len(distance)), distance, white)

    def _leaks(self, retro: _Retro, starts: Floats, ahead: Floats) -> tuple[Floats, Floats]:
        """Energies of stray light in rays (n,), and where it is from, seen from there: (n, 3).

        The light comes from the point of the triangles that is nearest to the ray by angle.
        """
        across, up = (axis.T for axis in any_axes(ahead.T))
        best, ends = np.zeros(len(starts)), np.zeros((len(starts), 3))
        nearest = _first_few(retro, starts, ahead)
        for which in nearest.T:
            towards = retro.corners[which] - starts[:, None]  # (n, 3 corners, 3)
            depth = (towards * ahead[:, None]).sum(axis=2)
            front = (depth > 0).all(axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                # On a plane across the ray, at a distance of 1, angles from it are lengths.
                x = (towards * across[:, None]).sum(axis=2) / depth
                y = (towards * up[:, None]).sum(axis=2) / depth
                off, point = _nearest(x, y, towards, depth)
            middle = towards.mean(axis=1)
            point = point + INWARDS * (middle - point)
            distance = np.sqrt(products(point.T, point.T))
            angle = np.degrees(arctan2(off, 1.0))
            some = np.flatnonzero(front & (angle > 0) & (angle < np.degrees(STRAY_MOST)))
            share = np.minimum(self._noise.stray_light / angle[some] ** 2, 1)
            energy = share * self._whole(retro.triangles[which[some]], distance[some])
            more = energy > best[some]
            best[some[more]], ends[some[more]] = energy[more], point[some[more]]
        return best, ends

    def _beside(self, returns: Hits, ray: Ints, distance: Floats) -> Bools:
        """Whether a ray (n,) has a return of its own that cannot be told from one so far away."""
        first = np.searchsorted(returns.ray, ray, side="left")
        last = np.searchsorted(returns.ray, ray, side="right")
        beside = np.zeros(len(ray), np.bool_)
        for number in range(int((last - first).max(initial=0))):
            some = np.flatnonzero(first + number < last)
            own = returns.distance[first[some] + number]
            beside[some] |= np.abs(own - distance[some]) <= self._gap_m
        return beside


class _Cells:
    """Rays that are fired one after the other, with a cone around those of each cell."""

    def __init__(self, starts: Floats, ahead: Floats) -> None:
        self.starts, self.ahead = starts, ahead
        first = np.arange(0, len(starts), CELL_RAYS)
        self.number = np.arange(len(starts)) // CELL_RAYS  # cells of the rays
        sums = np.add.reduceat(ahead, first, axis=0)
        self.axes = sums / np.maximum(length(sums), 1e-9)[:, None]
        cosine = np.minimum.reduceat(products(self.axes[self.number].T, ahead.T), first)
        self.opening = arccos(np.clip(cosine, -1, 1))
        self.begins = starts[first]
        away = length(starts - self.begins[self.number])
        self.moved = np.maximum.reduceat(away, first)


@dataclass(frozen=True)
class _Retro:
    """Triangles of retro-reflectors that are near to each other."""

    triangles: Ints32  # (k,): their numbers
    corners: Floats  # (k, 3, 3): in the scene's axes, or those of an actor
    actor: int | None = None

    @cached_property
    def middle(self) -> Floats:
        return np.asarray(self.corners.reshape(-1, 3).mean(axis=0))

    @cached_property
    def radius(self) -> float:
        return float(length(self.corners.reshape(-1, 3) - self.middle).max())


def _retros(scene: Scene, surfaces: Surfaces) -> Iterator[_Retro]:
    """Retro-reflectors of a scene, its instances and actors."""
    retro = surfaces.materials.retro
    own = np.flatnonzero(retro[scene.face_object]) if len(scene.faces) else np.zeros(0, np.intp)
    yield from _clusters(own, scene.vertices[scene.faces[own]])
    begin = len(scene.faces)
    shared = scene.instances
    if shared is not None:
        for part, matrix, owner in zip(shared.part, shared.transforms, shared.owner, strict=True):
            mesh = shared.parts[part]
            if retro[owner]:
                vertices = turned(mesh.vertices, matrix[:, :3]) + matrix[:, 3]
                yield from _clusters(begin + np.arange(len(mesh.faces)), vertices[mesh.faces])
            begin += len(mesh.faces)
    for number, actor in enumerate(scene.actors):
        faces = actor.mesh.faces
        if retro[len(scene.names) + number]:
            corners = actor.mesh.vertices[faces]
            yield from _clusters(begin + np.arange(len(faces)), corners, number)
        begin += len(faces)


def _clusters(triangles: Integers, corners: Floats, actor: int | None = None) -> Iterator[_Retro]:
    """Divide triangles into some that are near to each other."""
    if not len(triangles):
        return
    cells = np.floor(corners.mean(axis=1) / CLUSTER_M).astype(np.int64)
    which = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    for number in range(int(which.max()) + 1):
        some = np.flatnonzero(which == number)
        yield _Retro(triangles[some].astype(np.int32), corners[some], actor)


def _first_few(retro: _Retro, starts: Floats, ahead: Floats) -> Indices:
    """Find some triangles whose middles are nearest to rays (n,) by angle: (n, k)."""
    count = len(retro.triangles)
    if count <= TRIANGLES_NEAR:
        return np.broadcast_to(np.arange(count), (len(starts), count))
    middles = retro.corners.mean(axis=1)
    towards = middles[:, None] - starts  # (triangles, n, 3)
    towards = towards.transpose(2, 0, 1)
    cosine = products(towards, ahead.T[:, None]) / np.sqrt(products(towards, towards))
    return np.argsort(-cosine, axis=0, kind="stable")[:TRIANGLES_NEAR].T


def _nearest(x: Floats, y: Floats, corners: Floats, depth: Floats) -> tuple[Floats, Floats]:
    """Distances from 0 of triangles with corners x, y (n, 3) in a plane, and the points there.

    The points are between the `corners` (n, 3, 3), which are seen at x and y, at depths (n, 3). A
    distance is 0 if the triangle lies around 0.
    """
    best = np.full(len(x), np.inf)
    points = np.zeros((len(x), 3))
    inside = np.ones((2, len(x)), np.bool_)
    for one, other in ((0, 1), (1, 2), (2, 0)):
        dx, dy = x[:, other] - x[:, one], y[:, other] - y[:, one]
        turn = x[:, one] * dy - y[:, one] * dx
        inside &= np.stack([turn >= 0, turn <= 0])
        along = -(x[:, one] * dx + y[:, one] * dy) / np.maximum(dx * dx + dy * dy, 1e-300)
        along = np.clip(along, 0, 1)
        off = hypot(x[:, one] + along * dx, y[:, one] + along * dy)
        # A step on the plane is not the same share of the way between the corners.
        far = along * depth[:, one]
        share = far / (far + (1 - along) * depth[:, other])
        point = corners[:, one] + share[:, None] * (corners[:, other] - corners[:, one])
        less = off < best
        best[less], points[less] = off[less], point[less]
    best[inside.any(axis=0)] = 0.0
    return best, points
