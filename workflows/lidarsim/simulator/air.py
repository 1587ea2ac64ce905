"""Hits in the air: drops, flakes, fog and dust in front of surfaces.

Which particles a beam meets follows from random numbers for each pulse alone. Only those that the
sensor may detect are drawn: their number is Poisson's, their ranges and diameters are quantiles.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Indices, Ints, owned
from ..base.elementary import exp, expm1, geomspace, interp, log1p
from ..base.elementary_scalars import exp_of
from ..columns.table import CAUSES
from ..sensor.materials import MaterialTable
from ..sensor.noise import THRESHOLD_SIGMAS
from ..sensor.random_numbers import Purpose, named_seed, starts
from ..sensor.weather import FAINTEST, FARTHEST_M, NODES, Air, Particles
from ..sensor.weather import reach as reach_of
from .doppler import range_rates_of_origins
from .returns import OF_RETURNS, SURFACE, Keys, Planes, PulseReturns, joined, numbers, unreal
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes
from .surfaces import Surfaces

if TYPE_CHECKING:
    from .pulse_loops import SampledHits
    from .random_loops import RandomKeys

FOG_CELL = Purpose(10, "cell of fog with the highest peak")
FOG_PLACE = Purpose(11, "place of the peak in its cell")
PARTICLES = Purpose(12, "number of particles that a beam meets")
PARTICLE_RANGE = Purpose(13, "range of a particle")
PARTICLE_DIAMETER = Purpose(14, "diameter of a particle")
PARTICLE_SUBRAY = Purpose(15, "sub-ray that meets a particle")
AIR = CAUSES.index("air")
QUANTILES = 1 << 16
TABLES_KEPT = 32  # as a scanner makes its casters again whenever an object is moved
CELLS_MOST = 255  # pulse lengths of fog
TAIL_SIGMAS = 6.0


class DetectableParticles(NamedTuple):
    """Particles of one kind that may be detected."""

    counts: Floats  # (k,): cumulative probabilities of 0, 1, … particles in a beam
    # By range, (5, QUANTILES): distances before which an equal share is, smallest diameters that
    # may be detected, mm, 1 - exp(-slope * (largest - smallest)), energies of a particle of 1 mm,
    # and of a particle that fills the beam.
    by_range: Floats
    step_mm: float  # 1 / slope: diameter that exp(-1) of the particles exceed


class FogCells(NamedTuple):
    """Cells of half a pulse's length of fog that may be detected, from the sensor on."""

    begin_m: float
    cell_m: float
    energy: Floats  # (cells,)
    # Cumulative probabilities that a cell has the highest peak of the first n cells: row n is n
    # plus the probabilities.
    peaks: Floats


class WeatherStep(PulseStep):
    """Finds where rain, snow, fog and dust return light to one sensor.

    Raises
    ------
    LidarError
        If a beam would return from too many particles.
    """

    role = Role.CHANGES
    effects = "Rain", "Snow", "Fog", "Dust"
    reads = "ray", "distance", "triangle", "cause", "velocity"
    writes = *OF_RETURNS, "velocity"
    causes = (AIR,)
    purposes = (
        FOG_CELL, FOG_PLACE, PARTICLES, PARTICLE_RANGE,
        PARTICLE_SUBRAY, PARTICLE_DIAMETER,
    )  # fmt: skip

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        super().__init__(setup, caster, surfaces)
        sensor = setup.sensor
        noise = setup.noise
        survey = setup.survey
        self._seed = noise.seed
        self._wavelength_nm = sensor.optics.wavelength_nm
        air = survey.air(setup.number)
        faintest = FAINTEST * noise.threshold
        begins, ends = reach_of(sensor.min_range_m, sensor.max_range_m)
        self._kinds = [_detectable(air, kind, faintest, begins, ends) for kind in survey.particles]
        names = [f"kind {kind}" if kind else "" for kind in range(len(self._kinds))]
        self._seeds = [named_seed(noise.seed, name) for name in names]
        scatters = survey.backscatter_at(self._wavelength_nm)
        self._fog = _fog_cells(air, scatters, noise.threshold, begins, ends, setup.half_pulse_m)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.survey.returns_light

    @staticmethod
    def added(setup: Setup) -> float:
        """See `PulseStep.added`."""
        scatters = setup.survey.backscatter_at(setup.sensor.optics.wavelength_nm)
        return setup.survey.mean_particles(setup.number) + bool(scatters)

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: of sub-rays, and of hits in the air."""
        return Memory(casting=110 * sizes.subrays + 170 * WeatherStep.added(setup) * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        drawn = self.sampled(returns, (batch.start, batch.stop), batch.keys, batch.subrays_per_beam)
        return returns if drawn is None else in_the_air(self.setup, returns, batch, drawn)

    def sampled(
        self, hits: PulseReturns, beams: tuple[int, int], keys: Keys, each: int
    ) -> PulseReturns | None:
        """Return hits in the air before those of surfaces, of beams with `each` sub-rays.

        Hits are in the order of rays, numbered from the first beam's; None if there can be none.
        """
        first, stop = beams
        count = (stop - first) * each
        reach = reached(self.surfaces.at(self._wavelength_nm), self.surfaces, hits, count)
        parts: list[SampledHits] = []
        for kind, seed in zip(self._kinds, self._seeds, strict=True):
            if kind is not None:
                random = random_keys(seed, self.purposes[2:], keys, first)
                parts += _particles(kind, random, each, reach)
        if self._fog is not None:
            random = random_keys(self._seed, self.purposes[:2], keys, first)
            parts.append(_fog_hits(self._fog, random, each, self._clouded(hits, reach)))
        if not parts:
            return None
        ray, distance, energy = map(np.concatenate, zip(*parts, strict=True))
        drawn = unreal(hits, ray, distance, energy, AIR)
        if len(self._bent(hits)):
            drawn = drawn.take(~self._within(hits, ray, distance))
        if parts[1:] or each > 1:
            drawn = drawn.take(np.argsort(drawn.ray, kind="stable"))
        return drawn

    def _bent(self, hits: PulseReturns) -> Indices:
        """Rows of hits where light is refracted; of each ray the first, third, … are entries."""
        refracts = self.surfaces.at(self._wavelength_nm).refracts
        if not refracts.any():
            return np.zeros(0, np.intp)
        bent = refracts[self.surfaces.kinds(hits.triangle)]
        return np.flatnonzero(bent if hits.cause is None else bent & (hits.cause == SURFACE))

    def _within(self, hits: PulseReturns, ray: Ints, distance: Floats) -> Bools:
        """Whether places on rays are within water or glass, where nothing falls: (n,)."""
        rows = self._bent(hits)
        bent = hits.ray[rows]
        where = hits.distance[rows]
        first, stop = (np.searchsorted(bent, ray, side=side) for side in ("left", "right"))
        count = np.zeros(len(ray), np.int64)
        for number in range(int((stop - first).max(initial=0))):
            some = np.flatnonzero(first + number < stop)
            count[some] += where[first[some] + number] < distance[some]
        return np.asarray(count % 2 == 1)

    def _clouded(self, hits: PulseReturns, reach: Floats) -> Floats:
        """How far fog goes: to surfaces, and to what light is refracted into, but for panes."""
        rows = self._bent(hits)
        if not len(rows):
            return reach
        ray = hits.ray[rows]
        where = hits.distance[rows]
        out = np.full(len(rows), np.inf)
        same = ray[1:] == ray[:-1]
        out[:-1][same] = where[1:][same]
        enters = (numbers(ray) % 2 == 0) & (out - where > self.setup.half_pulse_m)
        reach = reach.copy()
        np.minimum.at(reach, ray[enters], where[enters])
        return reach


def reached(materials: MaterialTable, surfaces: Surfaces, hits: PulseReturns, count: int) -> Floats:
    """How far the light of sub-rays gets, (count,): inf if no surface ends it."""
    ray = hits.ray
    ends = hits.distance
    on = materials.passes
    if on.any():
        ends = np.where(on[surfaces.kinds(hits.triangle)], np.inf, ends)
    if hits.cause is not None:
        rows = np.flatnonzero(hits.cause == SURFACE)
        ray = ray[rows]
        ends = ends[rows]
    reach = np.full(count, np.inf)
    reach[ray] = ends  # of several, the last
    return reach


def in_the_air(
    setup: Setup, returns: PulseReturns, batch: PulseBatch, drawn: PulseReturns
) -> PulseReturns:
    """Leave hits in the air for `SeparationStep`, or insert them for waveforms."""
    if returns.velocity is not None:  # the air is at rest
        rays = batch.subray_poses.rays(batch.beams, drawn.ray, batch.window[0])
        drawn = drawn._replace(
            velocity=range_rates_of_origins(batch.subray_poses, drawn.ray, *rays)
        )
    if setup.in_waveforms or setup.waveform_samples:
        batch.hits, batch.planes = inserted(returns, batch.planes, drawn)
        return batch.hits
    if batch.air is not None:
        drawn = joined([batch.air, drawn])
        drawn = drawn.take(np.argsort(drawn.ray, kind="stable"))
    batch.air = drawn
    return returns


def random_keys(seed: int, purposes: tuple[Purpose, ...], keys: Keys, first: int) -> RandomKeys:
    """Return what the random numbers of beams from number `first` on depend on, for loops."""
    from .random_loops import RandomKeys

    return RandomKeys(starts(seed, *purposes), keys.scan, owned(keys.begins, np.int64), first)


def room_for_hits(size: int) -> SampledHits:
    """Return arrays to which loops write hits."""
    from .pulse_loops import SampledHits

    return SampledHits(np.empty(size, np.int64), np.empty(size), np.empty(size))


def _particles(
    kind: DetectableParticles, random: RandomKeys, each: int, reach: Floats
) -> Iterator[SampledHits]:
    """Yield the hits of particles of a kind, on sub-rays that reach so far, metres."""
    from . import air_loops  # not before: numba takes half a second to import

    beams = len(reach) // each
    tables = air_loops.ParticleTables(kind.counts, kind.by_range, kind.step_mm, exponential())
    beam = 0
    while beam < beams:
        hits = room_for_hits(2 * beams + len(kind.counts))
        beam, count = air_loops.particles(beam, beams, each, tables, random, reach, hits)
        yield hits.first(count)


def _fog_hits(fog: FogCells, random: RandomKeys, each: int, reach: Floats) -> SampledHits:
    """Return the hits of the peaks of fog, on sub-rays that reach so far, metres."""
    from . import air_loops

    hits = room_for_hits(len(reach) // each)
    tables = air_loops.FogTables(fog.begin_m, FARTHEST_M, fog.cell_m, fog.energy, fog.peaks)
    count = air_loops.fog(each, tables, random, reach, hits)
    return hits.first(count)


def inserted(
    hits: PulseReturns, planes: Planes | None, drawn: PulseReturns
) -> tuple[PulseReturns, Planes | None]:
    """Insert hits in the air before the others of their rays."""
    order = np.argsort(np.concatenate([drawn.ray, hits.ray]), kind="stable")
    if planes is not None:
        none = np.zeros((len(drawn.ray), 3))
        normals, directions = (np.concatenate([none, one])[order] for one in planes)
        planes = normals, directions
    return joined([drawn, hits]).take(order), planes


@lru_cache(TABLES_KEPT)
def _detectable(
    air: Air, kind: Particles, energy: float, begins: float, ends: float
) -> DetectableParticles | None:
    """Return the particles that return at least an energy; None if there are none."""
    tables = seen_by_range(air, kind, energy, begins, ends)
    if tables is None:
        return None
    mean, by_range = tables
    return DetectableParticles(_poisson(mean), by_range, 1 / kind.slope)


@lru_cache(TABLES_KEPT)
def seen_by_range(
    air: Air, kind: Particles, energy: float, begins: float, ends: float
) -> tuple[float, Floats] | None:
    """Return how many particles in a beam return enough energy, and their `by_range` table."""
    distance = geomspace(begins, max(ends, begins * 1.001), NODES)
    some = np.flatnonzero(air.rate(kind, energy, distance) > 0)
    if not len(some):
        return None
    last = min(some[-1] + 1, NODES - 1)
    distance = geomspace(distance[max(some[0] - 1, 0)], distance[last], NODES)
    rate = air.rate(kind, energy, distance)
    parts = (rate[1:] + rate[:-1]) / 2 * np.diff(distance)
    sums = np.concatenate([[0.0], np.cumsum(parts)])
    shares = (np.arange(QUANTILES) + 0.5) / QUANTILES
    distance = single(interp(shares, sums / sums[-1], distance))
    smallest = np.minimum(air.smallest(kind, energy, distance), kind.largest)
    larger = -expm1(-kind.slope * (kind.largest - smallest))
    most = kind.reflectance * air.white_energy(distance)
    one = most / (1000 * air.width(distance)) ** 2
    tables = distance, single(smallest), single(larger), single(one), single(most)
    return float(sums[-1]), np.stack(tables)


def _poisson(mean: float) -> Floats:
    """Cumulative probabilities of 0, 1, … events; the last is 1."""
    sums = []
    term = exp_of(-mean)
    count = 0
    total = term
    while count < mean or 1 - total > 1e-9:
        sums.append(total)
        count += 1
        term *= mean / count
        total += term
    return single(np.array([*sums, 1.0]))


@lru_cache(TABLES_KEPT)
def _fog_cells(
    air: Air, scatters: float, threshold: float, begins: float, ends: float, cell: float
) -> FogCells | None:
    """Return the cells of fog that may be detected; None if there are none."""
    count = int(min((ends - begins) / cell, CELLS_MOST)) if cell else 0
    edges = begins + cell * np.arange(count + 1, dtype=np.float64)
    energy = air.cloud(scatters, edges[:-1], edges[1:])
    energy = energy[: int(np.sum(np.cumprod(energy >= FAINTEST * threshold)))]
    if not len(energy):
        return None
    peaks = highest(THRESHOLD_SIGMAS * energy / threshold)
    rows = np.arange(len(energy) + 1)[:, None] + single(peaks)
    return FogCells(begins, cell, single(energy), rows.reshape(-1))


def highest(signals: Floats) -> Floats:
    """Cumulative probabilities of which of the first n signals is the highest: (k + 1, k).

    The signals (k,) fall, and have noise of standard deviation 1. The row of none is 1.
    """
    count = len(signals)
    out = np.ones((count + 1, count))
    # The highest is about the first, or somewhat higher.
    at = signals[0] + np.linspace(-TAIL_SIGMAS, TAIL_SIGMAS, 241)
    normal = NormalDist()
    below = np.array([[normal.cdf(x - signal) for x in at] for signal in signals])
    density = exp(-((at - signals[:, None]) ** 2) / 2) / np.maximum(below, 1e-300)
    product = np.ones(len(at))
    for number in range(1, count + 1):
        product = product * below[number - 1]
        share = (density[:number] * product).sum(axis=1)
        out[number, :number] = np.cumsum(share / share.sum())
        out[number, number - 1 :] = 1.0
    return out


def single(table: Floats) -> Floats:
    """Round to single precision, in which the error functions of C libraries are the same."""
    return table.astype(np.float32).astype(np.float64)


@cache
def exponential() -> Floats:
    """Quantiles of the exponential distribution, of equal shares."""
    shares = (np.arange(QUANTILES) + 0.5) / QUANTILES
    return single(-log1p(-shares))
