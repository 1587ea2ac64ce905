"""Returns of the pulses of one sensor: casts its scans, and applies the steps to what is hit.

Random numbers depend only on scan, ray and return, so the batches do not matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam import Pattern

from ..base.arrays import Ints, owned
from ..scene.scene import Scene
from ..sensor import Survey
from .doppler import radial_velocities
from .motion import CastPoses, Firings
from .returns import NO_SURFACE, Keys, PulseReturns, joined, made
from .scene_caster import SceneCaster
from .step import Emitter, PulseBatch, PulseStep, Role
from .steps import setup_of, steps_of
from .surfaces import Surfaces, light_of

CHUNK_RAYS = 1 << 17  # sub-rays that are cast at a time


class Scanned(NamedTuple):
    """What scans give: kept returns, and counts of all."""

    returns: PulseReturns
    hits: Ints  # (scans,): returns of each, kept or not
    tally: Ints | None  # (counters,): hits by `Surfaces.counter`, kept or not, if asked for


class PulseCaster:
    """Casts the scans of one sensor."""

    def __init__(
        self, number: int, caster: SceneCaster, scene: Scene, survey: Survey, surfaces: Surfaces
    ) -> None:
        self._setup = setup = setup_of(scene, survey, number)
        self._caster = caster
        self._surfaces = surfaces
        self.emitter = Emitter(setup)
        self.steps: list[PulseStep] = [step(setup, caster, surfaces) for step in steps_of(setup)]

    def scan(
        self,
        scan: int,
        pattern: Pattern,
        poses: CastPoses,
        window: tuple[int, int],
        groups: Ints,
        firings: Firings,
        *,
        tally: bool = True,
    ) -> Scanned:
        """Cast scans from number `scan` on: hits in the sensor's range, counted and thinned out.

        The others are arguments of `RayCaster.scan`, where each group is a scan.
        """
        first = window[0]
        rays = window[1] - window[0]

        def batch(start: int, stop: int) -> PulseBatch:
            keys = Keys(scan, groups)
            return PulseBatch(keys, start, stop, pattern, first, poses, firings, self.emitter)

        whole = batch(0, rays)
        if self._setup.has_several_returns:
            unit = poses.rays_per_pose or self._setup.sensor.channels
            size = max(1, CHUNK_RAYS // (len(self.emitter) * unit)) * unit
            begins = range(0, rays, size)
            chunks = [self._pulses(batch(k, min(k + size, rays))) for k in begins]
            found = self._kept(joined(chunks), groups, tally)
        else:
            found = self._once(whole, groups, tally)
        returns = found.returns
        for step in self.steps:
            if Role.ON_REPORTED in step.role:
                returns = step.apply(returns, whole)
        return self._in_range(found._replace(returns=returns), groups)

    def _in_range(self, scanned: Scanned, groups: Ints) -> Scanned:
        """Remove the returns whose ranges, with noise, are beyond those that the sensor reports.

        The counts and the numbers of the other returns are as if the removed ones were undetected.
        """
        returns = scanned.returns
        sensor = self._setup.sensor
        if returns.reported is returns.distance or returns.reported is None:  # without noise
            return scanned
        in_range = returns.reported >= sensor.min_range_m
        in_range &= returns.reported <= sensor.max_range_m
        if in_range.all():
            return scanned
        removed = np.flatnonzero(~in_range)
        group = np.searchsorted(groups, returns.ray[removed], "right") - 1
        hits = scanned.hits - np.bincount(group, minlength=len(groups))
        tally = scanned.tally
        if tally is not None:
            triangle = returns.triangle[removed]
            counter = self._surfaces.counter(triangle[triangle != NO_SURFACE])
            tally = tally - np.bincount(counter, minlength=len(tally))
        first = np.searchsorted(returns.ray, returns.ray)  # row of the first return of each pulse
        last = np.searchsorted(returns.ray, returns.ray, "right")
        before = np.append(0, np.cumsum(~in_range))  # removed returns before each row
        number = made(returns.number) - (before[:-1] - before[first])
        count = made(returns.returns) - (before[last] - before[first])
        renumbered = returns._replace(
            number=number.astype(np.uint8), returns=count.astype(np.uint8)
        )
        return Scanned(renumbered.take(in_range), hits, tally)

    def _pulses(self, batch: PulseBatch) -> PulseReturns:
        """Take the pulses of a batch through all steps."""
        returns = PulseReturns.none()
        for step in self.steps:
            if Role.ON_REPORTED not in step.role:
                returns = step.apply(returns, batch)
        return returns

    def _once(self, batch: PulseBatch, groups: Ints, tally: bool) -> Scanned:
        """Cast rays with one return each; compute energies only for kept ones, and if needed."""
        setup = self._setup
        poses = batch.poses
        for step in self.steps:
            if Role.AIMS in step.role:
                step.apply(PulseReturns.none(), batch)
        found = self._caster.scan(
            batch.beams,
            poses,
            window=batch.window,
            t_min=setup.sensor.min_range_m,
            t_max=setup.sensor.max_range_m,
            keep_every=setup.survey.keep_every,
            groups=groups,
            tally=tally,
        )
        returns = PulseReturns.one_each(found.ray, found.distance, found.triangle)
        if batch.offsets is not None:  # else it is made of the reported directions, if it is needed
            returns = self._lit(returns, batch)
        return Scanned(returns, found.hits, found.tally)

    def _lit(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Make what depends on the directions in which rays were cast."""
        surfaces = self._surfaces
        setup = self._setup
        poses = batch.poses
        origins, directions = rays = poses.rays(batch.beams, returns.ray, batch.window[0])
        times = poses.times(returns.ray)
        distance = returns.distance
        triangle = returns.triangle
        colour = velocity = None
        if setup.has_velocities:
            given = returns.ray, rays, distance, triangle, times
            velocity = radial_velocities(surfaces, poses, *given)
        if surfaces.materials.textured:
            ends = directions * distance[:, None]
            ends += origins
            colour = surfaces.colours(triangle, ends, times, poses.actor_trajectories)
            del ends  # which takes as much memory as the normals
        light = light_of(setup.survey, setup.sensor)
        lit = surfaces.lit(
            triangle, directions, distance, light, times, poses.actor_trajectories, colour
        )
        return returns._replace(energy=lit.energy, colour=colour, velocity=velocity)

    def _kept(self, returns: PulseReturns, groups: Ints, tally: bool) -> Scanned:
        """Count the returns of each scan and thin them out."""
        from . import pulse_loops  # not before: numba takes half a second to import

        every = self._setup.survey.keep_every
        most = len(returns.ray)
        hits = np.zeros(len(groups), np.int64)
        rows = np.empty(most, np.int64)
        number, each = np.empty((2, most), np.uint8)
        given = owned(returns.ray, np.int64), owned(groups, np.int64), every
        count = pulse_loops.counted(*given, hits, rows, number, each)
        thinned = returns if count == most else returns.take(rows[:count])
        thinned = thinned._replace(
            ray=thinned.ray.astype(np.uint32),
            number=number[:count],
            returns=each[:count],
            reported=thinned.distance,
        )
        if not tally:
            return Scanned(thinned, hits, None)
        surfaces = self._surfaces
        some = returns.triangle[returns.triangle != NO_SURFACE]
        counted = np.bincount(surfaces.counter(some), minlength=surfaces.counters)
        return Scanned(thinned, hits, counted)
