"""Compiled loops that sample waveforms and find returns in the samples (waveform.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined, noinline

from ...numerics.arrays import Bools, Floats, Ints
from ...numerics.elementary_loops import exp, log
from ...sensor.optics import CUT
from .pulse_loops import PulseHits, SurfaceMarks, continue_surfaces

# The following lengths are in standard deviations of the system waveform. Hits within this distance
# form one Gaussian in closed form, with errors of 1e-3 in position and height.
NARROW = 0.25
# Two neighboring hits are on one surface if their planes meet within this distance
# (`continue_surfaces`).
MEET = 1.0
# Gaussians that are farther apart are fitted separately.
APART = 6.0
# Gaussians that are closer form one return.
CLOSE = 1.0
# Maximum distance that a fit may move a Gaussian from its initial position.
MOVES = 2.0

FAINT = 0.01  # lowest peak that is found, as a fraction of the waveform's highest sample
CURVED = 0.005  # minimum curvature times variance of a detectable Gaussian, as such a fraction
TOGETHER = 4  # maximum number of Gaussians that are fitted together
STEPS = 30  # maximum number of Levenberg-Marquardt steps
GAIN = 1e-3  # minimum relative reduction of the sum of squares for which a fit continues
ENOUGH = 1e-9  # sum of squares at which a fit stops
HIGHEST = 1.2  # maximum height of a Gaussian, as a fraction of the highest sample
_AREA = math.sqrt(2 * math.pi)  # area of a Gaussian of height and standard deviation 1
_KEY_STEPS = 1024  # subdivisions of a sample for comparing the times of hits and peaks


class WaveMarks(NamedTuple):
    """Marks of hits sorted by beam and distance.

    All arrays have shape (n,).
    """

    solid: Bools  # whether the hit is on a surface rather than in the air
    # Whether a waveform starts at the hit, as set by `divide_into_waveforms`. In waveforms that
    # `search_waveforms` searches, whether a peak starts. `make_returns` clears the marks of hits
    # that continue a surface; then a return starts at each mark.
    starts: Bools
    starts_surface: Bools  # False if the surface of the previous hit continues at the hit
    searched: Bools  # whether the hit is `solid` in a waveform that is too wide for the closed form
    # Always True, because `continue_surfaces` treats each hit as a return before a search.
    all_start: Bools


class WaveHits(NamedTuple):
    """Hits that have energy, sorted by beam and distance."""

    beam: Ints  # (n,): number of the beam in the batch
    pulses: PulseHits  # sub-rays, distances and original rows of the hits
    energy: Floats  # (n,): energy as if the hit's sub-ray carried the whole beam
    velocity: Floats  # (n,): radial, m/s; empty if returns have no velocity
    marks: WaveMarks


class WaveLight(NamedTuple):
    """Times and energies of hits sorted by beam and distance.

    Both arrays have shape (n,).
    """

    time: Floats  # in samples, counted from range 0
    energy: Floats  # height of the hit's Gaussian, which is its share of the beam's energy


class WaveSampling(NamedTuple):
    """Settings for sampling and searching waveforms."""

    sigma: float  # standard deviation of the system waveform, samples
    decomposes: bool  # whether waveforms are decomposed into Gaussians; otherwise peaks are found


class WavePeaks(NamedTuple):
    """Waveform peaks to which hits belong, with one entry for each hit."""

    number: Ints  # (n,): number of the peak, counted over all waveforms; -1 without a peak
    # (3, n): time of the peak in samples from range 0, energy, and width as a multiple of the
    # system waveform's width.
    shapes: Floats


class WaveReturnArrays(NamedTuple):
    """Output arrays for returns.

    All arrays have shape (k,).
    """

    beam: Ints  # number of the beam in the batch
    row: Ints  # row of the strongest hit, in the table of hits before sorting
    distance: Floats  # meters
    energy: Floats
    velocity: Floats  # radial, m/s
    width: Floats  # as a multiple of the system waveform's width

    def first(self, count: int) -> WaveReturnArrays:
        """Return copies of the first `count` returns."""
        return WaveReturnArrays(
            self.beam[:count].copy(),
            self.row[:count].copy(),
            self.distance[:count].copy(),
            self.energy[:count].copy(),
            self.velocity[:count].copy(),
            self.width[:count].copy(),
        )


class FitScratch(NamedTuple):
    """Scratch memory for fitting up to `TOGETHER` Gaussians to up to `length` samples.

    Heights are fractions of the highest sample. Positions and widths are in standard deviations of
    the system waveform.
    """

    # (3, TOGETHER): heights, positions and widths, initially of the guess and finally of the fit.
    best: Floats
    guess: Floats  # (3, TOGETHER): heights, positions and widths of the guess
    trial: Floats  # (3, TOGETHER): heights, positions and widths after the current trial step
    lower: Floats  # (3 * TOGETHER, 3 * TOGETHER): lower triangle of the Cholesky factor
    slopes: Floats  # (3 * TOGETHER, length): derivatives of the sum with respect to each parameter
    new_slopes: Floats  # (3 * TOGETHER, length)
    residual: Floats  # (length,)
    new_residual: Floats  # (length,)
    step: Floats  # (3 * TOGETHER,)


class GaussianScratch(NamedTuple):
    """Scratch memory for decomposing `length` samples into Gaussians.

    All arrays have shape (length,).
    """

    curvature: Floats  # second differences of the samples
    minima: Ints  # samples at which the curvature has a minimum
    x: Floats  # samples of a piece, in standard deviations of the system waveform
    y: Floats  # samples of a piece, as fractions of the highest sample
    time: Floats  # times of the Gaussians, in samples from range 0
    height: Floats  # heights in units of the samples
    width: Floats  # widths in standard deviations of the system waveform
    fit: FitScratch


class SearchScratch(NamedTuple):
    """Scratch memory for waveforms of up to `length` samples."""

    samples: Floats  # (length,)
    peaks: Floats  # (3, length): peaks of a waveform, as in `WavePeaks.shapes`
    stops: Ints  # (length,): ends of the peaks, in 1 / `_KEY_STEPS` samples from the first sample
    gaussians: GaussianScratch


class SampledWaveform(NamedTuple):
    """Samples of part of a waveform."""

    samples: Floats  # (length or more,)
    length: np.int64
    first: np.int64  # number of the first sample, counted from range 0
    top: float  # highest sample
    sigma: float  # standard deviation of the system waveform, samples


@noinline
def _sample(light, begin, stop, first, length, sigma, samples):
    """Write the sum of the pulses of hits `begin` to `stop`. Return the highest sample.

    The first of the `length` samples has the number `first`.
    """
    time = light.time
    energy = light.energy
    pulse_samples = np.int64(2 * CUT * sigma) + 1
    for s in range(length):
        samples[s] = 0.0
    for k in range(begin, stop):
        first_of_pulse = np.int64(math.ceil(time[k] - CUT * sigma))
        for s in range(first_of_pulse - first, first_of_pulse - first + pulse_samples):
            z = (s + first - time[k]) / sigma
            samples[s] += energy[k] * exp(-0.5 * (z * z))
    top = samples[0]
    for s in range(length):
        top = max(top, samples[s])
    return top


@inlined
def _is_peak(samples, s, top):
    w = samples[s]
    return w > samples[s - 1] and w >= samples[s + 1] and w >= FAINT * top


@inlined
def _vertex(samples, peak):
    """Return the shift (in samples) and the height of the Gaussian through three samples."""
    if not (samples[peak - 1] > 0 and samples[peak + 1] > 0):
        return 0.0, samples[peak]
    log_before = log(samples[peak - 1])
    log_peak = log(samples[peak])
    log_behind = log(samples[peak + 1])
    curve = min(log_before - 2 * log_peak + log_behind, -1e-12)
    shift = min(max((log_before - log_behind) / (2 * curve), -0.5), 0.5)
    height = exp(log_peak - (log_behind - log_before) * (log_behind - log_before) / (8 * curve))
    return shift, height


@noinline
def _peaks(wave, stops, peaks):
    """Write the local maxima of a waveform to `stops` and `peaks`. Return their number.

    The arguments are described in `SearchScratch`. Times and heights come from the Gaussian through
    three samples. Energies are the areas between the lowest samples on both sides.
    """
    samples = wave.samples
    length = wave.length
    top = wave.top
    count = 0
    begin = 0
    s = 1
    while s < length - 1:
        if not _is_peak(samples, s, top):
            s += 1
            continue
        peak = s
        last = s
        s += 1
        while s < length:  # advance to the next peak or to the end
            if samples[s] < samples[last]:
                last = s
            if s < length - 1 and _is_peak(samples, s, top):
                break
            s += 1
        area = 0.0
        for k in range(begin, last + 1):
            area += samples[k]
        shift, height = _vertex(samples, peak)
        energy = area / (wave.sigma * _AREA)
        stops[count] = _KEY_STEPS * last
        peaks[0, count] = peak + wave.first + shift
        peaks[1, count] = energy
        peaks[2, count] = energy / height
        begin = last + 1
        count = count + 1
    return count


@noinline
def _residual(x, y, sample_count, gaussians, count, residual, slopes):
    """Write the residual and derivatives of a sum of Gaussians. Return the sum of squares.

    `x` and `y` are `GaussianScratch.x` and `.y`. `gaussians`, `residual` and `slopes` are arrays of
    a `FitScratch`.
    """
    for s in range(sample_count):
        residual[s] = y[s]
    for k in range(count):
        height = gaussians[0, k]
        position = gaussians[1, k]
        width = gaussians[2, k]
        for s in range(sample_count):
            z = (x[s] - position) / width
            bell = exp(-0.5 * (z * z))
            residual[s] -= height * bell
            slope = height * bell * z / width
            slopes[k, s] = bell
            slopes[count + k, s] = slope
            slopes[2 * count + k, s] = slope * z
    cost = 0.0
    for s in range(sample_count):
        cost += residual[s] * residual[s]
    return cost


@noinline
def _solve(lower, size, step):
    """Solve a system by its Cholesky factor. The result replaces the right-hand side `step`."""
    for row in range(size):
        for k in range(row):
            step[row] -= lower[row, k] * step[k]
        step[row] /= lower[row, row]
    for from_last in range(size):
        row = size - 1 - from_last
        for k in range(row + 1, size):
            step[row] -= lower[k, row] * step[k]
        step[row] /= lower[row, row]


@noinline
def _step(residual, slopes, sample_count, count, damping, lower, step):
    """Write a Levenberg-Marquardt step for `count` Gaussians, using a Cholesky factorization."""
    size = 3 * count
    for row in range(size):
        gradient = 0.0
        for s in range(sample_count):
            gradient += slopes[row, s] * residual[s]
        step[row] = gradient
        for column in range(row + 1):
            element = 0.0
            for s in range(sample_count):
                element += slopes[row, s] * slopes[column, s]
            if row == column:
                element = element * (1 + damping) + 1e-12
            for k in range(column):
                element -= lower[row, k] * lower[column, k]
            if row == column:
                lower[row, row] = math.sqrt(max(element, 1e-30))
            else:
                lower[row, column] = element / lower[column, column]
    _solve(lower, size, step)


@noinline
def _fit(x, y, sample_count, count, scratch):
    """Fit a sum of `count` Gaussians to `sample_count` samples by least squares.

    The Levenberg-Marquardt method stops when a step gains too little, or after `STEPS` steps.
    Heights are at most `HIGHEST`, positions are within `MOVES` of the guess, and widths (standard
    deviations) are at least 1. `scratch` is a `FitScratch`, whose `best` holds the guess and
    receives the fit.
    """
    best = scratch.best
    guess = scratch.guess
    trial = scratch.trial
    step = scratch.step
    slopes = scratch.slopes
    new_slopes = scratch.new_slopes
    residual = scratch.residual
    new_residual = scratch.new_residual
    for row in range(3):
        for k in range(count):
            guess[row, k] = best[row, k]
    widest = max((x[sample_count - 1] - x[0]) / (4 * count), 1.5)
    damping = 1e-3
    cost = _residual(
        x, y, sample_count, gaussians=best, count=count, residual=residual, slopes=slopes
    )
    for _ in range(STEPS):
        _step(
            residual,
            slopes,
            sample_count,
            count,
            damping=damping,
            lower=scratch.lower,
            step=step,
        )
        for k in range(count):
            position = best[1, k] + step[count + k]
            trial[0, k] = min(max(best[0, k] + step[k], 0.0), HIGHEST)
            trial[1, k] = min(max(position, guess[1, k] - MOVES), guess[1, k] + MOVES)
            trial[2, k] = min(max(best[2, k] + step[2 * count + k], 1.0), widest)
        new_cost = _residual(
            x,
            y,
            sample_count,
            gaussians=trial,
            count=count,
            residual=new_residual,
            slopes=new_slopes,
        )
        better = new_cost < cost
        converged = better and cost - new_cost <= GAIN * cost
        converged = converged or new_cost <= ENOUGH or damping >= 1e6
        if better:
            for k in range(count):
                best[0, k] = trial[0, k]
                best[1, k] = trial[1, k]
                best[2, k] = trial[2, k]
            residual, new_residual, slopes, new_slopes = new_residual, residual, new_slopes, slopes
            cost = new_cost
        if converged:
            break
        damping = damping / 10 if better else damping * 10


@noinline
def _find_minima(wave, scratch):
    """Write the samples at which the second derivative has a minimum. Return their number.

    Each minimum is the initial guess of a Gaussian. `scratch` is a `GaussianScratch`, whose
    `minima` receive sample indices.
    """
    samples = wave.samples
    length = wave.length
    variance = wave.sigma * wave.sigma
    curvature = scratch.curvature
    curvature[0] = curvature[length - 1] = 0.0
    for s in range(1, length - 1):
        curvature[s] = samples[s - 1] - 2 * samples[s] + samples[s + 1]
    count = 0
    for s in range(1, length - 1):
        minimum = curvature[s] < curvature[s - 1] and curvature[s] <= curvature[s + 1]
        visible = samples[s] >= FAINT * wave.top
        if minimum and visible and -curvature[s] * variance >= CURVED * wave.top:
            scratch.minima[count] = s
            count += 1
    return count


@noinline
def _fit_piece(wave, begin, stop, first, end, scratch):
    """Fit Gaussians `begin` to `stop` of `scratch` to samples `first` to `end` of a waveform.

    This writes `time`, `height` and `width` of `scratch`, a `GaussianScratch`, whose `minima` are
    the initial guess.
    """
    samples = wave.samples
    sigma = wave.sigma
    minima = scratch.minima
    fit = scratch.fit.best
    origin = minima[begin]
    total = 0.0
    area = 0.0
    for s in range(first, end):
        scratch.x[s - first] = (s - origin) / sigma
        scratch.y[s - first] = samples[s] / wave.top
        total += samples[s]
    for k in range(begin, stop):
        s = minima[k]
        fit[0, k - begin] = min(samples[s], -scratch.curvature[s] * (sigma * sigma)) / wave.top
        fit[1, k - begin] = (s - origin) / sigma
        fit[2, k - begin] = 1.0
    _fit(scratch.x, scratch.y, end - first, stop - begin, scratch.fit)
    for k in range(stop - begin):
        area += fit[0, k] * fit[2, k]
    for k in range(begin, stop):
        # Samples do not determine the waveform beyond a cut, so the energies of a piece are scaled
        # to match the sum of its samples.
        scratch.height[k] = fit[0, k - begin] * (total / area / (sigma * _AREA))
        scratch.time[k] = fit[1, k - begin] * sigma + (origin + wave.first)
        scratch.width[k] = fit[2, k - begin]


@noinline
def _sort_gaussians(scratch, count, faintest):
    """Sort Gaussians by time, and drop those lower than `faintest`. Return the remaining number.

    Sorting is needed because a fit may move a Gaussian out of its piece.
    """
    time = scratch.time
    height = scratch.height
    width = scratch.width
    sorted_count = 0
    for k in range(count):
        if not height[k] >= faintest:
            continue
        time_k = time[k]
        height_k = height[k]
        width_k = width[k]
        row = sorted_count
        while row > 0 and time[row - 1] > time_k:
            time[row] = time[row - 1]
            height[row] = height[row - 1]
            width[row] = width[row - 1]
            row -= 1
        time[row] = time_k
        height[row] = height_k
        width[row] = width_k
        sorted_count += 1
    return sorted_count


@noinline
def _join_gaussians(wave, scratch, count, stops, peaks):
    """Merge close Gaussians into peaks, and write these to `stops` and `peaks`.

    Return their number.

    The arguments are described in `SearchScratch`. A peak has the sum, mean and variance of its
    Gaussians, and ends halfway to the next peak.
    """
    sigma = wave.sigma
    time = scratch.time
    height = scratch.height
    width = scratch.width
    peak = 0
    begin = 0
    while begin < count:
        stop = begin
        energy = 0.0
        position = 0.0
        spread = 0.0
        while stop == begin or (stop < count and time[stop] - time[stop - 1] < CLOSE * sigma):
            energy += height[stop] * width[stop]
            position += height[stop] * width[stop] * time[stop]
            stop += 1
        position /= energy
        for k in range(begin, stop):
            offset = (time[k] - position) / sigma
            spread += height[k] * width[k] * (width[k] * width[k] + offset * offset)
        peaks[0, peak] = position
        peaks[1, peak] = energy
        peaks[2, peak] = math.sqrt(spread / energy)
        if peak:
            middle = (peaks[0, peak - 1] + position) / 2
            stops[peak - 1] = np.int64(np.rint(middle * _KEY_STEPS)) - _KEY_STEPS * wave.first
        stops[peak] = _KEY_STEPS * wave.length
        begin = stop
        peak = peak + 1
    return peak


@noinline
def _gaussians(wave, scratch, stops, peaks):
    """Decompose a waveform into Gaussians, with the same arguments and outputs as `_peaks`.

    Each minimum of the second derivative is a Gaussian (after Hofton et al. 2000, who use the
    inflection points around the minima). None is narrower than the system waveform.
    """
    minima = scratch.minima
    count = _find_minima(wave, scratch)
    # Each piece is fitted separately. `begin` is its first Gaussian, and `first` its first sample.
    begin = 0
    first = 0
    while begin < count:
        stop = begin + 1
        while (
            stop < count
            and stop - begin < TOGETHER
            and minima[stop] - minima[stop - 1] <= APART * wave.sigma
        ):
            stop += 1
        end = (minima[stop] + minima[stop - 1]) // 2 + 1 if stop < count else wave.length
        _fit_piece(wave, begin, stop, first, end, scratch)
        begin = stop
        first = end
    count = _sort_gaussians(scratch, count, FAINT * wave.top)
    return _join_gaussians(wave, scratch, count, stops, peaks)


@compiled()
def order_hits(subrays, ray, distance, energy, row):
    """Write the rows of hits with energy to `row`, sorted by beam and distance.

    Hits are in the order of rays, which are sub-rays, with `subrays` per beam. Returns the
    number of hits that have energy, and the maximum number of hits in a beam.
    """
    count = 0
    begin = 0
    max_hits = 0
    beam = -1
    for k in range(len(ray)):
        if not energy[k] > 0:
            continue
        if ray[k] // subrays != beam:
            begin = count
            beam = ray[k] // subrays
        index = count
        while index > begin and distance[row[index - 1]] > distance[k]:
            row[index] = row[index - 1]
            index -= 1
        row[index] = k
        count += 1
        max_hits = max(max_hits, count - begin)
    return count, max_hits


@inlined
def _end_of_beam(beam, begin):
    """Return the row after the last hit of the beam that starts in row `begin`."""
    end = begin + 1
    while end < len(beam) and beam[end] == beam[begin]:
        end += 1
    return end


@inlined
def _has_several_surfaces(starts_surface, first, end):
    """Return whether hits `first` to `end` are on several surfaces."""
    several = False
    for k in range(first + 1, end):
        several |= starts_surface[k]
    return several


@compiled()
def divide_into_waveforms(hits, sigma_m, neighbors, hit_ranges):
    """Divide hits into waveforms. Return the number of waveforms to be searched.

    A waveform starts at the first hit of a beam, and at each hit whose Gaussian does not overlap
    the previous hit's Gaussian. A waveform is searched if its hits are more than `NARROW` standard
    deviations apart and not on one surface.

    `hits` is a `WaveHits`, whose marks `starts`, `starts_surface` and `searched` are written.
    `sigma_m` is the standard deviation of the system waveform in meters of range, and `neighbors`
    is a `pulse_loops.SubrayNeighbors`. `hit_ranges` (k, 2) receives the first hit, and one past
    the last hit, of each waveform to search.
    """
    beam = hits.beam
    distance = hits.pulses.distance
    starts = hits.marks.starts
    starts_surface = hits.marks.starts_surface
    searched = hits.marks.searched
    surface_marks = SurfaceMarks(searched, hits.marks.all_start, starts_surface)
    count = 0
    begin = 0
    while begin < len(beam):
        end = _end_of_beam(beam, begin)
        first_waveform = count
        first = begin
        for k in range(begin, end):
            starts[k] = k == begin or distance[k] - distance[k - 1] > 2 * CUT * sigma_m
            starts_surface[k] = True
            searched[k] = False
        for k in range(begin + 1, end + 1):
            if k < end and not starts[k]:
                continue
            if distance[k - 1] - distance[first] > NARROW * sigma_m:
                hit_ranges[count, 0] = first
                hit_ranges[count, 1] = k
                count += 1
                for hit in range(first, k):
                    searched[hit] = hits.marks.solid[hit]
            first = k
        if count > first_waveform and len(neighbors.pairs):
            continue_surfaces(begin, end, surface_marks, hits.pulses, MEET * sigma_m, neighbors)
        stop_waveform = count
        count = first_waveform
        for waveform in range(first_waveform, stop_waveform):
            if _has_several_surfaces(
                starts_surface, hit_ranges[waveform, 0], hit_ranges[waveform, 1]
            ):
                hit_ranges[count, 0] = hit_ranges[waveform, 0]
                hit_ranges[count, 1] = hit_ranges[waveform, 1]
                count += 1
        begin = end
    return count


def scratch_for(length: int) -> SearchScratch:
    """Allocate scratch memory for waveforms of up to `length` samples."""
    size = 3 * TOGETHER
    fit = FitScratch(
        best=np.empty((3, TOGETHER)),
        guess=np.empty((3, TOGETHER)),
        trial=np.empty((3, TOGETHER)),
        lower=np.empty((size, size)),
        slopes=np.empty((size, length)),
        new_slopes=np.empty((size, length)),
        residual=np.empty(length),
        new_residual=np.empty(length),
        step=np.empty(size),
    )
    gaussians = GaussianScratch(
        curvature=np.empty(length),
        minima=np.empty(length, np.int64),
        x=np.empty(length),
        y=np.empty(length),
        time=np.empty(length),
        height=np.empty(length),
        width=np.empty(length),
        fit=fit,
    )
    peaks = np.empty((3, length))
    return SearchScratch(np.empty(length), peaks, np.empty(length, np.int64), gaussians)


@inlined
def _peak_of_hit(time, wave, stops, count):
    """Return which of `count` peaks a hit at the given time belongs to."""
    key = np.int64(np.rint(time * _KEY_STEPS)) - _KEY_STEPS * wave.first
    number = 0
    while number < count - 1 and stops[number] < key:
        number += 1
    return number


@compiled()
def search_waveforms(light, hit_ranges, sampling, starts, peaks, scratch):
    """Sample waveforms, and write the peak to which each of their hits belongs.

    Waveform k has the hits `hit_ranges[k, 0]` to `hit_ranges[k, 1]` of `light`, a `WaveLight`.
    `sampling` is a `WaveSampling`, and `scratch` a `SearchScratch`. The function writes `peaks`, a
    `WavePeaks`, and marks the first hit of each peak in `starts` (n,).
    """
    sigma = sampling.sigma
    time = light.time
    first_number = 0
    pulse_samples = np.int64(2 * CUT * sigma) + 1
    for waveform in range(len(hit_ranges)):
        begin = hit_ranges[waveform, 0]
        stop = hit_ranges[waveform, 1]
        first = np.int64(math.ceil(time[begin] - CUT * sigma)) - 1
        last_first = np.int64(math.ceil(time[stop - 1] - CUT * sigma))
        length = last_first + pulse_samples - first + 1
        top = _sample(
            light, begin, stop, first, length=length, sigma=sigma, samples=scratch.samples
        )
        wave = SampledWaveform(scratch.samples, length, first, top, sigma)
        if sampling.decomposes:
            count = _gaussians(wave, scratch.gaussians, scratch.stops, scratch.peaks)
        else:
            count = _peaks(wave, scratch.stops, scratch.peaks)
        for k in range(begin, stop):
            number = _peak_of_hit(time[k], wave, scratch.stops, count)
            peaks.number[k] = first_number + number if count else -1
            for row in range(3):
                peaks.shapes[row, k] = scratch.peaks[row, number]
            if k > begin:
                starts[k] = peaks.number[k] != peaks.number[k - 1]
        first_number += count


@compiled()
def make_returns(hits, sigma_m, samples_per_m, neighbors, peaks, output):  # noqa: C901, PLR0914, PLR0915 - a compiled loop
    """Write the returns in the waveforms of beams to `output`.

    `hits` is a `WaveHits`, `peaks` a `WavePeaks`, `neighbors` a `pulse_loops.SubrayNeighbors`, and
    `output` a `WaveReturnArrays`. `sigma_m` is the standard deviation of the system waveform in
    range. A return starts at each mark in `starts`, unless the hit continues a surface, in which
    case the mark is cleared. Hits of a return form one Gaussian with their mean and variance.
    Returns the number of returns.

    Arrays are read from their tuples only once, because numba counts references at each access.
    """
    beam = hits.beam
    energy = hits.energy
    velocity = hits.velocity
    distance = hits.pulses.distance
    number = peaks.number
    starts = hits.marks.starts
    surface_marks = SurfaceMarks(hits.marks.solid, starts, starts)
    count = 0
    begin = 0
    while begin < len(beam):
        end = _end_of_beam(beam, begin)
        has_several_returns = False
        for k in range(begin + 1, end):
            has_several_returns |= starts[k]
        if has_several_returns and len(neighbors.pairs):
            continue_surfaces(begin, end, surface_marks, hits.pulses, MEET * sigma_m, neighbors)
        for k in range(begin + 1, end + 1):
            if k < end and not starts[k]:
                continue
            best = begin
            sum_energy = 0.0
            mean_m = 0.0
            sum_velocity = 0.0
            spread = 0.0
            for hit in range(begin, k):
                sum_energy += energy[hit]
                mean_m += energy[hit] * distance[hit]
                if len(velocity):
                    sum_velocity += energy[hit] * velocity[hit]
                if energy[hit] > energy[best]:
                    best = hit
            mean_m /= sum_energy
            for hit in range(begin, k):
                offset = (distance[hit] - mean_m) / sigma_m
                spread += energy[hit] * (offset * offset)
            output.beam[count] = beam[begin]
            output.row[count] = hits.pulses.row[best]
            output.distance[count] = mean_m
            output.energy[count] = sum_energy / neighbors.subrays
            output.velocity[count] = sum_velocity / sum_energy
            output.width[count] = math.sqrt(1 + spread / sum_energy)
            # If all hits of a peak are in the return, the peak replaces the Gaussian of the hits.
            if number[begin] >= 0 and number[begin] == number[k - 1]:
                output.distance[count] = peaks.shapes[0, begin] / samples_per_m
                output.energy[count] = peaks.shapes[1, begin]
                output.width[count] = peaks.shapes[2, begin]
            count += 1
            begin = k
    return count
