"""What a receiver adds to the returns of its pulses: false alarms, stray light, other pulses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np

from raybeam import Pattern

from ..base.arrays import Bools, Floats, Indices, Integers, Ints, Ints32, owned
from ..base.vectors import into_axes, length, products, turned
from ..scene.colours import GREY, packed
from ..scene.scene import Scene
from ..sensor import Survey
from ..sensor.noise import Purpose
from ..sensor.optics import LIGHT_M_NS
from .crosstalk import Crosstalk
from .hits import BLOOMING, CROSSTALK, FALSE_ALARM, NO_SURFACE, Hits, Keys, joined, numbers
from .motion import Poses
from .surfaces import Surfaces, light_of
from .world import World

CLUSTER_M = 1.0  # triangles of retro-reflectors so near to each other are looked for at a time
FAINTEST = 0.1  # of the threshold: less is never detected, see `Noise.detected`


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
    ) -> None:
        self._noise = noise = survey.noise_each[number]
        self._sensor = survey.carried[number].sensor
        _, self._gap_m = survey.returns_each[number].of(self._sensor.optics)
        self._world, self._surfaces = world, surfaces
        self._light = light_of(survey, self._sensor)
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
        from . import stray_loops  # not before: numba takes half a second to import

        best, ends = np.zeros(len(rays)), np.zeros((len(rays), 3))  # seen from the origins
        noise, extinction = self._noise, self._light.extinction
        limits = self._sensor.min_range_m, noise.stray_light, FAINTEST * noise.threshold, extinction
        for actor, retros in groupby(self._retros, key=lambda retro: retro.actor):
            turns, places = None, np.zeros(3)
            if actor is not None:
                places, turns = poses.ways[actor].poses(0, times)
            seen = into_axes(origins - places, turns), into_axes(directions, turns)
            beams = [owned(vectors.T) for vectors in seen]
            cells = np.empty((-(-len(rays) // stray_loops.CELL_RAYS), 5))
            stray_loops.cones(*beams, cells)
            new = np.zeros(len(rays), np.bool_)
            for retro in retros:
                given = retro.corners, retro.middle, retro.radius, self._back(retro.triangles)
                stray_loops.leaks(*beams, cells, *given, *limits, best, ends, new)
            if turns is not None:  # back to the axes of the scene
                rows = np.flatnonzero(new)
                ends[rows] = into_axes(ends[rows], turns[rows].transpose(0, 2, 1))
        row = np.flatnonzero(best > FAINTEST * self._noise.threshold)
        row = row[self._noise.passes(Purpose.STRAY, best[row], *keys.of(rays[row]))]
        distance = np.sqrt(products(ends[row].T, ends[row].T))
        low, high = self._sensor.min_range_m, self._sensor.max_range_m
        within = (distance >= low) & (distance <= high)
        row, distance = row[within], distance[within]
        free = self._world.free(origins[row], ends[row], distance, times[row], poses.ways)
        free &= ~self._beside(returns, rays[row], distance)
        row = row[free]
        return row, distance[free], best[row]

    def _back(self, triangle: Ints32) -> Floats:
        """Return what retro-reflectors return of a beam that hits them at a distance of 10 m."""
        surfaces, count = self._surfaces, len(triangle)
        table = surfaces.at(self._light.wavelength_nm)
        return table.scattered(surfaces.objects(triangle), np.ones(count), np.ones(count))

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
