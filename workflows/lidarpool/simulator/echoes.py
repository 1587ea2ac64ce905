"""Returns of a pulse: sub-rays, materials, and noise.

Random numbers depend only on scan, ray and return, so the batches do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from raybeam import Pattern, ScanReturns, SubRays

from ..base.arrays import Bytes, Floats, Ints, Ints32, Records, UInts32
from ..base.vectors import products, turned
from ..scene.scene import Scene
from ..sensor import Returns, Sensor, Survey
from ..sensor.noise import THRESHOLD_SIGMAS
from .air import AirCaster, inserted
from .doppler import approach, radial_velocities
from .hits import NO_SURFACE, Hits, Keys, joined, numbers
from .motion import Poses
from .paths import Paths
from .receiver import Receiver
from .separation import AirHits, Report, chosen, separated
from .surfaces import Surfaces
from .waveform import Digitizer, recorded, returns_in
from .world import World

CHUNK_RAYS = 1 << 17  # sub-rays that are cast at a time


@dataclass(frozen=True)
class Echoes(ScanReturns):
    """Returns in the order of rays and distances, possibly several for a ray."""

    # (k,): received, see `Surfaces.energy`; None if it is that of the rays as reported.
    energy: Floats | None
    number: Bytes  # (k,): among the reported returns of its pulse, from 1
    returns: Bytes  # (k,): how many these are
    reported: Floats  # (k,): distance with noise; `distance` has none
    # (k,): packed, see `Surfaces.colours`; None if they are those of the rays' ends, or not needed.
    colour: UInts32 | None = None
    cause: Bytes | None = None  # (k,): why they are there; None if all are surfaces
    # (k,): radial velocities, m/s; None if they are those of the rays' ends, or not needed.
    velocity: Floats | None = None
    # (k,): full width at half maximum in the waveform, ns, and height; None without waveforms.
    width: Floats | None = None
    amplitude: Floats | None = None
    waveform: Records | None = None  # (k,): recorded, but for the location


class EchoCaster:
    """Casts the scans of one sensor: each ray by itself, or with sub-rays, materials and noise."""

    def __init__(
        self, number: int, caster: World, scene: Scene, survey: Survey, surfaces: Surfaces
    ) -> None:
        self._caster, self._survey, self._surfaces = caster, survey, surfaces
        self._sensor = survey.carried[number].sensor
        self._returns, self._noise = survey.returns_each[number], survey.noise_each[number]
        seed = self._noise.seed
        self._paths = Paths(caster, scene, survey, self._sensor, surfaces, seed)
        self._air = AirCaster(number, survey, surfaces) if survey.returns_light else None
        # Whether each ray that hits something has one return.
        self._finds = self._returns.waveform != "none"  # returns in waveforms
        self._records = survey.waveform_samples  # of each return
        waves = self._finds or self._records > 0
        self._digitizer = digitizer_of(self._returns, self._sensor) if waves else None
        several = self._returns.subrays > 1 or self._noise.loses or waves
        self._one_each = surfaces.materials.plain and not several
        # Whether its returns are the caster's hits.
        self.plain = self._one_each and not self._noise.displaces
        _, self._gap_m = self._returns.of(self._sensor.optics)
        self._beam = self._returns.beam(self._sensor.optics)
        # The axis that the head turns about, in the carrier's axes: of an oval beam, sub-rays lie
        # across it and towards it.
        axis = turned(np.array([[0.0, 0, 1]]), self._sensor.axes)
        self._axis = turned(axis, survey.carried[number].mount.rotation)[0]
        self._receiver = Receiver(number, survey, caster, scene, surfaces)

    def divided(self, pattern: Pattern, *, by_head: bool = False) -> Pattern | None:
        """Give a repeated pattern its sub-rays, if they are always the same.

        `by_head` says that it is in the axes of the head.
        """
        if self._noise.angle_deg:
            return None
        if len(self._beam) == 1:
            return pattern
        return Pattern(pattern.directions, pattern.origins, self._sub_rays(by_head=by_head))

    def scan(
        self,
        scan: int,
        pattern: Pattern,
        divided: Pattern | None,
        poses: Poses,
        window: tuple[int, int],
        groups: Ints,
        *,
        tally: bool = True,
    ) -> Echoes:
        """Cast scans from number `scan` on: hits in the sensor's range, counted and thinned out.

        `divided` are sub-rays of the pattern, if they were made before; the others are arguments
        of `RayCaster.scan`, where each group is a scan.
        """
        noise, first, rays = self._noise, window[0], window[1] - window[0]
        keys = Keys(scan, groups)
        if self._one_each:
            if noise.angle_deg:
                beams = self._beams(pattern, first, keys, (0, rays))
                pattern, first = beams, 0
            found = self._once(pattern, poses, (first, first + rays), groups, tally)
        else:
            beam = self._beam
            if len(beam) == 1 and not noise.angle_deg:
                divided = pattern
            unit = poses.rays_per_pose or self._sensor.channels
            size = max(1, CHUNK_RAYS // (len(beam) * unit)) * unit
            chunks = []
            for start in range(0, rays, size):
                stop = min(start + size, rays)
                row = (first + start) * len(beam)
                if divided is None:
                    beams, row = self._beams(pattern, first, keys, (start, stop), poses.by_head), 0
                else:
                    beams = divided
                window = (row, row + (stop - start) * len(beam))
                here = poses.part(start, stop, len(beam))
                hits, planes = self._paths.hits(beams, here, window, keys, start, len(beam))
                air = self._in_air(hits, (start, stop), keys, beams, here, row)
                if self._digitizer is not None and air is not None:
                    (hits, planes), air = inserted(hits, planes, air), None
                if self._finds:
                    assert self._digitizer is not None
                    returns = returns_in(hits, self._digitizer, len(beam), planes)
                    returns = self._detected(returns._replace(ray=start + returns.ray), keys)
                else:
                    shown = "all" if self._receiver.adds else self._returns.mode  # more come below
                    report = Report(shown, self._noise, keys, start)
                    returns = separated(hits, self._gap_m, len(beam), planes, air, report)
                if self._receiver.adds:
                    every = np.arange(start, stop)
                    middles = (every - start) * len(beam)
                    returns = self._receiver.added(returns, keys, every, beams, here, middles, row)
                if self._receiver.adds or self._finds:
                    returns = returns.take(chosen(self._heights(returns), self._returns.mode))
                if self._records:
                    returns = self._with_waveforms(returns, hits, start, keys)
                chunks.append(returns)
            found = self._kept(joined(chunks), groups, tally)
        if noise.moves_ranges:
            height = found.energy if found.amplitude is None else found.amplitude
            reported = noise.ranges(found.distance, height, *keys.of(found.ray), found.number)
            found = replace(found, reported=reported)
        return found

    def _beams(
        self,
        pattern: Pattern,
        first: int,
        keys: Keys,
        which: tuple[int, int],
        by_head: bool = False,
    ) -> Pattern:
        """Give some rays, from one to another, sub-rays with noise of angles, ray by ray."""
        rays = np.arange(*which)
        rows = (first + rays) % len(pattern)
        origins = None if pattern.origins is None else pattern.origins[rows]
        offsets = None
        if self._noise.angle_deg:
            offsets = np.stack(self._noise.angles(*keys.of(rays)), axis=1)
        return Pattern(pattern.directions[rows], origins, self._sub_rays(by_head=by_head), offsets)

    def _sub_rays(self, *, by_head: bool) -> SubRays:
        """Return the sub-rays of beams whose directions are in the axes of the head or carrier."""
        beam = self._beam
        axis = np.array([0.0, 0, 1]) if by_head else self._axis
        return SubRays(beam.angles, beam.starts, axis if beam.oval else None)

    def _once(
        self,
        pattern: Pattern,
        poses: Poses,
        window: tuple[int, int],
        groups: Ints,
        tally: bool,
    ) -> Echoes:
        """Cast rays with one return each; compute energies only for kept ones, and if needed."""
        found = self._caster.scan(
            pattern,
            poses,
            window=window,
            t_min=self._sensor.min_range_m,
            t_max=self._sensor.max_range_m,
            keep_every=self._survey.keep_every,
            groups=groups,
            tally=tally,
        )
        energy = colour = velocity = None
        if self._noise.angle_deg:
            origins, directions = rays = poses.rays(pattern, found.ray, window[0])
            times = poses.times(found.ray)
            if self._paths.moving:
                velocity = radial_velocities(
                    self._surfaces, poses, found.ray, rays, found.distance, found.triangle, times
                )
            if self._surfaces.materials.textured:
                ends = directions * found.distance[:, None]
                ends += origins
                colour = self._surfaces.colours(found.triangle, ends, times, poses.ways)
                del ends  # which takes as much memory as the normals
            normals = self._surfaces.normals(found.triangle, times, poses.ways)
            along = products(normals.T, directions.T)
            energy = self._paths.energy(found.triangle, np.abs(along), found.distance, colour)
        one = np.ones(len(found), np.uint8)
        return Echoes(
            **vars(found),
            energy=energy,
            number=one,
            returns=one,
            reported=found.distance,
            colour=colour,
            velocity=velocity,
        )

    def _in_air(
        self,
        hits: Hits,
        rays: tuple[int, int],
        keys: Keys,
        beams: Pattern,
        poses: Poses,
        row: int,
    ) -> AirHits | None:
        """Find hits in the air, which is at rest, before those of surfaces."""
        if self._air is None:
            return None
        air = self._air.found(hits, rays, keys, len(self._beam))
        if air is None or hits.velocity is None:
            return air
        return air._replace(velocity=approach(poses, air.ray, *poses.rays(beams, air.ray, row)))

    def _tally(self, triangle: Ints32) -> Ints:
        surfaces = self._surfaces
        some = triangle[triangle != NO_SURFACE]
        return np.bincount(surfaces.counter(some), minlength=surfaces.counters)

    def _detected(self, returns: Hits, keys: Keys) -> Hits:
        """Select the returns that are detected."""
        if not self._noise.loses:
            return returns
        height = self._heights(returns).energy
        seen = self._noise.detected(height, *keys.of(returns.ray), numbers(returns.ray))
        return returns.take(seen)

    def _heights(self, returns: Hits) -> Hits:
        """Return returns with the heights of their echoes in place of energies."""
        if returns.width is None or self._digitizer is None:
            return returns
        return returns._replace(energy=self._digitizer.amplitude(returns.energy, returns.width))

    def _with_waveforms(self, returns: Hits, hits: Hits, start: int, keys: Keys) -> Hits:
        """Record the waveforms of returns; `start` is the beam of the first sub-rays."""
        assert self._digitizer is not None
        noise = None
        if self._noise.threshold:
            sigma = self._noise.threshold / THRESHOLD_SIGMAS
            here = Keys(keys.scan, keys.begins - start)
            noise = sigma, self._noise.seed, here
        given = returns._replace(ray=returns.ray - start)
        each = len(self._beam)
        waveform = recorded(hits, given, self._digitizer, each, self._records, noise)
        return returns._replace(waveform=waveform)

    def _kept(self, returns: Hits, groups: Ints, tally: bool) -> Echoes:
        """Count the returns of each scan and thin them out."""
        ray = returns.ray
        cuts = np.searchsorted(ray, np.append(groups, np.iinfo(np.int64).max))
        number = numbers(ray)
        each = number + numbers(ray[::-1])[::-1] + 1
        place = np.arange(len(ray)) - np.repeat(cuts[:-1], np.diff(cuts))
        kept = place % self._survey.keep_every == 0
        thinned = returns.take(kept)
        amplitude = None if thinned.width is None else self._heights(thinned).energy
        own = thinned._asdict() | {"ray": thinned.ray.astype(np.uint32)}
        return Echoes(
            **own,
            hits=np.diff(cuts),
            tally=self._tally(returns.triangle) if tally else None,
            instance=np.zeros(len(thinned.ray), np.int32),
            number=np.minimum(number[kept] + 1, 255).astype(np.uint8),
            returns=np.minimum(each[kept], 255).astype(np.uint8),
            reported=thinned.distance,
            amplitude=amplitude,
        )


def digitizer_of(returns: Returns, sensor: Sensor) -> Digitizer:
    """Return what samples the waveforms of a sensor."""
    system_ns = returns.system_ns(sensor.optics)
    return Digitizer(system_ns, returns.sample_ns, returns.waveform == "gaussian")
