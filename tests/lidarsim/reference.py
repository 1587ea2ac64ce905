"""A pulse's life in plain Python, one pulse at a time: an independent check of compiled loops.

Formulas are those of docs/what-comes-back.md. Sums are added in the order of hits, so that they
have the same bits as those of the loops. `test_reference.py` compares the two.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from lidarsim import Noise
from lidarsim.media.weather import Air, Particles
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.random_numbers import Purpose, quantiles
from lidarsim.pulses.steps.detection import DETECTION, LOSS
from lidarsim.pulses.steps.particles import (
    FOG_CELL,
    FOG_PLACE,
    PARTICLE_DIAMETER,
    PARTICLE_RANGE,
    PARTICLE_SUBRAY,
    PARTICLES,
)
from lidarsim.pulses.steps.range_noise import RANGE
from lidarsim.pulses.steps.spray import SPRAY_DEPTH, SPRAY_DIAMETER, SPRAY_SUBRAY
from lidarsim.pulses.steps.waveform import Digitizer
from lidarsim.sensor.disc import Beam

Vector = tuple[float, ...]
Key = tuple[int, int]  # a scan, and the number of a pulse in it
# The time of the last hit that belongs to it, its own time, both in samples, energy, and width in
# widths of the system waveform.
Echo = tuple[float, float, float, float]
LIGHT_M_NS = 0.299792458
ROOT = math.sqrt(2 * math.pi)


@dataclass(frozen=True, eq=False)
class Hit:
    """A point that light of a sub-ray returns from."""

    subray: int
    distance: float
    energy: float
    surface: int | None  # None in the air
    normal: Vector = (0.0, 0.0, 0.0)
    direction: Vector = (1.0, 0.0, 0.0)
    velocity: float = 0.0


@dataclass(frozen=True, eq=False)
class Return:
    distance: float
    energy: float
    velocity: float
    strongest: Hit
    width: float = 1.0  # of its echo, in widths of the system waveform


def total(numbers: Iterable[float]) -> float:
    """Add numbers one by one: `sum` compensates rounding errors from Python 3.12 on."""
    result = 0.0
    for number in numbers:
        result += number
    return result


def bits(seed: int, purpose: Purpose, key: Key, number: int = 0) -> int:
    """Hash to 64 bits, by the last step of SplitMix64 (Steele, Lea and Flood 2014)."""
    scan, pulse = key
    x = 0
    for step in (seed, purpose.number, scan, 256 * pulse + number + 1):
        x = (x + step * 0x9E3779B97F4A7C15) % 2**64
        x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
        x = (x ^ (x >> 27)) * 0x94D049BB133111EB % 2**64
        x ^= x >> 31
    return x


def uniform(seed: int, purpose: Purpose, key: Key, number: int = 0) -> float:
    return (bits(seed, purpose, key, number) >> 11) / 2**53


def normal(seed: int, purpose: Purpose, key: Key, number: int = 0) -> float:
    return float(quantiles()[bits(seed, purpose, key, number) >> 48])


@cache
def neighbors(subrays: int) -> list[tuple[int, int]]:
    """Pairs of sub-rays with no other in their circle: none sees them at an obtuse angle."""
    places = [complex(*place) for place in Beam.from_divergences(subrays, (2.0, 2.0)).angles]
    return [
        (i, j)
        for i, j in combinations(range(subrays), 2)
        if all(((places[i] - p) * (places[j] - p).conjugate()).real > -1e-9 for p in places)
    ]


def continues(one: Hit, other: Hit, gap: float) -> bool:
    """Whether the planes of two hits meet half-way: within the gap, or half of their distance."""
    half_way = np.add(one.direction, other.direction) / 2

    def range_of_plane(hit: Hit) -> float:
        turned = np.dot(hit.normal, half_way) / np.dot(hit.normal, hit.direction)
        return float(hit.distance / turned) if turned > 0 else math.inf

    miss = abs(range_of_plane(one) - range_of_plane(other))
    return miss <= max(gap, abs(one.distance - other.distance) / 2)


def bridged(hits: list[Hit], gap: float, subrays: int) -> set[int]:
    """Hits that are one return with the hit before, as a surface continues across them.

    Neighboring sub-rays are compared where their light has passed equally many panes.
    """
    placed: dict[tuple[int, int], int] = {}  # {(sub-ray, panes): number of the hit}
    met: Counter[int] = Counter()
    for number, hit in enumerate(hits):
        if hit.surface is not None:
            placed[hit.subray, met[hit.subray]] = number
            met[hit.subray] += 1
    within: set[int] = set()
    for one, other in neighbors(subrays):
        for panes in range(min(met[one], met[other])):
            i, j = sorted((placed[one, panes], placed[other, panes]))
            if continues(hits[i], hits[j], gap):
                within.update(range(i + 1, j + 1))
    return within


def apart(hits: list[Hit], gap: float) -> set[int]:
    """Hits that are farther than a gap behind the hit before."""
    return {k for k, (a, b) in enumerate(pairwise(hits), 1) if b.distance - a.distance > gap}


def divided(hits: list[Hit], begins: Collection[int]) -> Iterator[list[Hit]]:
    for begin, stop in pairwise([0, *sorted(begins), len(hits)]):
        if begin < stop:
            yield hits[begin:stop]


def one_return(hits: list[Hit], subrays: int) -> Return:
    energy = total(hit.energy for hit in hits)
    distance = total(hit.energy * hit.distance for hit in hits) / energy
    velocity = total(hit.energy * hit.velocity for hit in hits) / energy
    strongest = max(hits, key=lambda hit: hit.energy)  # the first of equally strong ones
    return Return(distance, energy / subrays, velocity, strongest)


def separated(hits: list[Hit], gap: float, subrays: int, planes: bool) -> list[Return]:
    """Make returns of hits, which are in the order of sub-rays, those in the air first."""
    hits = [hit for hit in hits if hit.energy > 0]
    places = [hit.distance for hit in hits]
    if hits and max(places) - min(places) > gap:  # else they are one return, in whatever order
        hits.sort(key=lambda hit: hit.distance)
    begins = apart(hits, gap)
    if planes and subrays > 1:
        begins -= bridged(hits, gap, subrays)
    return [one_return(group, subrays) for group in divided(hits, begins)]


def saturated(returns: list[Return], full: float, pulse_m: float, waves: bool) -> list[Return]:
    """Clip returns of a pulse, and join those whose pulses, so long in range, overlap.

    Of joined returns the highest is left, with the edges and the least range of those clipped.
    """
    heights = [one.energy / one.width for one in returns]
    left: dict[int, tuple[Return, float, float]] = {}  # {its number: with its edges}
    for last, one in enumerate(returns):
        usual = one.width * pulse_m / 2
        half = usual * math.sqrt(1 + math.log2(max(heights[last] / full, 1)))
        front = one.distance - half
        back = one.distance + half
        before = [*left][::-1]
        left[last] = replace(one, distance=front + usual) if waves else one, front, back
        for j in before:
            if max(heights[j], heights[last]) <= full or left[j][2] < left[last][1]:
                continue
            high, low = (j, last) if heights[j] >= heights[last] else (last, j)
            (whole, front, back), (more, nearer, farther) = left[high], left.pop(low)
            if heights[low] > full:
                whole = replace(whole, distance=min(whole.distance, more.distance))
                front = min(front, nearer)
                back = max(back, farther)
            left[high] = replace(whole, energy=whole.energy + more.energy), front, back
            last = high
    return [
        replace(one, width=(back - front) / pulse_m) if heights[k] > full else one
        for k, (one, front, back) in left.items()
    ]


def detected(energy: float, number: int, key: Key, noise: Noise) -> bool:
    """Whether a return is neither lost nor too faint; `number` counts those of its pulse."""
    if uniform(noise.seed, LOSS, key, number) < noise.dropout:
        return False
    if not noise.threshold:
        return True
    signal = 5 * (energy / noise.threshold - 1)
    return signal + normal(noise.seed, DETECTION, key, number) > 0


def reported(returns: list[Return], mode: str) -> list[Return]:
    """Select what a mode reports: of equally strong returns the nearest."""
    if mode == "all" or len(returns) < 2:
        return returns
    strongest, second, *_ = sorted(returns, key=lambda one: -one.energy)
    if mode in ("dual", "two_strongest"):
        other = returns[-1] if mode == "dual" and strongest is not returns[-1] else second
        return [one for one in returns if one in (strongest, other)]
    return [{"first": returns[0], "last": returns[-1], "strongest": strongest}[mode]]


def range_of(distance: float, energy: float, number: int, key: Key, noise: Noise) -> float:
    """Range that is reported, with noise and range walk."""
    sigma = noise.range_m + noise.range_per_m * distance
    if noise.range_at_threshold_m:
        weak = noise.range_at_threshold_m * noise.threshold / energy
        sigma = math.sqrt(sigma * sigma + weak * weak)
    if noise.walk_m:
        distance -= noise.walk_m * math.sqrt(2 * math.log(max(energy / noise.threshold, 1)))
    return max(distance + sigma * normal(noise.seed, RANGE, key, number), 0)


def energy_of(back: float, distance: float, extinction: float) -> float:
    """Energy of a surface that sends back so much, 1 if it is white and at right angles."""
    nearer = 10 / distance
    return back * (nearer * nearer) * math.exp(-2 * extinction * distance)


def white(distance: float, air: Air) -> float:
    """Energy of a white surface that fills the beam, as the receiver sees it."""
    share = min(distance / air.overlap_m, 1) ** 2
    return energy_of(1, distance, air.extinction) * share


class Precipitation(NamedTuple):
    """Particles of a kind in the air, as a receiver meets them."""

    kind: Particles
    air: Air
    threshold: float  # energy that is detected


def particles(
    precipitation: Precipitation,
    seed: int,
    key: Key,
    reach: list[float],
    tables: tuple[Floats, Floats],
) -> Iterator[Hit]:
    """Draw the particles that a beam meets, whose sub-rays reach so far.

    Tables are cumulative probabilities of numbers of particles, and quantiles of ranges.
    """
    counts, ranges = tables
    for number in range(sum(counts <= uniform(seed, PARTICLES, key))):
        distance = float(ranges[bits(seed, PARTICLE_RANGE, key, number) >> 48])
        subray = bits(seed, PARTICLE_SUBRAY, key, number) % len(reach)
        if distance < reach[subray]:
            rank = uniform(seed, PARTICLE_DIAMETER, key, number)
            energy = len(reach) * particle(precipitation, distance, rank)
            yield Hit(subray, distance, energy, None)


def particle(precipitation: Precipitation, distance: float, rank: float) -> float:
    """Energy of a particle, by its rank among the larger ones that may be detected."""
    kind, air, threshold = precipitation
    # The least diameter has half of the threshold; diameters above are exponential.
    full = kind.reflectance * white(distance, air)
    wide_mm = 1000 * math.hypot(air.exit_m, air.divergence * distance)
    least = min(wide_mm * math.sqrt(threshold / 2 / full), kind.largest)
    rank *= float(np.float32(-math.expm1(-kind.slope * (kind.largest - least))))
    rank = (math.floor(rank * 65_536) + 0.5) / 65_536
    diameter = least - math.log1p(-rank) / kind.slope
    return full * min(1, diameter / wide_mm) ** 2


Boxes = list[tuple[float, ...]]  # of spray: where a beam enters and leaves each, and its density


def clumps(
    precipitation: Precipitation,
    seed: int,
    key: Key,
    reach: list[float],
    boxes: Boxes,
    table: tuple[float, Floats],
) -> Iterator[Hit]:
    """Draw the clumps that a beam meets in boxes of spray, whose sub-rays reach so far.

    The table says how many it would meet at a density of 1, and has quantiles of their ranges.
    """
    (mean, ranges), number = table, 0

    def depth() -> float:
        place = ((bits(seed, SPRAY_DEPTH, key, number) >> 48) + 0.5) / 65_536
        return float(np.float32(-math.log1p(-place)))

    left = depth()
    for low, high, density in boxes:
        rate = density * (mean / len(ranges))
        place, end = (float((ranges < one).sum()) for one in (low, high))
        while left < (end - place) * rate:
            place += left / rate
            distance = float(ranges[int(place)])
            subray = bits(seed, SPRAY_SUBRAY, key, number) % len(reach)
            rank = uniform(seed, SPRAY_DIAMETER, key, number)
            if distance < reach[subray]:
                energy = len(reach) * particle(precipitation, distance, rank)
                yield Hit(subray, distance, energy, None)
            number += 1
            left = depth()
        left -= (end - place) * rate


def veiled(distance: float, boxes: Boxes, extinction: float) -> float:
    """Share of light that boxes of spray leave on the way to a surface and back."""
    depth = sum(dense * max(min(high, distance) - low, 0) for low, high, dense in boxes)
    return math.exp(-2 * extinction * depth)


class FogCells(NamedTuple):
    """Cells of fog along a beam."""

    begin: float  # range of the first cell, meters
    cell: float  # length of a cell, meters
    # Rows are the probabilities, cumulative, that the highest of so many cells is each.
    peaks: Floats


def fog(
    back_scatter: float, air: Air, seed: int, key: Key, reach: list[float], cells_of_fog: FogCells
) -> Iterator[Hit]:
    """Draw the peak of fog in a beam, as far as the sub-ray in its middle reaches."""
    begin, cell, peaks = cells_of_fog
    cells = min(math.floor((min(reach[0], 1e4) - begin) / cell), len(peaks) - 1)
    if cells >= 1:
        highest = sum(peaks[cells] <= uniform(seed, FOG_CELL, key))
        place = begin + (highest + uniform(seed, FOG_PLACE, key)) * cell
        steps = (begin + (highest + (k + 0.5) / 100) * cell for k in range(100))
        light = math.pi * back_scatter * cell * sum(white(step, air) for step in steps) / 100
        yield Hit(0, place, len(reach) * light, None)


def sampled(hits: list[Hit], sigma: float, per_m: float, subrays: int) -> tuple[int, list[float]]:
    """Sample the waveform of hits, with a sample of 0 to both sides; return the first's number."""
    reach = int(10 * sigma) + 1  # samples of an echo
    firsts = [math.ceil(hit.distance * per_m - 5 * sigma) for hit in hits]
    begin = firsts[0] - 1
    wave = [0.0] * (firsts[-1] + reach + 1 - begin)
    for hit, first in zip(hits, firsts, strict=True):
        for s in range(first, first + reach):
            z = (s - hit.distance * per_m) / sigma
            wave[s - begin] += hit.energy / subrays * math.exp(-z * z / 2)
    return begin, wave


def peaks(begin: int, wave: list[float], sigma: float) -> list[Echo]:
    """Find maxima, of a hundredth of the highest at least, by Gaussians through three samples."""
    end = len(wave)
    least = max(wave) / 100
    tops = [s for s in range(1, end - 1) if wave[s - 1] < wave[s] >= max(wave[s + 1], least)]
    lows = [min(range(a + 1, b), key=wave.__getitem__) for a, b in pairwise([*tops, end])]
    found = []
    for at, before, low in zip(tops, [-1, *lows], lows, strict=False):
        height = wave[at]
        beside = 0.0
        if wave[at - 1] > 0 and wave[at + 1] > 0:  # the parabola through their logarithms
            left, here, right = (math.log(one) for one in wave[at - 1 : at + 2])
            curve = left - 2 * here + right
            slope = (right - left) / 2
            beside = -slope / curve
            height = math.exp(here - slope * slope / (2 * curve))
        # The area between the lowest samples to both sides.
        energy = total(wave[before + 1 : low + 1]) / (sigma * ROOT)
        found.append((begin + low, begin + at + beside, energy, energy / height))
    return found


def waveform_returns(
    hits: list[Hit], digitizer: Digitizer, subrays: int, planes: bool
) -> list[Return]:
    """Make returns of the waveform of a pulse by peaks.

    Hits within a quarter of a standard deviation are one echo with their mean and variance, and so
    are those of one surface; echoes are searched for among others.
    """
    sigma = digitizer.sigma
    sigma_m = digitizer.sigma_ns * LIGHT_M_NS / 2
    per_m = 2 / LIGHT_M_NS / digitizer.sample_ns
    planes = planes and subrays > 1
    found = []
    hits = sorted((hit for hit in hits if hit.energy > 0), key=lambda hit: hit.distance)
    begins = apart(hits, 10 * sigma_m)
    groups = divided(hits, begins)
    wide = [some for some in groups if some[-1].distance - some[0].distance > sigma_m / 4]
    others = [hit for group in wide for hit in group]
    same = {others[k] for k in bridged(others, sigma_m, subrays)} if planes else set()
    echo_of: dict[Hit, Echo] = {}
    for group in wide:
        if not same.issuperset(group[1:]):
            echoes = peaks(*sampled(group, sigma, per_m, subrays), sigma)
            for hit in group:
                behind = [one for one in echoes if hit.distance * per_m <= one[0]]
                echo_of[hit] = (behind or echoes[-1:])[0]
    pairs = enumerate(pairwise(hits), 1)
    begins |= {k for k, (a, b) in pairs if echo_of.get(a) is not echo_of.get(b)}
    if planes:
        begins -= bridged(hits, sigma_m, subrays)
    for group in divided(hits, begins):
        one = one_return(group, subrays)
        echo = echo_of.get(group[0])
        squares = (hit.energy * ((hit.distance - one.distance) / sigma_m) ** 2 for hit in group)
        width = math.sqrt(1 + total(squares) / (one.energy * subrays))
        if echo is not None and echo is echo_of.get(group[-1]):  # it belongs to no other surface
            _, time, energy, width = echo
            one = replace(one, distance=time / per_m, energy=energy)
        found.append(replace(one, width=width))
    return found
