"""Hits on rain, snow, fog and dust in front of surfaces.

The particles that a beam meets depend only on the random numbers of its pulse. Only particles that
the sensor may detect are sampled. Their number is drawn from a Poisson distribution, and their
ranges and diameters are drawn as quantiles.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces
from ...columns.table import CAUSES
from ...media.materials import MaterialTable
from ...media.weather import FAINTEST, FARTHEST_M, NODES, Air, Particles, particle_range
from ...numerics.arrays import Bools, Bytes, Floats, Floats32, Indices, Ints, to_writable
from ...numerics.elementary import exp, expm1, geomspace, interp, log1p
from ...numerics.elementary_scalars import exp_of
from ...numerics.random_numbers import Purpose, named_seed, scan_states
from ...sensor.noise import THRESHOLD_SIGMAS
from ..returns import (
    RETURN_COLUMNS,
    SURFACE,
    Keys,
    Planes,
    PulseReturns,
    concatenate_returns,
    number_within_ray,
    returns_without_surface,
)
from .doppler import range_rates_of_origins
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

if TYPE_CHECKING:
    from .pulse_loops import SampledHits
    from .random_loops import RandomKeys

FOG_CELL = Purpose(10, "cell of fog with the highest peak")
FOG_PLACE = Purpose(11, "position of the peak in its cell")
PARTICLES = Purpose(12, "number of particles that a beam hits")
PARTICLE_RANGE = Purpose(13, "range of a particle")
PARTICLE_DIAMETER = Purpose(14, "diameter of a particle")
PARTICLE_SUBRAY = Purpose(15, "sub-ray that hits a particle")
AIR = CAUSES.index("air")
QUANTILES = 1 << 16  # number of equal parts of a distribution in tables
CACHED_TABLES = 32  # cached because a scanner rebuilds its casters whenever an object is moved
MAX_FOG_CELLS = 255  # cells of half a pulse length
PEAK_PARTS = 256  # number of equal parts of [0, 1) in `FogCells.guide`
# Probabilities are summed up to this many standard deviations below and above the highest signal.
TAIL_SIGMAS = 6.0


class DetectableParticles(NamedTuple):
    """Distribution of the detectable particles of one kind."""

    counts: Floats  # (k,): cumulative probabilities of 0, 1, … particles in a beam
    # (QUANTILES, 5), with a row for each equal fraction of the particles by range: ascending
    # distances in meters, smallest detectable diameters in mm, 1 - exp(-slope * (largest -
    # smallest)), energies of a particle of 1 mm, and energies of a particle that fills the beam.
    by_range: Floats32
    step_mm: float  # 1 / slope, the diameter that a fraction exp(-1) of the particles exceeds


class FogCells(NamedTuple):
    """Consecutive cells of detectable fog, each half a pulse long, starting at the sensor."""

    begin_m: float  # range of the first cell
    cell_m: float  # length of a cell
    energy: Floats  # (cells,): energy received from the fog in each cell
    # ((cells + 1) * cells,): row n is n plus the cumulative probabilities that each cell has the
    # highest peak among the first n cells.
    peaks: Floats
    # (cells + 1, PEAK_PARTS): column k of row n is the first cell whose probability in row n of
    # `peaks` exceeds k / PEAK_PARTS.
    guide: Bytes


class WeatherStep(PulseStep):
    """Simulation step that samples the returns of rain, snow, fog and dust.

    Raises
    ------
    LidarError
        If a beam would have returns from too many particles.
    """

    role = Role.CHANGES
    effects = "Rain", "Snow", "Fog", "Dust"
    reads = "ray", "distance", "triangle", "cause", "velocity"
    writes = *RETURN_COLUMNS, "velocity"
    causes = (AIR,)
    purposes = (
        FOG_CELL,
        FOG_PLACE,
        PARTICLES,
        PARTICLE_RANGE,
        PARTICLE_SUBRAY,
        PARTICLE_DIAMETER,
    )

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: SceneSurfaces) -> None:
        super().__init__(setup, caster, surfaces)
        sensor = setup.sensor
        noise = setup.noise
        survey = setup.survey
        self._seed = noise.seed
        self._wavelength_nm = sensor.optics.simulated_nm
        air = survey.air(setup.number)
        faintest = FAINTEST * noise.threshold
        min_range_m, max_range_m = particle_range(sensor.min_range_m, sensor.max_range_m)
        # One entry per kind of particles; None if no particle of a kind can be detected.
        self.detectable_kinds = [
            _detectable(air, kind, faintest, min_range_m, max_range_m) for kind in survey.particles
        ]
        names = [f"kind {kind}" if kind else "" for kind in range(len(self.detectable_kinds))]
        self._seeds = [named_seed(noise.seed, name) for name in names]
        backscatter = survey.backscatter_at(self._wavelength_nm)
        self.fog_cells = _fog_cells(
            air, backscatter, noise.threshold, min_range_m, max_range_m, setup.half_pulse_m
        )

    def with_moved_instances(self, setup: Setup, surfaces: SceneSurfaces) -> PulseStep:
        """Return a copy for a scene in which instances have moved."""
        return self.with_setup(setup, surfaces)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the weather returns light that the sensor may detect."""
        return setup.survey.returns_light and setup.noise.detection_range_m is not None

    @staticmethod
    def added_returns(setup: Setup) -> float:
        """Return the mean number of particle and fog returns per pulse."""
        backscatter = setup.survey.backscatter_at(setup.sensor.optics.simulated_nm)
        return setup.survey.mean_particles(setup.number) + bool(backscatter)

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of sub-rays and of hits in the air, in bytes."""
        return Memory(
            casting=110 * sizes.subrays + 170 * WeatherStep.added_returns(setup) * sizes.beams
        )

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add hits in the air to the hits of a batch."""
        air_hits = self.sample_air_hits(
            returns, (batch.start, batch.stop), batch.keys, batch.subrays_per_beam
        )
        if air_hits is None:
            return returns
        return add_air_hits(self.setup, returns, batch, air_hits)

    def sample_air_hits(
        self, hits: PulseReturns, beams: tuple[int, int], keys: Keys, subrays: int
    ) -> PulseReturns | None:
        """Sample hits on particles and fog in the air in front of surfaces.

        `beams` are the number of the first beam and one past the last, as in `keys`. `hits` are the
        surface hits of these beams, each of which has `subrays` sub-rays. The result is sorted by
        ray, where rays are sub-rays numbered from the first sub-ray of the first beam. It is None
        if neither particles nor fog can be detected.
        """
        first, stop = beams
        count = (stop - first) * subrays
        reach = light_reach(
            self.surfaces.at_wavelength(self._wavelength_nm), self.surfaces, hits, count
        )
        sources: list[SampledHits] = []
        for kind, seed in zip(self.detectable_kinds, self._seeds, strict=True):
            if kind is not None:
                random = random_keys(seed, self.purposes[2:], keys, first)
                sources.append(_particles(kind, random, subrays, reach))
        if self.fog_cells is not None:
            random = random_keys(self._seed, self.purposes[:2], keys, first)
            sources.append(_fog_hits(self.fog_cells, random, subrays, self._fog_ends(hits, reach)))
        if not sources:
            return None
        ray, distance, energy = _concatenate(sources)
        air_hits = returns_without_surface(hits, ray, distance, energy, AIR)
        if len(self._refracting(hits)):
            air_hits = air_hits.take(~self._in_refracting_bodies(hits, ray, distance))
        if sources[1:] or subrays > 1:
            air_hits = air_hits.take(np.argsort(air_hits.ray, kind="stable"))
        return air_hits

    def _refracting(self, hits: PulseReturns) -> Indices:
        """Return the rows of hits on surfaces of refracting water and glass.

        In each ray, the first, third, … of these hits enter a body, and the others leave it.
        """
        refracts = self.surfaces.at_wavelength(self._wavelength_nm).refracts
        if not refracts.any():
            return np.zeros(0, np.intp)
        refracting = refracts[self.surfaces.kinds(hits.triangle)]
        return np.flatnonzero(
            refracting if hits.cause is None else refracting & (hits.cause == SURFACE)
        )

    def _in_refracting_bodies(self, hits: PulseReturns, ray: Ints, distance: Floats) -> Bools:
        """Return whether points at the given distances along rays are inside water or glass."""
        row_indices = self._refracting(hits)
        surface_ray = hits.ray[row_indices]
        surface_distance = hits.distance[row_indices]
        first = np.searchsorted(surface_ray, ray, side="left")
        stop = np.searchsorted(surface_ray, ray, side="right")
        count = np.zeros(len(ray), np.int64)
        for number in range(int((stop - first).max(initial=0))):
            present = np.flatnonzero(first + number < stop)
            count[present] += surface_distance[first[present] + number] < distance[present]
        return np.asarray(count % 2 == 1)

    def _fog_ends(self, hits: PulseReturns, reach: Floats) -> Floats:
        """Return the ranges, in meters, at which the fog on each sub-ray ends.

        Fog ends at `reach`, or where the sub-ray enters water or glass that is thicker than half
        the pulse length. Panes of glass do not end fog.
        """
        row_indices = self._refracting(hits)
        if not len(row_indices):
            return reach
        ray = hits.ray[row_indices]
        surface_distance = hits.distance[row_indices]
        exit_distance = np.full(len(row_indices), np.inf)
        same_ray = ray[1:] == ray[:-1]
        exit_distance[:-1][same_ray] = surface_distance[1:][same_ray]
        enters = (number_within_ray(ray) % 2 == 0) & (
            exit_distance - surface_distance > self.setup.half_pulse_m
        )
        reach = reach.copy()
        np.minimum.at(reach, ray[enters], surface_distance[enters])
        return reach


def light_reach(
    materials: MaterialTable, surfaces: SceneSurfaces, hits: PulseReturns, count: int
) -> Floats:
    """Return the ranges, in meters, that the light of `count` sub-rays reaches.

    This is the distance of a sub-ray's last surface hit. It is inf if there is no hit, or if the
    last surface transmits light. `hits.ray` are sub-rays, numbered from 0.
    """
    ray = hits.ray
    end_distance = hits.distance
    transmits = materials.passes
    if transmits.any():
        end_distance = np.where(transmits[surfaces.kinds(hits.triangle)], np.inf, end_distance)
    if hits.cause is not None:
        row_indices = np.flatnonzero(hits.cause == SURFACE)
        ray = ray[row_indices]
        end_distance = end_distance[row_indices]
    reach = np.full(count, np.inf)
    reach[ray] = end_distance  # the last hit of each ray takes effect
    return reach


def add_air_hits(
    setup: Setup, returns: PulseReturns, batch: PulseBatch, air_hits: PulseReturns
) -> PulseReturns:
    """Add hits in the air to a batch. Return the hits that the next step receives.

    With waveforms, hits in the air are inserted before the hits on surfaces. Otherwise they are
    stored in `batch.air` for `SeparationStep`.
    """
    if returns.velocity is not None:  # the air is static
        first_subray = batch.window[0]  # the batch's first row in `batch.beams`
        rays = batch.subray_poses.rays(batch.beams, air_hits.ray, first_subray)
        air_hits = air_hits._replace(
            velocity=range_rates_of_origins(batch.subray_poses, air_hits.ray, *rays)
        )
    if setup.in_waveforms or setup.waveform_samples:
        batch.hits, batch.planes = insert_air_hits(returns, batch.planes, air_hits)
        return batch.hits
    if batch.air is not None:
        air_hits = concatenate_returns([batch.air, air_hits])
        air_hits = air_hits.take(np.argsort(air_hits.ray, kind="stable"))
    batch.air = air_hits
    return returns


def random_keys(seed: int, purposes: tuple[Purpose, ...], keys: Keys, first: int) -> RandomKeys:
    """Return the keys of random numbers for beams, starting with beam number `first`."""
    from .random_loops import RandomKeys

    scans = keys.scan + np.arange(len(keys.scan_starts))
    states = scan_states(seed, purposes, scans)
    return RandomKeys(states, to_writable(keys.scan_starts, np.int64), first)


def empty_hits(size: int) -> SampledHits:
    """Allocate arrays to which compiled loops write up to `size` hits."""
    from .pulse_loops import SampledHits

    return SampledHits(np.empty(size, np.int64), np.empty(size), np.empty(size))


def _concatenate(tables: list[SampledHits]) -> SampledHits:
    """Concatenate tables of hits. A single table is not copied."""
    if len(tables) == 1:
        return tables[0]
    return type(tables[0])(*map(np.concatenate, zip(*tables, strict=True)))


def _particles(
    detectable: DetectableParticles, random: RandomKeys, subrays: int, reach: Floats
) -> SampledHits:
    """Return hits on particles of one kind, in front of the ends of sub-rays, sorted by beam.

    `reach` (rays,) are the ranges of these ends in meters.
    """
    from . import particle_loops  # imported here: numba takes half a second

    beams = len(reach) // subrays
    tables = particle_loops.ParticleTables(
        detectable.counts, detectable.by_range, detectable.step_mm, exponential_quantiles()
    )
    # Five standard deviations above the mean, so that a single pass usually suffices
    particles = beams * float(np.sum(1 - detectable.counts))
    size = int(particles + 5 * math.sqrt(particles)) + len(detectable.counts)
    parts: list[SampledHits] = []
    beam = 0
    while beam < beams:
        hits = empty_hits(size)
        beam, count = particle_loops.sample_particles(
            beam, beams, subrays=subrays, tables=tables, keys=random, reach=reach, hits=hits
        )
        parts.append(hits.first(count))
    return _concatenate(parts)


def _fog_hits(fog: FogCells, random: RandomKeys, subrays: int, reach: Floats) -> SampledHits:
    """Return the fog hit on the first sub-ray of each beam that meets fog.

    `reach` (rays,) is the range in meters at which fog ends on each sub-ray.
    """
    from . import particle_loops

    hits = empty_hits(len(reach) // subrays)
    tables = particle_loops.FogTables(
        fog.begin_m, FARTHEST_M, fog.cell_m, fog.energy, fog.peaks, fog.guide
    )
    count = particle_loops.sample_fog(subrays, tables, random, reach, hits)
    return hits.first(count)


def insert_air_hits(
    hits: PulseReturns, planes: Planes | None, air_hits: PulseReturns
) -> tuple[PulseReturns, Planes | None]:
    """Insert hits in the air before the surface hits of the same rays.

    They are inserted into both `hits` and `planes`. Planes of hits in the air are 0. If `planes` is
    None, it stays None.
    """
    order = np.argsort(np.concatenate([air_hits.ray, hits.ray]), kind="stable")
    if planes is not None:
        no_vectors = np.zeros((len(air_hits.ray), 3))
        normals, directions = (np.concatenate([no_vectors, vectors])[order] for vectors in planes)
        planes = normals, directions
    return concatenate_returns([air_hits, hits]).take(order), planes


@lru_cache(CACHED_TABLES)
def _detectable(
    air: Air, kind: Particles, min_energy: float, min_range_m: float, max_range_m: float
) -> DetectableParticles | None:
    """Return the distribution of detectable particles, or None if no particle is detectable.

    A particle is detectable if it returns at least `min_energy`.
    """
    tables = seen_by_range(air, kind, min_energy, min_range_m, max_range_m)
    if tables is None:
        return None
    mean, by_range = tables
    return DetectableParticles(_poisson(mean), by_range, 1 / kind.slope)


@lru_cache(CACHED_TABLES)
def seen_by_range(
    air: Air, kind: Particles, min_energy: float, min_range_m: float, max_range_m: float
) -> tuple[float, Floats32] | None:
    """Return the mean number of detectable particles in a beam, and their table by range.

    A particle is detectable if it returns at least `min_energy`. The table is
    `DetectableParticles.by_range`. Returns None if no particle is detectable.
    """
    distance = geomspace(min_range_m, max(max_range_m, min_range_m * 1.001), NODES)
    detectable = np.flatnonzero(air.particle_rate(kind, min_energy, distance) > 0)
    if not len(detectable):
        return None
    last = min(detectable[-1] + 1, NODES - 1)
    distance = geomspace(distance[max(detectable[0] - 1, 0)], distance[last], NODES)
    rate = air.particle_rate(kind, min_energy, distance)
    integrals = (rate[1:] + rate[:-1]) / 2 * np.diff(distance)
    sums = np.concatenate([[0.0], np.cumsum(integrals)])
    fractions = (np.arange(QUANTILES) + 0.5) / QUANTILES
    distance = round_to_single(interp(fractions, sums / sums[-1], distance))
    smallest = np.minimum(air.min_diameter_mm(kind, min_energy, distance), kind.largest)
    larger = -expm1(-kind.slope * (kind.largest - smallest))
    full_beam_energy = kind.reflectance * air.white_energy(distance)
    energy_of_1_mm = full_beam_energy / (1000 * air.beam_diameter(distance)) ** 2
    quantities = [smallest, larger, energy_of_1_mm, full_beam_energy]
    return float(sums[-1]), np.stack([distance, *quantities], axis=1, dtype=np.float32)


def _poisson(mean: float) -> Floats:
    """Return the Poisson probabilities of at most 0, 1, … events. The last probability is 1."""
    sums = []
    term = exp_of(-mean)
    count = 0
    total = term
    while count < mean or 1 - total > 1e-9:
        sums.append(total)
        count += 1
        term *= mean / count
        total += term
    return round_to_single(np.array([*sums, 1.0]))


@lru_cache(CACHED_TABLES)
def _fog_cells(
    air: Air,
    backscatter: float,
    threshold: float,
    min_range_m: float,
    max_range_m: float,
    cell_m: float,
) -> FogCells | None:
    """Return the cells of detectable fog, or None if there are none.

    `backscatter` of fog and dust is in 1/(m sr), and `cell_m` is half the pulse length.
    """
    count = int(min((max_range_m - min_range_m) / cell_m, MAX_FOG_CELLS)) if cell_m else 0
    edges = min_range_m + cell_m * np.arange(count + 1, dtype=np.float64)
    energy = air.backscatter_energy(backscatter, edges[:-1], edges[1:])
    energy = energy[: int(np.sum(np.cumprod(energy >= FAINTEST * threshold)))]
    if not len(energy):
        return None
    peaks = round_to_single(highest_probabilities(THRESHOLD_SIGMAS * energy / threshold))
    guide = [np.searchsorted(row, np.arange(PEAK_PARTS) / PEAK_PARTS, "right") for row in peaks]
    peak_rows = np.arange(len(energy) + 1)[:, None] + peaks
    return FogCells(
        begin_m=min_range_m,
        cell_m=cell_m,
        energy=round_to_single(energy),
        peaks=peak_rows.reshape(-1),
        guide=np.array(guide, np.uint8),
    )


def highest_probabilities(signals: Floats) -> Floats:
    """For each n, return the distribution of which of the first n signals is the highest.

    The probabilities are cumulative. `signals` (k,) are descending, with noise of standard
    deviation 1. Row n of the result (k + 1, k) is for the first n signals, and row 0 is 1.
    """
    count = len(signals)
    probabilities = np.ones((count + 1, count))
    # The highest signal is about as high as the first signal, or somewhat higher.
    levels = signals[0] + np.linspace(-TAIL_SIGMAS, TAIL_SIGMAS, 241)
    normal = NormalDist()
    below = np.array([[normal.cdf(x - signal) for x in levels] for signal in signals])
    density = exp(-((levels - signals[:, None]) ** 2) / 2) / np.maximum(below, 1e-300)
    product = np.ones(len(levels))
    for number in range(1, count + 1):
        product = product * below[number - 1]
        fraction = (density[:number] * product).sum(axis=1)
        probabilities[number, :number] = np.cumsum(fraction / fraction.sum())
        probabilities[number, number - 1 :] = 1.0
    return probabilities


def round_to_single(table: Floats) -> Floats:
    """Round a table to single precision.

    At this precision, the error functions of different C libraries give identical results.
    """
    return table.astype(np.float32).astype(np.float64)


@cache
def exponential_quantiles() -> Floats32:
    """Return the exponential distribution's quantiles at the centers of equal intervals."""
    fractions = (np.arange(QUANTILES) + 0.5) / QUANTILES
    return (-log1p(-fractions)).astype(np.float32)
