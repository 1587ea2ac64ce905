"""Stray light: retro-reflectors beside a beam, of which its receiver gets a little."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats, Integers, Ints, Ints32, owned
from ..base.vectors import into_axes, length, products, turned
from ..columns.table import CAUSES
from ..scene.scene import Scene
from ..sensor.random_numbers import Purpose
from .detection import passes
from .returns import OF_RETURNS, PulseReturns, merged, unreal
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes
from .surfaces import Surfaces, light_of

STRAY = Purpose(22, "noise of stray light's energy")
BLOOMING = CAUSES.index("blooming")
TRIANGLES_NEAR = 4  # of a cluster are asked where a ray is nearest to them
CLUSTER_M = 1.0  # triangles of retro-reflectors so near to each other are looked for at a time
FAINTEST = 0.1  # of the threshold: less is never detected, see `detected`


class StrayLightStep(PulseStep):
    """Adds the light of retro-reflectors that beams beside them receive."""

    role = Role.RECEIVES
    effects = ("Blooming",)
    reads = "ray", "distance"
    writes = OF_RETURNS
    causes = (BLOOMING,)
    purposes = (STRAY,)

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        super().__init__(setup, caster, surfaces)
        self._light = light_of(setup.survey, setup.sensor)
        self._retros = [*_retros(setup.scene, surfaces)]

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.stray_light > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: a cause of each return, and rays."""
        return Memory(retained=10 * sizes.returns, casting=120 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        if not self._retros:
            return returns
        from . import stray_loops  # not before: numba takes half a second to import

        rays = np.arange(batch.start, batch.stop)
        poses = batch.subray_poses
        origins, directions = batch.central_rays
        times = poses.times((rays - batch.start) * batch.subrays_per_beam)
        # seen from the origins
        best = np.zeros(len(rays))
        ends = np.zeros((len(rays), 3))
        noise = self.setup.noise
        sensor = self.setup.sensor
        extinction = self._light.extinction
        low = sensor.min_range_m
        high = sensor.max_range_m
        faintest = FAINTEST * noise.threshold
        limits = low, noise.stray_light, faintest, extinction
        few = np.zeros(TRIANGLES_NEAR, np.int64)
        table = self.surfaces.at(self._light.wavelength_nm)
        for actor, retros in groupby(self._retros, key=lambda retro: retro.actor):
            turns = None
            places = np.zeros(3)
            if actor is not None:
                places, turns = poses.actor_trajectories[actor].poses(0, times)
            seen = into_axes(origins - places, turns), into_axes(directions, turns)
            beams = [owned(vectors.T) for vectors in seen]
            cells = np.empty((-(-len(rays) // stray_loops.CELL_RAYS), 5))
            stray_loops.cones(*beams, cells)
            new = np.zeros(len(rays), np.bool_)
            for retro in retros:
                one = np.ones(len(retro.triangles))
                # What they return of a beam that hits them at a distance of 10 m.
                back = table.scattered(self.surfaces.kinds(retro.triangles), one, one)
                given = *retro.places, back, few, *limits
                stray_loops.leaks(*beams, cells, *given, best, ends, new)
            if turns is not None:  # back to the axes of the scene
                rows = np.flatnonzero(new)
                ends[rows] = into_axes(ends[rows], turns[rows].transpose(0, 2, 1))
        row = np.flatnonzero(best > faintest)
        row = row[passes(noise, STRAY, best[row], *batch.keys.of(rays[row]))]
        distance = np.sqrt(products(ends[row].T, ends[row].T))
        within = (distance >= low) & (distance <= high)
        row = row[within]
        distance = distance[within]
        free = self.caster.is_visible(
            origins[row], ends[row], distance, times[row], poses.actor_trajectories
        )
        free &= ~self._beside(returns, rays[row], distance)
        row = row[free]
        return merged(returns, unreal(returns, rays[row], distance[free], best[row], BLOOMING))

    def _beside(self, returns: PulseReturns, ray: Ints, distance: Floats) -> Bools:
        """Whether a ray (n,) has a return of its own that cannot be told from one so far away."""
        first = np.searchsorted(returns.ray, ray, side="left")
        last = np.searchsorted(returns.ray, ray, side="right")
        beside = np.zeros(len(ray), np.bool_)
        for number in range(int((last - first).max(initial=0))):
            some = np.flatnonzero(first + number < last)
            own = returns.distance[first[some] + number]
            beside[some] |= np.abs(own - distance[some]) <= self.setup.half_pulse_m
        return beside


@dataclass(frozen=True)
class _Retro:
    """Triangles of retro-reflectors that are near to each other."""

    triangles: Ints32  # (k,): their numbers
    corners: Floats  # (k, 3, 3): in the scene's axes, or those of an actor
    actor: int | None = None

    @cached_property
    def places(self) -> tuple[Floats, Floats, Floats, float]:
        """Return corners, middles, and the middle and the radius of a ball around them."""
        a, b, c = self.corners.transpose(1, 0, 2)
        middle = self.corners.reshape(-1, 3).mean(axis=0)
        radius = float(length(self.corners.reshape(-1, 3) - middle).max())
        return self.corners, ((a + b) + c) / 3, middle, radius


def _retros(scene: Scene, surfaces: Surfaces) -> Iterator[_Retro]:
    """Retro-reflectors of a scene, its instances and actors."""
    retro = surfaces.materials.retro
    owners = surfaces.material_kinds.object
    of_object = np.zeros(len(scene.all_names), np.bool_)  # whether an object has some
    of_object[owners[retro]] = True

    def those_of(faces: Integers, vertices: Floats, first: int, actor: int | None = None) -> Any:
        """Clusters of the retro-reflectors among triangles that are numbered from `first` on."""
        rows = np.flatnonzero(retro[surfaces.kinds(first + np.arange(len(faces)))])
        return _clusters(first + rows, vertices[faces[rows]], actor)

    if of_object[: len(scene.names)].any():
        yield from those_of(scene.faces, scene.vertices, 0)
    begin = len(scene.faces)
    shared = scene.instances
    if shared is not None:
        for part, matrix, owner in zip(shared.part, shared.transforms, shared.owner, strict=True):
            mesh = shared.parts[part]
            if of_object[owner]:
                vertices = turned(mesh.vertices, matrix[:, :3]) + matrix[:, 3]
                yield from those_of(mesh.faces, vertices, begin)
            begin += len(mesh.faces)
    for number, actor in enumerate(scene.actors):
        faces = actor.mesh.faces
        if of_object[len(scene.names) + number]:
            yield from those_of(faces, actor.mesh.vertices, begin, number)
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
