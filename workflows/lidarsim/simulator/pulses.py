"""Returns of the pulses of one sensor: casts the sensor's scans, and applies the steps to the hits.

The way through a worker, from `intersect` of a casting task to a part's columns:

1. `Rig.cast` groups scans of one sensor and station whose firings follow each other.
2. `Rig.returns` finds the `Firings` of a group and the `CastPoses` of its beams.
3. `PulseCaster.scan` makes a `PulseBatch` for some of the beams at a time, and passes
   `PulseReturns` through the steps in the order of `step_list.py`:

   a. Steps aim the beams.
   b. `CastStep` finds the hits of all sub-rays; `CastStep.apply` lists its passes. From here on,
      `PulseReturns` has a row for each hit.
   c. Steps add the light of rain, spray and dirt, as further hits.
   d. `SeparationStep` or `WaveformStep` makes returns of hits; `_mark_returns` of
      `separation_loops.py` follows five hits of a beam. From here on, `PulseReturns` has a row for
      each return.
   e. Steps detect, receive, lose and choose returns.

4. `PulseCaster` counts the returns of each scan, and keeps every n-th: `Scanned`.
5. Steps on reported returns get all beams at once, and returns out of range are removed.
6. `BatchPoints` holds the returns that are left, and `columns_of` makes their columns.

If each ray can have one return only (`Setup.return_count_varies`), `SceneCaster` itself counts and
thins out the hits, in place of 3 and 4; of the steps of 3, only steps that aim beams act. On CUDA
without steps, `DeviceColumns` does 3 to 6.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from raybeam import Pattern

from ..base.arrays import Ints, owned
from ..scene.scene import Scene
from ..survey.survey import Survey
from .casting.motion import CastPoses, Firings
from .casting.scene_caster import SceneCaster
from .casting.surfaces import Surfaces, sensor_light_of
from .returns import NO_SURFACE, Keys, PulseReturns, joined, required
from .steps.doppler import radial_velocities
from .steps.step import Emitter, PulseBatch, PulseStep, Role
from .steps.step_list import setup_of, steps_of

CHUNK_RAYS = 1 << 17  # sub-rays that are cast at a time


class Scanned(NamedTuple):
    """Kept returns of scans, and counts of all returns."""

    returns: PulseReturns
    hit_counts: Ints  # (scans,): returns of each scan, kept or not
    tally: Ints | None  # (counters,): hits by `StoredTriangles.counter`, kept or not, on request


class PulseCaster:
    """Caster of the scans of a sensor, by its number in the survey, with its steps."""

    def __init__(
        self,
        sensor_number: int,
        caster: SceneCaster,
        scene: Scene,
        survey: Survey,
        surfaces: Surfaces,
    ) -> None:
        self.setup = setup = setup_of(scene, survey, sensor_number)
        self._caster = caster
        self._surfaces = surfaces
        # Known once: copies of this caster have the same materials and the same sensor.
        self._return_count_varies = setup.return_count_varies
        self.emitter = Emitter(setup)
        self.steps: list[PulseStep] = [step(setup, caster, surfaces) for step in steps_of(setup)]

    def moved(self, scene: Scene, surfaces: Surfaces) -> PulseCaster:
        """Return the caster of the same scans of a scene with moved instances."""
        caster = copy(self)
        caster.setup = replace(self.setup, scene=scene)
        caster._surfaces = surfaces
        caster.steps = [step.moved(caster.setup, surfaces) for step in self.steps]
        return caster

    def scan(
        self,
        scan: int,
        pattern: Pattern,
        poses: CastPoses,
        window: tuple[int, int],
        scan_starts: Ints,
        firings: Firings,
        *,
        tally: bool = True,
    ) -> Scanned:
        """Return the returns of scans from number `scan` on, counted and thinned out.

        Parameters
        ----------
        scan
            Number of the first scan, a key of random numbers: of a frozen sensor, the
            number of the older scan that is sent again.
        pattern
            Rays of the beams.
        poses
            Poses of the beams.
        window
            First row of the beams in `pattern`, and one past the last.
        scan_starts
            (scans,): first beam of each scan, counted from 0 at the first row of the window.
        firings
            Firings of the beams.
        tally
            Whether returns from surfaces are counted by `StoredTriangles.counter`.
        """
        first_row = window[0]
        beam_count = window[1] - window[0]

        def batch(start: int, stop: int) -> PulseBatch:
            keys = Keys(scan, scan_starts)
            return PulseBatch(
                keys=keys,
                start=start,
                stop=stop,
                pattern=pattern,
                first=first_row,
                poses=poses,
                firings=firings,
                emitter=self.emitter,
            )

        all_beams = batch(0, beam_count)
        if self._return_count_varies:
            pose_beams = poses.rays_per_pose or self.setup.sensor.channels
            chunk_beams = max(1, CHUNK_RAYS // (len(self.emitter) * pose_beams)) * pose_beams
            chunk_starts = range(0, beam_count, chunk_beams)
            chunks = [
                self._pulses(batch(k, min(k + chunk_beams, beam_count))) for k in chunk_starts
            ]
            scanned = self._thin_out(joined(chunks), scan_starts, tally)
        else:
            scanned = self._cast_once(all_beams, scan_starts, tally)
        returns = scanned.returns
        for step in self.steps:
            if Role.ON_REPORTED in step.role:
                returns = step.apply(returns, all_beams)
        return self._within_range(scanned._replace(returns=returns), scan_starts)

    def _within_range(self, scanned: Scanned, scan_starts: Ints) -> Scanned:
        """Remove the returns whose ranges, with noise, are outside of the sensor's range.

        If `keep_every` is 1, the counts and the numbers of the other returns are as if the removed
        returns were undetected. If it is larger, returns have been thinned out before: only the
        removed returns among the kept ones leave the counts, and the choice of the kept returns
        stays.
        """
        returns = scanned.returns
        sensor = self.setup.sensor
        if returns.reported is returns.distance or returns.reported is None:  # without noise
            return scanned
        in_range = returns.reported >= sensor.min_range_m
        in_range &= returns.reported <= sensor.max_range_m
        if in_range.all():
            return scanned
        removed = np.flatnonzero(~in_range)
        removed_scan = np.searchsorted(scan_starts, returns.ray[removed], "right") - 1
        hit_counts = scanned.hit_counts - np.bincount(removed_scan, minlength=len(scan_starts))
        tally = scanned.tally
        if tally is not None:
            triangle = returns.triangle[removed]
            counter = self._surfaces.triangles.counter(triangle[triangle != NO_SURFACE])
            tally = tally - np.bincount(counter, minlength=len(tally))
        start = np.searchsorted(returns.ray, returns.ray)  # row of the first return of each pulse
        stop = np.searchsorted(returns.ray, returns.ray, "right")
        removed_before = np.append(0, np.cumsum(~in_range))  # removed returns before each row
        number = required(returns.number) - (removed_before[:-1] - removed_before[start])
        count = required(returns.return_counts) - (removed_before[stop] - removed_before[start])
        renumbered = returns._replace(
            number=number.astype(np.uint8), return_counts=count.astype(np.uint8)
        )
        return Scanned(renumbered.take(in_range), hit_counts, tally)

    def _pulses(self, batch: PulseBatch) -> PulseReturns:
        """Return the returns of a batch after all steps that act before returns are thinned out."""
        returns = PulseReturns.empty()
        for step in self.steps:
            if Role.ON_REPORTED not in step.role:
                returns = step.apply(returns, batch)
        return returns

    def _cast_once(self, batch: PulseBatch, scan_starts: Ints, tally: bool) -> Scanned:
        """Cast rays that have a single return each, counted and thinned out by the caster.

        Energies are computed only for kept returns, and only if steps deflect beams before they are
        cast (`Role.AIMS`); else `BatchPoints` computes energies by the reported directions.
        """
        setup = self.setup
        poses = batch.poses
        for step in self.steps:
            if Role.AIMS in step.role:
                step.apply(PulseReturns.empty(), batch)
        hits = self._caster.scan(
            batch.beams,
            poses,
            window=batch.window,
            t_min=setup.sensor.min_range_m,
            t_max=setup.sensor.max_range_m,
            keep_every=setup.survey.keep_every,
            groups=scan_starts,
            tally=tally,
        )
        returns = PulseReturns.single_returns(hits.ray, hits.distance, hits.triangle)
        if batch.offsets is not None:
            returns = self._with_light(returns, batch)
        return Scanned(returns, hits.hit_counts, hits.tally)

    def _with_light(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add energy, color and velocity to returns of deflected beams, by cast directions."""
        surfaces = self._surfaces
        setup = self.setup
        poses = batch.poses
        origins, directions = rays = poses.rays(batch.beams, returns.ray, batch.window[0])
        times = poses.times(returns.ray)
        distance = returns.distance
        triangle = returns.triangle
        color = velocity = None
        if setup.has_velocities:
            velocity = radial_velocities(
                surfaces,
                poses,
                ray=returns.ray,
                rays=rays,
                distance=distance,
                triangle=triangle,
                times=times,
            )
        if surfaces.materials.textured:
            points = directions * distance[:, None]
            points += origins
            color = surfaces.colors(triangle, points, times, poses.actor_trajectories)
            del points  # which takes as much memory as the normals
        sensor_light = sensor_light_of(setup.survey, setup.sensor)
        lit = surfaces.lit(
            triangle,
            directions,
            distance=distance,
            sensor_light=sensor_light,
            times=times,
            trajectories=poses.actor_trajectories,
            colors=color,
        )
        return returns._replace(energy=lit.energy, color=color, velocity=velocity)

    def _thin_out(self, returns: PulseReturns, scan_starts: Ints, tally: bool) -> Scanned:
        """Count the returns of each scan, and keep every n-th return of a scan."""
        from .steps import pulse_loops  # not before: numba takes half a second to import

        keep_every = self.setup.survey.keep_every
        size = len(returns.ray)
        hit_counts = np.zeros(len(scan_starts), np.int64)
        row_indices = np.empty(size, np.int64)
        number, return_counts = np.empty((2, size), np.uint8)
        count = pulse_loops.thin_out(
            owned(returns.ray, np.int64),
            owned(scan_starts, np.int64),
            keep_every=keep_every,
            hit_counts=hit_counts,
            row_indices=row_indices,
            number=number,
            return_counts=return_counts,
        )
        thinned = returns if count == size else returns.take(row_indices[:count])
        thinned = thinned._replace(
            ray=thinned.ray.astype(np.uint32),
            number=number[:count],
            return_counts=return_counts[:count],
            reported=thinned.distance,
        )
        if not tally:
            return Scanned(thinned, hit_counts, None)
        triangle = returns.triangle[returns.triangle != NO_SURFACE]
        return Scanned(thinned, hit_counts, self._surfaces.triangles.count(triangle))
