"""Cast the pulses of one sensor, and apply the simulation steps to their hits.

On a worker, a casting task turns scans into columns as follows:

1. `Rig.cast` groups consecutive scans that share a sensor and a station.
2. `Rig.returns` determines the `Firings` of a group and the `CastPoses` of its beams.
3. `PulseCaster.scan` makes a `PulseBatch` for a part of the beams at a time, and passes
   `PulseReturns` through the steps in the order of `step_list.py`:

   a. Steps aim the beams.
   b. `CastStep` finds the hits of all sub-rays. `CastStep.apply` lists its passes. From here on,
      `PulseReturns` has one row per hit.
   c. Steps add light that rain, spray and dirt scatter, as further hits.
   d. `SeparationStep` or `WaveformStep` combines hits into returns. The docstring of
      `_mark_returns` in `separation_loops.py` has an example with five hits of one beam. From here
      on, `PulseReturns` has one row per return.
   e. Steps apply detection, receiver faults and losses, and select the reported returns.

4. `PulseCaster` counts the returns of each scan and keeps every n-th return (`ScannedReturns`).
5. Steps that act on reported returns process all beams at once. Returns out of range are removed.
6. `BatchPoints` holds the remaining returns, and `columns_of` computes their columns.

If each ray can have at most one return (see `Setup.return_count_varies`), `SceneCaster` itself
counts and thins out the hits in place of 3 and 4, and only the steps that aim beams act. On a CUDA
device without steps, `DeviceColumns` replaces 3 to 6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from raybeam import Pattern

from ..casting.motion import CastPoses, Firings
from ..casting.scene_caster import SceneCaster
from ..casting.surfaces import SceneSurfaces, sensor_light_of
from ..numerics.arrays import Floats, Ints, to_writable
from ..scene.scene import Scene
from ..sensor.noise import Noise
from ..survey.survey import Survey
from .returns import NO_SURFACE, Keys, PulseReturns, concatenate_returns, require_column
from .steps.doppler import radial_velocities
from .steps.step import Emitter, PulseBatch, PulseStep, RecordedPulses, Role
from .steps.step_list import setup_of, steps_of

CHUNK_RAYS = 1 << 17  # number of sub-rays that are cast at a time


class ScannedReturns(NamedTuple):
    """Returns that are kept from consecutive scans, and counts of all returns."""

    returns: PulseReturns
    hit_counts: Ints  # (scans,): returns of each scan, including those that are not kept
    # (counters,): all hits per hit counter (`StoredTriangles.counter`); None if not requested
    tally: Ints | None


class BeamRange(NamedTuple):
    """Consecutive beams that are cast by the same caster."""

    caster: PulseCaster
    start: int  # number of the first beam, counted from the first beam of the scans
    stop: int  # one past the last beam


class PulseCaster:
    """Caster for the scans of one sensor, which also applies the sensor's simulation steps."""

    def __init__(
        self,
        sensor_number: int,
        caster: SceneCaster,
        scene: Scene,
        survey: Survey,
        surfaces: SceneSurfaces,
        recorded_noise: Noise | None = None,
    ) -> None:
        self.setup = setup = setup_of(scene, survey, sensor_number, recorded_noise)
        self._caster = caster
        self._surfaces = surfaces
        # Stored because copies of this caster have the same materials and the same sensor.
        self._return_count_varies = setup.return_count_varies
        self.emitter = Emitter(setup)
        self.steps: list[PulseStep] = [step(setup, caster, surfaces) for step in steps_of(setup)]

    def with_moved_instances(self, scene: Scene, surfaces: SceneSurfaces) -> PulseCaster:
        """Return a caster for the same scans after instances in the scene have moved."""
        caster = copy(self)
        caster.setup = replace(self.setup, scene=scene)
        caster._surfaces = surfaces
        caster.steps = [step.with_moved_instances(caster.setup, surfaces) for step in self.steps]
        return caster

    def scan(
        self,
        scan: int,
        pattern: Pattern | Callable[[], Pattern],
        poses: CastPoses,
        window: tuple[int, int],
        scan_starts: Ints,
        firings: Firings,
        *,
        tally: bool = True,
        recorded: RecordedPulses | None = None,
        ranges: Sequence[BeamRange] = (),
    ) -> ScannedReturns:
        """Cast consecutive scans, count their returns, and keep every n-th return.

        Parameters
        ----------
        scan
            Number of the first scan, which is a key of the random numbers. For a frozen sensor, the
            number of the older scan that is sent again.
        pattern
            Rays of the beams, or a function that returns them. It is called if a step needs them.
        poses
            Poses of the beams.
        window
            Rows of `pattern` that the beams use: the first row, and one past the last.
        scan_starts
            (scans,): first beam of each scan. Beams are numbered from 0 at the first row of
            `window`.
        firings
            Firings of the beams.
        tally
            Whether to count the hits on surfaces by `StoredTriangles.counter`.
        recorded
            Recorded pulses of the beams, which are required if `Setup.is_recorded` is true.
        ranges
            Ranges of all beams, if other casters cast some of them. Steps that act on reported
            returns are those of this caster.
        """
        first_row = window[0]
        beam_count = window[1] - window[0]

        def batch(emitter: Emitter, start: int, stop: int) -> PulseBatch:
            keys = Keys(scan, scan_starts)
            return PulseBatch(
                keys=keys,
                start=start,
                stop=stop,
                pattern=pattern,
                first=first_row,
                poses=poses,
                firings=firings,
                emitter=emitter,
                recorded=recorded,
            )

        all_beams = batch(self.emitter, 0, beam_count)
        if self._return_count_varies:
            pose_beams = poses.rays_per_pose or self.setup.sensor.channels
            chunks = []
            for caster, start, stop in ranges or [BeamRange(self, 0, beam_count)]:
                emitter = caster.emitter
                chunk_beams = max(1, CHUNK_RAYS // (len(emitter) * pose_beams)) * pose_beams
                chunks += [
                    caster._pulses(batch(emitter, k, min(k + chunk_beams, stop)))
                    for k in range(start, stop, chunk_beams)
                ]
            scanned = self._thin_out(concatenate_returns(chunks), scan_starts, tally)
        else:
            scanned = self._cast_once(all_beams, scan_starts, tally)
        returns = scanned.returns
        for step in self.steps:
            if Role.ON_REPORTED in step.role:
                returns = step.apply(returns, all_beams)
        return self._within_range(scanned._replace(returns=returns), scan_starts)

    def _within_range(self, scanned: ScannedReturns, scan_starts: Ints) -> ScannedReturns:
        """Remove the returns whose range, including noise, is outside the sensor's range limits.

        If `keep_every` is 1, the removed returns are treated as undetected, so counts and return
        numbers are adjusted. If it is larger, the returns have already been thinned out. Then the
        counts are reduced only by the removed returns among the kept ones, and the selection of
        kept returns does not change.
        """
        returns = scanned.returns
        sensor = self.setup.sensor
        if returns.reported is returns.distance or returns.reported is None:  # without noise
            return scanned
        if _are_within(returns.reported, sensor.min_range_m, sensor.max_range_m):
            return scanned
        in_range = returns.reported >= sensor.min_range_m
        in_range &= returns.reported <= sensor.max_range_m
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
        removed_before = np.append(0, np.cumsum(~in_range))  # removed returns above each row
        number = require_column(returns.number) - (removed_before[:-1] - removed_before[start])
        count = require_column(returns.return_counts) - (
            removed_before[stop] - removed_before[start]
        )
        renumbered = returns._replace(
            number=number.astype(np.uint8), return_counts=count.astype(np.uint8)
        )
        return ScannedReturns(renumbered.take(in_range), hit_counts, tally)

    def _pulses(self, batch: PulseBatch) -> PulseReturns:
        """Return the returns of a batch after all steps that act before thinning."""
        returns = PulseReturns.empty()
        for step in self.steps:
            if Role.ON_REPORTED not in step.role:
                returns = step.apply(returns, batch)
        return returns

    def _cast_once(self, batch: PulseBatch, scan_starts: Ints, tally: bool) -> ScannedReturns:
        """Cast rays that have at most one return each.

        The caster counts and thins out the hits.

        Energies are computed here only if steps deflect beams before casting (`Role.AIMS`), and
        only for kept returns. Otherwise `BatchPoints` computes them from the reported directions.
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
        return ScannedReturns(returns, hits.hit_counts, hits.tally)

    def _with_light(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add energy, color and velocity to the returns of deflected beams."""
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
        if surfaces.materials.has_textures:
            points = directions * distance[:, None]
            points += origins
            color = surfaces.colors(triangle, points, times, poses.actor_trajectories)
            del points  # frees as much memory as the normals need
        sensor_light = sensor_light_of(setup.survey, setup.sensor)
        lit = surfaces.illuminate(
            triangle,
            directions,
            distance=distance,
            sensor_light=sensor_light,
            times=times,
            trajectories=poses.actor_trajectories,
            colors=color,
        )
        return returns._replace(energy=lit.energy, color=color, velocity=velocity)

    def _thin_out(self, returns: PulseReturns, scan_starts: Ints, tally: bool) -> ScannedReturns:
        """Count the returns of each scan, and keep every n-th return of each scan."""
        from .steps import pulse_loops  # imported here because numba takes half a second to import

        keep_every = self.setup.survey.keep_every
        size = len(returns.ray)
        hit_counts = np.zeros(len(scan_starts), np.int64)
        row_indices = np.empty(size, np.int64)
        number, return_counts = np.empty((2, size), np.uint8)
        count = pulse_loops.thin_out(
            to_writable(returns.ray, np.int64),
            to_writable(scan_starts, np.int64),
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
            return ScannedReturns(thinned, hit_counts, None)
        triangle = returns.triangle[returns.triangle != NO_SURFACE]
        return ScannedReturns(thinned, hit_counts, self._surfaces.triangles.count(triangle))


def _are_within(values: Floats, lowest: float, highest: float) -> bool:
    """Return whether all values are within limits."""
    return bool(values.min(initial=np.inf) >= lowest and values.max(initial=-np.inf) <= highest)
