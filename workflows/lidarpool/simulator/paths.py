"""Paths of light: casts sub-rays, and follows their light through glass and off mirrors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern

from ..columns.table import COLOURS
from ..scene.scene import Scene
from ..sensor import Sensor, Survey
from .hits import Hits, Planes, Real, joined
from .motion import Clock, Poses, products
from .surfaces import Surfaces, light_of
from .world import World

PASSES_MOST = 16  # surfaces that light passes before it is dropped


class Paths:
    """Finds where the light of a sensor returns from."""

    def __init__(
        self, world: World, scene: Scene, survey: Survey, sensor: Sensor, surfaces: Surfaces
    ) -> None:
        self._world, self._sensor, self._surfaces = world, sensor, surfaces
        self._light = light_of(survey, sensor)
        shown = any(column.name in COLOURS for column in survey.stored_columns)
        self._coloured = shown or surfaces.materials.textured
        # Light continues so far behind a surface, not to hit it again: Embree rounds to a quarter.
        reach = np.float32(np.abs(scene.bounds).max())
        self._clear_m = max(1e-5, 4 * float(np.spacing(reach)))

    def energy(
        self,
        triangle: NDArray[np.int32],
        cosine: Real,
        distance: Real,
        colour: NDArray[np.uint32] | None,
    ) -> Real:
        """Return the received energy of hits (n,), see `Surfaces.energy`."""
        return self._surfaces.energy(triangle, cosine, distance, self._light, colour)

    def hits(self, beams: Pattern, poses: Poses, window: tuple[int, int]) -> tuple[Hits, Planes]:
        """Cast the sub-rays of a window, and follow the light through glass and off mirrors."""
        surfaces = self._surfaces
        materials = surfaces.at(self._light.wavelength_nm)
        nearest, farthest = self._sensor.min_range_m, self._sensor.max_range_m
        found = self._world.scan(beams, poses, window=window, t_min=nearest, t_max=farthest)
        ray, step, triangle = found.ray.astype(np.int64), found.distance, found.triangle
        origins, directions = poses.rays(beams, ray, window[0])
        origins = np.broadcast_to(origins, directions.shape)
        times = poses.times(ray)
        share, before = np.ones(len(ray)), np.zeros(len(ray))
        # What mirrors did to the directions so far: (n, 3, 3), if there are any.
        turns = np.broadcast_to(np.eye(3), (len(ray), 3, 3)) if materials.mirrors.any() else None
        parts: list[Hits] = []
        seen: list[Real] = []  # normals as the sensor sees them
        for _ in range(PASSES_MOST):
            normals = surfaces.normals(triangle, times, poses.ways)
            along = products(normals.T, directions.T)
            distance = before + step
            colour = None
            if self._coloured:
                points = origins + step[:, None] * directions
                colour = surfaces.colours(triangle, points, times, poses.ways)
            energy = share * self.energy(triangle, np.abs(along), distance, colour)
            parts.append(Hits(ray, distance, triangle, energy, colour))
            seen.append(normals if turns is None else np.einsum("nji,nj->ni", turns, normals))
            rows = surfaces.objects(triangle)
            on = np.flatnonzero(materials.passes[rows] | materials.mirrors[rows])
            if not len(on):
                break
            rows, along, distance, ahead = rows[on], along[on], distance[on], directions[on]
            share = share[on] * materials.goes_on(rows, np.abs(along)) ** 2  # and back again
            ends = origins[on] + step[on, None] * ahead
            mirrored = 2 * materials.mirrors[rows, None] * normals[on]
            ahead = ahead - along[:, None] * mirrored
            if turns is not None:
                turns = turns[on]
                along_turns = np.einsum("ni,nij->nj", normals[on], turns)
                turns = turns - mirrored[:, :, None] * along_turns[:, None]
            away = self._clear_m / np.maximum(np.abs(along), 1e-3)
            light = Pattern(ahead, ends + away[:, None] * ahead)
            # Light takes no time: it travels 300 m in a microsecond.
            now = Poses(np.zeros(3), clock=Clock(times[on], np.zeros(1), poses.ways))
            found = self._world.scan(light, now, t_max=farthest)
            before = distance + away
            near = before[found.ray] + found.distance <= farthest
            which, step, triangle = found.ray[near], found.distance[near], found.triangle[near]
            ray, share, before = ray[on][which], share[which], before[which]
            times = times[on][which]
            turns = None if turns is None else turns[which]
            directions = light.directions[which]
            origins = light.origins[which]  # type: ignore[index]  # it has some
        hits, normals = joined(parts), seen[0]
        if parts[1:]:
            order = np.argsort(hits.ray, kind="stable")
            hits, normals = hits.take(order), np.concatenate(seen)[order]

        def planes(rows: NDArray[np.intp]) -> tuple[Real, Real]:
            return normals[rows], poses.rays(beams, hits.ray[rows], window[0])[1]

        return hits, planes
