"""Visibility of actors, determined with the sensor's own rays.

Each pulse is represented by its central ray. A ray counts for an actor if it would hit the actor in
an empty scene, within the range limits of the sensor. It is visible if it also hits the actor first
in the full scene. Pulses that the platform blocks do not count.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from raybeam import Pattern

from ..columns.actor_rays import ACTOR_RAYS
from ..motion.trajectory import full_poses, presence_ns
from ..numerics.arrays import Bools, Floats, Indices, Ints, Records
from ..numerics.elementary import arctan2
from ..numerics.vectors import hypot, matvec, norm, rotate
from ..scene.scene import Scene
from ..sensor import Sensor
from ..survey.survey import ScanSpec, Survey
from ..survey.sweep_poses import sensor_pose
from .motion import CastPoses
from .ray_chunks import RayChunk, ray_chunks
from .scene_caster import NEVER_NS, SceneCaster
from .stored_triangles import StoredTriangles

_FIELD_RAYS = 1_000_000  # maximum number of rays from which a field of view is determined
_CELLS = 8  # cells along each axis of a box; their centers are inside or outside the field of view
# A gap between azimuths limits the field of view if it is this wide and at least twice as wide as
# all other gaps.
_MIN_GAP_RAD = np.radians(10.0)
_SLACK_RAD = 1e-9  # rounding errors of angles


@dataclass(frozen=True)
class FieldOfView:
    """Limits of the directions and ranges of a sensor's rays in the sensor frame."""

    azimuth: tuple[float, float]  # start and width of the sector in radians
    elevation: tuple[float, float]  # radians
    range_m: tuple[float, float]

    @classmethod
    def from_sensor(cls, sensor: Sensor) -> FieldOfView:
        """Determine the field of view from the directions of the first revolution."""
        stop = sensor.firings_of_revolution(0).stop
        step = max(1, stop * sensor.channels // _FIELD_RAYS)
        firings = np.unique(np.append(np.arange(0, stop, step, dtype=np.int64), stop - 1))
        x, y, z = sensor.directions(firings).reshape(-1, 3).T
        elevation = arctan2(z, hypot(x, y))
        limits = float(elevation.min()), float(elevation.max())
        ranges = sensor.min_range_m, sensor.max_range_m
        return cls(_sector_of(arctan2(y, x)), limits, ranges)

    def contains(self, points: Floats) -> Bools:
        """Return whether points (n, 3) in the sensor frame are in the field of view."""
        x, y, z = points.T
        start, width = self.azimuth
        from_start = (arctan2(y, x) - start) % (2 * np.pi)
        elevation = arctan2(z, hypot(x, y))
        distance = norm(points)
        lowest, highest = self.elevation
        inside = (from_start <= width + _SLACK_RAD) | (from_start >= 2 * np.pi - _SLACK_RAD)
        inside &= (lowest - _SLACK_RAD <= elevation) & (elevation <= highest + _SLACK_RAD)
        return np.asarray(inside & (self.range_m[0] <= distance) & (distance <= self.range_m[1]))


def _sector_of(azimuths: Floats) -> tuple[float, float]:
    """Return the start and width of the smallest sector that contains azimuths, in radians."""
    ordered = np.unique(azimuths % (2 * np.pi))
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    others = np.delete(gaps, widest).max(initial=0.0)
    if gaps[widest] < max(_MIN_GAP_RAD, 2 * others):
        return 0.0, 2 * np.pi
    start = float(ordered[(widest + 1) % len(ordered)])
    return start, 2 * np.pi - float(gaps[widest])


@dataclass(frozen=True, eq=False)
class _SweepRays:
    """Rays of a sweep in consecutive scans, and the records of the actors that are present."""

    number: int  # among the sweeps of the sensor
    records: Records  # (k,)
    first: int  # first ray, counted from the first scan
    stop: int  # end of the rays

    @classmethod
    def empty(cls, number: int, sweep: int, actors: Ints, first: int, stop: int) -> _SweepRays:
        """Create the rays of a sweep without counts. `sweep` is its number among all sweeps."""
        records = np.zeros(len(actors), ACTOR_RAYS)
        records["actor"] = actors
        records["sweep"] = sweep
        return cls(number, records, first, stop)


class _Boxes(NamedTuple):
    """Boxes of k actors in the scene frame."""

    centers: Floats  # (k, 3), meters
    rotations: Floats  # (k, 3, 3), from the box to the scene frame
    halves: Floats  # (k, 3), half sizes, meters

    def select(self, rows: Indices) -> _Boxes:
        """Return the boxes in the given rows."""
        return _Boxes(self.centers[rows], self.rotations[rows], self.halves[rows])


class ActorVisibility:
    """Counts the rays of a sensor that hit each actor."""

    def __init__(
        self,
        scene: Scene,
        survey: Survey,
        number: int,
        caster: SceneCaster,
        triangles: StoredTriangles,
    ) -> None:
        self._scene = scene
        self._survey = survey
        self._number = number
        self._caster = caster
        self._triangles = triangles
        self._sensor = survey.mounted_sensors[number].sensor

    @cached_property
    def _field_of_view(self) -> FieldOfView:
        return FieldOfView.from_sensor(self._sensor)

    def count(
        self, specs: Sequence[ScanSpec], pattern: Pattern, poses: CastPoses, window: tuple[int, int]
    ) -> Records:
        """Return the records (k,) of consecutive scans at one station, of type `ACTOR_RAYS`.

        `window` contains the first pattern row of the rays, and one past the last.
        """
        sweeps = [
            _SweepRays.empty(sweep, self._first_sweep + sweep, self._present_actors(sweep), *span)
            for sweep, *span in self._sweeps_of(specs, window[1] - window[0])
        ]
        for chunk in ray_chunks(self._sensor, specs, pattern, poses, window):
            self._count_visible(sweeps, chunk)
            self._count_alone(sweeps, chunk)
        for sweep in sweeps:
            self._measure_boxes(sweep, ray_chunks(self._sensor, specs, pattern, poses, window))
        return np.concatenate([sweep.records for sweep in sweeps])

    @cached_property
    def _first_sweep(self) -> int:
        """Number of sweeps of the preceding sensors."""
        return sum(len(sweeps.firsts) for sweeps in self._survey.sweeps_each[: self._number])

    @cached_property
    def _presence_ns(self) -> Floats:
        """First and last time at which the sensor could see each actor, in nanoseconds.

        The shape is (actors, 2).
        """
        presence = np.array([presence_ns(actor.trajectory) for actor in self._scene.actors])
        if self._caster.unseen is not None:
            presence[self._caster.unseen[len(self._scene.names) :]] = NEVER_NS
        return presence

    def _sweeps_of(self, specs: Sequence[ScanSpec], count: int) -> list[tuple[int, int, int]]:
        """Return the sweeps of scans, each with its first ray and the end of its rays."""
        firsts = self._survey.sweeps_each[self._number].firsts
        sweeps = np.searchsorted(firsts, [spec.scan for spec in specs], "right") - 1
        begin = specs[0].firings[0]
        starts = [(spec.firings[0] - begin) * self._sensor.channels for spec in specs]
        first_scans = np.flatnonzero(np.diff(sweeps, prepend=-1)).tolist()
        cuts = [*(starts[scan] for scan in first_scans), count]
        return [(int(sweeps[scan]), cuts[k], cuts[k + 1]) for k, scan in enumerate(first_scans)]

    def _present_actors(self, sweep: int) -> Ints:
        """Return the visible actors that are in the scene during a sweep."""
        _, starts_ns, stops_ns = self._survey.sweeps_each[self._number]
        appears, leaves = self._presence_ns.T
        present = (appears <= stops_ns[sweep]) & (starts_ns[sweep] <= leaves)
        return np.flatnonzero(present)

    def _count_visible(self, sweeps: Sequence[_SweepRays], chunk: RayChunk) -> None:
        """Add the number of rays that hit each actor first."""
        hits = self._caster.scan(chunk.pattern, chunk.poses, **chunk.limits)
        actors = self._triangles.objects(hits.triangle) - self._triangles.static_objects
        rays = hits.ray.astype(np.int64)
        counted = (actors >= 0) & chunk.allowed[rays]
        rays = chunk.start + rays[counted]
        actors = actors[counted]
        for sweep in sweeps:
            in_sweep = (sweep.first <= rays) & (rays < sweep.stop)
            counts = np.bincount(actors[in_sweep], minlength=len(self._scene.actors))
            sweep.records["visible"] += counts[sweep.records["actor"]]

    def _count_alone(self, sweeps: Sequence[_SweepRays], chunk: RayChunk) -> None:
        """Add the number of rays that would hit each actor if it were alone."""
        actors = np.unique(np.concatenate([sweep.records["actor"] for sweep in sweeps]))
        for actor in actors.tolist():
            rays = self._caster.rays_on_actor(actor, chunk.scan, chunk.poses)
            rays = chunk.start + rays[chunk.allowed[rays]]
            for sweep in sweeps:
                count = np.count_nonzero((sweep.first <= rays) & (rays < sweep.stop))
                sweep.records["rays"][sweep.records["actor"] == actor] += count

    def _measure_boxes(self, sweep: _SweepRays, chunks: Iterable[RayChunk]) -> None:
        """Set the truncation of boxes, and the distance between rays and actors without hits."""
        from . import box_distance_loops as loops  # imported here because numba is slow to import

        records = sweep.records
        boxes = self._boxes(sweep.number, records["actor"])
        records["truncated"] = self._truncations(sweep.number, boxes)
        missed = np.flatnonzero(records["rays"] == 0)
        if not len(missed):
            return
        squares = np.full(len(missed), np.inf)
        for chunk in chunks:
            rays = chunk.start + np.flatnonzero(chunk.allowed)
            rays = rays[(sweep.first <= rays) & (rays < sweep.stop)] - chunk.start
            if len(rays):
                limits = chunk.scan.t_min, chunk.scan.t_max
                columns = np.ascontiguousarray(chunk.computed_rays()[:, rays])
                loops.nearest_boxes(columns, *boxes.select(missed), *limits, squares)
        records["nearest_m"][missed] = np.sqrt(squares)

    def _boxes(self, sweep: int, actors: Ints) -> _Boxes:
        """Return the boxes of actors at the start of a sweep.

        If an actor appears or leaves during the sweep, its pose is the first or last one.
        """
        start_ns = float(self._survey.sweeps_each[self._number].starts_ns[sweep])
        shape = len(actors), 3
        boxes = _Boxes(np.empty(shape), np.empty((*shape, 3)), np.empty(shape))
        for row, number in enumerate(actors.tolist()):
            actor = self._scene.actors[number]
            at_ns = np.array([np.clip(start_ns, *self._presence_ns[number])])
            positions, rotations = full_poses(actor.trajectory, 0, at_ns)
            boxes.rotations[row] = rotations[0]
            boxes.centers[row] = positions[0] + matvec(rotations[0], actor.bounds.mean(axis=0))
            boxes.halves[row] = np.ptp(actor.bounds, axis=0) / 2
        return boxes

    def _truncations(self, sweep: int, boxes: _Boxes) -> Floats:
        """Return the fraction of each box's cells that are outside the field of view."""
        steps = (np.arange(_CELLS) + 0.5) / _CELLS * 2 - 1
        cells = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        position, axes = sensor_pose(self._survey, self._number, sweep)
        truncations = np.empty(len(boxes.centers))
        for row, half in enumerate(boxes.halves):
            in_scene = rotate(cells * half, boxes.rotations[row]) + boxes.centers[row]
            inside = self._field_of_view.contains(rotate(in_scene - position, axes.T))
            truncations[row] = 1.0 - np.count_nonzero(inside) / len(inside)
        return truncations
