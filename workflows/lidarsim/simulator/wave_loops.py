"""Loops over pulses that sample their waveforms and find returns in them: see waveform.py."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined, stage

from ..base.arrays import Bools, Floats, Ints
from ..base.elementary_loops import exp, log
from ..sensor.optics import CUT
from .pulse_loops import continue_surfaces

# All in standard deviations of the system waveform.
# Hits within this are one echo in closed form: position and height err by 1e-3 at most.
NARROW = 0.25
MEET = (
    1.0  # planes of neighbouring hits that meet as closely are one surface, see `continue_surfaces`
)
APART = 6.0  # Gaussians that are farther apart are fitted separately
CLOSE = 1.0  # Gaussians that are nearer are one return

FAINT = 0.01  # of the strongest echo around: weaker ones are not found
CURVED = 0.005  # of the greatest curvature of that, likewise for Gaussians
TOGETHER = 4  # Gaussians that are fitted together at most
STEPS = 30  # of Levenberg and Marquardt at most
# share of the squares that a step must gain, and squares that are none
GAIN = 1e-3
ENOUGH = 1e-9
MOVES = 2.0  # standard deviations that a fit may move from its first guess
HIGHEST = 1.2  # of the highest sample: a Gaussian between two samples may be higher
_AREA = math.sqrt(2 * math.pi)


class WaveMarks(NamedTuple):
    """Marks of hits by beam, then by distance: (n,) each."""

    solid: Bools  # whether a surface was hit
    new: Bools  # whether a waveform or a return begins here
    apart: Bools  # whether the surface of the hit before does not continue
    searched: Bools  # whether a surface was hit, of waveforms that may be searched
    every: Bools  # True


class WaveLight(NamedTuple):
    """Light of hits by beam, then by distance: (n,) each."""

    energy: Floats
    velocity: Floats  # radial, m/s; empty if returns have none


class WaveEchoes(NamedTuple):
    """Echoes of hits in waveforms that were searched, see `search`."""

    number: Ints  # (n,): number of the echo of which a hit is part, or -1
    shapes: Floats  # (3, n): time of the echo, samples, its energy and width


class MadeWaveReturns(NamedTuple):
    """Arrays to which returns are written: (k,) each."""

    beam: Ints
    row: Ints  # of the strongest hit
    distance: Floats  # metres
    energy: Floats
    velocity: Floats  # radial, m/s
    width: Floats  # of the system waveform's

    def first(self, count: int) -> MadeWaveReturns:
        """Return copies of the first returns, which a loop has written."""
        return MadeWaveReturns(
            self.beam[:count].copy(),
            self.row[:count].copy(),
            self.distance[:count].copy(),
            self.energy[:count].copy(),
            self.velocity[:count].copy(),
            self.width[:count].copy(),
        )


@stage
def _sampled(when, share, begin, stop, sigma, many, low, w, length):
    """Write the sum of echoes `begin` to `stop` to samples from `low` on; returns the highest."""
    for s in range(length):
        w[s] = 0.0
    for k in range(begin, stop):
        first = np.int64(math.ceil(when[k] - CUT * sigma))
        for s in range(first - low, first - low + many):
            z = (s + low - when[k]) / sigma
            w[s] += share[k] * exp(-0.5 * (z * z))
    top = w[0]
    for s in range(length):
        top = max(top, w[s])
    return top


@stage
def _peaks(w, length, low, top, sigma, until, found):
    """Find local maxima: the last sample of each times 1024, and the echoes; returns how many.

    Their times and heights are those of the Gaussian through three samples, their energies the
    areas between the lowest samples to both sides. Rows of `found` are times, energies and widths.
    """
    count = 0
    begin = 0
    s = 1
    while s < length - 1:
        if not (w[s] > w[s - 1] and w[s] >= w[s + 1] and w[s] >= FAINT * top):
            s += 1
            continue
        at = s
        last = s
        s += 1
        while s < length:  # to the next, or the end
            if w[s] < w[last]:
                last = s
            if s < length - 1 and w[s] > w[s - 1] and w[s] >= w[s + 1] and w[s] >= FAINT * top:
                break
            s += 1
        area = 0.0
        for k in range(begin, last + 1):
            area += w[k]
        height = w[at]
        beside = 0.0
        if w[at - 1] > 0 and w[at + 1] > 0:
            before = log(w[at - 1])
            here = log(w[at])
            behind = log(w[at + 1])
            curve = min(before - 2 * here + behind, -1e-12)
            beside = min(max((before - behind) / (2 * curve), -0.5), 0.5)
            height = exp(here - (behind - before) * (behind - before) / (8 * curve))
        energy = area / (sigma * _AREA)
        until[count] = 1024 * last
        found[0, count] = at + low + beside
        found[1, count] = energy
        found[2, count] = energy / height
        begin = last + 1
        count = count + 1
    return count


@stage
def _misses(x, y, samples, peaks, count, rest, slopes):
    """Write what a sum of Gaussians misses of samples, and its slopes; returns the squares."""
    for s in range(samples):
        rest[s] = y[s]
    for k in range(count):
        height = peaks[0, k]
        place = peaks[1, k]
        width = peaks[2, k]
        for s in range(samples):
            z = (x[s] - place) / width
            bell = exp(-0.5 * (z * z))
            rest[s] -= height * bell
            slope = height * bell * z / width
            slopes[k, s] = bell
            slopes[count + k, s] = slope
            slopes[2 * count + k, s] = slope * z
    cost = 0.0
    for s in range(samples):
        cost += rest[s] * rest[s]
    return cost


@stage
def _step(rest, slopes, samples, count, damping, lower, step):
    """Solve the equations of a step of Levenberg and Marquardt, by Cholesky's method."""
    size = 3 * count
    for row in range(size):
        towards = 0.0
        for s in range(samples):
            towards += slopes[row, s] * rest[s]
        step[row] = towards
        for column in range(row + 1):
            left = 0.0
            for s in range(samples):
                left += slopes[row, s] * slopes[column, s]
            if row == column:
                left = left * (1 + damping) + 1e-12
            for k in range(column):
                left -= lower[row, k] * lower[column, k]
            if row == column:
                lower[row, row] = math.sqrt(max(left, 1e-30))
            else:
                lower[row, column] = left / lower[column, column]
    for row in range(size):
        for k in range(row):
            step[row] -= lower[row, k] * step[k]
        step[row] /= lower[row, row]
    for back in range(size):
        row = size - 1 - back
        for k in range(row + 1, size):
            step[row] -= lower[k, row] * step[k]
        step[row] /= lower[row, row]


@stage
def _fitted(x, y, samples, count, memory):
    """Fit a sum of Gaussians by least squares: heights, places and widths (3, count).

    The method is that of Levenberg and Marquardt; it ends when a step gains nothing, or after
    `STEPS`. Heights are `HIGHEST` at most, places within `MOVES` of the guess, and widths, standard
    deviations, at least 1. The first of `memory` holds the guess, and receives the fit.
    """
    best, guess, trial, lower, slopes, new_slopes, rest, new_rest, step = memory
    for row in range(3):
        for k in range(count):
            guess[row, k] = best[row, k]
    widest = max((x[samples - 1] - x[0]) / (4 * count), 1.5)
    damping = 1e-3
    cost = _misses(x, y, samples, best, count, rest, slopes)
    for _ in range(STEPS):
        _step(rest, slopes, samples, count, damping, lower, step)
        for k in range(count):
            place = best[1, k] + step[count + k]
            trial[0, k] = min(max(best[0, k] + step[k], 0.0), HIGHEST)
            trial[1, k] = min(max(place, guess[1, k] - MOVES), guess[1, k] + MOVES)
            trial[2, k] = min(max(best[2, k] + step[2 * count + k], 1.0), widest)
        now = _misses(x, y, samples, trial, count, new_rest, new_slopes)
        better = now < cost
        ends = better and cost - now <= GAIN * cost
        ends = ends or now <= ENOUGH or damping >= 1e6
        if better:
            for k in range(count):
                best[0, k] = trial[0, k]
                best[1, k] = trial[1, k]
                best[2, k] = trial[2, k]
            rest, new_rest, slopes, new_slopes = new_rest, rest, new_slopes, slopes
            cost = now
        if ends:
            break
        damping = damping / 10 if better else damping * 10


@stage
def _gaussians(w, length, low, top, sigma, until, found, at, lines, memory):
    """Decompose a waveform into Gaussians; as `_peaks`.

    There is one for each minimum of the second derivative (after Hofton et al. 2000, who take the
    points of inflection around them), none narrower than the system waveform.
    """
    bent, x, y, time, height, width = lines
    fit = memory[0]
    bent[0] = bent[length - 1] = 0.0
    for s in range(1, length - 1):
        bent[s] = w[s - 1] - 2 * w[s] + w[s + 1]
    count = 0
    for s in range(1, length - 1):
        low_point = bent[s] < bent[s - 1] and bent[s] <= bent[s + 1]
        if low_point and w[s] >= FAINT * top and -bent[s] * (sigma * sigma) >= CURVED * top:
            at[count] = s
            count += 1
    # of a piece that is fitted by itself: its first Gaussian and sample
    begin = 0
    first = 0
    while begin < count:
        stop = begin + 1
        while stop < count and stop - begin < TOGETHER and at[stop] - at[stop - 1] <= APART * sigma:
            stop += 1
        end = (at[stop] + at[stop - 1]) // 2 + 1 if stop < count else length
        origin = at[begin]
        sums = 0.0
        whole = 0.0
        for s in range(first, end):
            x[s - first] = (s - origin) / sigma
            y[s - first] = w[s] / top
            sums += w[s]
        for k in range(begin, stop):
            fit[0, k - begin] = min(w[at[k]], -bent[at[k]] * (sigma * sigma)) / top
            fit[1, k - begin] = (at[k] - origin) / sigma
            fit[2, k - begin] = 1.0
        _fitted(x, y, end - first, stop - begin, memory)
        for k in range(stop - begin):
            whole += fit[0, k] * fit[2, k]
        for k in range(begin, stop):
            # What is beyond a cut, no sample tells; so energies are those of the piece together.
            height[k] = fit[0, k - begin] * (sums / whole / (sigma * _AREA))
            time[k] = fit[1, k - begin] * sigma + (origin + low)
            width[k] = fit[2, k - begin]
        begin = stop
        first = end
    # Each by its time, also where a fit went beyond its piece; those that are close are one.
    kept = 0
    for k in range(count):
        if not height[k] >= FAINT * top:
            continue
        a = time[k]
        b = height[k]
        c = width[k]
        place = kept
        while place > 0 and time[place - 1] > a:
            time[place] = time[place - 1]
            height[place] = height[place - 1]
            width[place] = width[place - 1]
            place -= 1
        time[place] = a
        height[place] = b
        width[place] = c
        kept += 1
    out = 0
    begin = 0
    while begin < kept:
        stop = begin
        energy = 0.0
        position = 0.0
        spread = 0.0
        while stop == begin or (stop < kept and time[stop] - time[stop - 1] < CLOSE * sigma):
            energy += height[stop] * width[stop]
            position += height[stop] * width[stop] * time[stop]
            stop += 1
        position /= energy
        for k in range(begin, stop):
            off = (time[k] - position) / sigma
            spread += height[k] * width[k] * (width[k] * width[k] + off * off)
        found[0, out] = position
        found[1, out] = energy
        found[2, out] = math.sqrt(spread / energy)
        if out:
            middle = (found[0, out - 1] + position) / 2
            until[out - 1] = np.int64(np.rint(middle * 1024)) - 1024 * low
        until[out] = 1024 * length
        begin = stop
        out = out + 1
    return out


@compiled()
def ordered(each, ray, distance, energy, row):
    """Write rows of hits that have energy, by beam, then by distance; returns how many.

    The second number is that of the hits of a beam, at most.
    """
    count = 0
    begin = 0
    most = 0
    beam = -1
    for k in range(len(ray)):
        if not energy[k] > 0:
            continue
        if ray[k] // each != beam:
            begin = count
            beam = ray[k] // each
        place = count
        while place > begin and distance[row[place - 1, 0]] > distance[k]:
            row[place, 0] = row[place - 1, 0]
            place -= 1
        row[place, 0] = k
        count += 1
        most = max(most, count - begin)
    return count, most


@inlined
def _end(beam, begin):
    """Where the hits of a beam end that begin at a row."""
    end = begin + 1
    while end < len(beam) and beam[end] == beam[begin]:
        end += 1
    return end


@compiled()
def divide(beam, sigma_m, hits, marks, subrays, neighbours, parts):
    """Mark where waveforms begin, and write those to be searched to `parts` (k, 2); how many.

    Hits that are together, and yet not narrow, are searched unless they are on one surface. `beam`
    is that of each of `hits`, which are `PulseHits`; `marks` are `WaveMarks`.
    """
    distance = hits.distance
    new = marks.new
    apart = marks.apart
    searched = marks.searched
    count = 0
    begin = 0
    while begin < len(beam):
        end = _end(beam, begin)
        before = count
        first = begin
        for k in range(begin, end):
            new[k] = k == begin or distance[k] - distance[k - 1] > 2 * CUT * sigma_m
            apart[k] = True
            searched[k] = False
        for k in range(begin + 1, end + 1):
            if k < end and not new[k]:
                continue
            if distance[k - 1] - distance[first] > NARROW * sigma_m:
                parts[count, 0] = first
                parts[count, 1] = k
                count += 1
                for hit in range(first, k):
                    searched[hit] = marks.solid[hit]
            first = k
        if count > before and len(neighbours.pairs):
            continue_surfaces(
                begin, end, marks.every, apart, searched, hits, MEET * sigma_m, subrays, neighbours
            )
        last = count
        count = before
        for part in range(before, last):
            first = parts[part, 0]
            end_of_part = parts[part, 1]
            for k in range(first + 1, end_of_part):
                if apart[k]:
                    parts[count, 0] = first
                    parts[count, 1] = end_of_part
                    count += 1
                    break
        begin = end
    return count


def room_for(length):
    """Make scratch memory for waveforms of so many samples, see `search`."""
    fits = np.empty((3, 3, TOGETHER))
    size = 3 * TOGETHER
    slopes = np.empty((2, size, length))
    rest = np.empty((2, length))
    memory = *fits, np.empty((size, size)), *slopes, *rest, np.empty(size)
    marks = np.empty((2, length), np.int64)
    lines = np.empty((7, length))
    return lines[0], np.empty((3, length)), *marks, (*lines[1:],), memory


@compiled()
def search(when, share, parts, sampling, new, echoes, room):
    """Find the echoes of hits in waveforms, from `parts[k, 0]` to `parts[k, 1]` in each.

    `sampling` is the standard deviation of the system waveform in samples, and whether waveforms
    are decomposed into Gaussians. Writes `WaveEchoes`, and marks hits that begin an echo.
    """
    sigma, decomposes = sampling
    before = 0
    many = np.int64(2 * CUT * sigma) + 1
    w, rows, until, at, lines, memory = room
    for part in range(len(parts)):
        begin = parts[part, 0]
        stop = parts[part, 1]
        low = np.int64(math.ceil(when[begin] - CUT * sigma)) - 1
        length = np.int64(math.ceil(when[stop - 1] - CUT * sigma)) + many - low + 1
        top = _sampled(when, share, begin, stop, sigma, many, low, w, length)
        if decomposes:
            count = _gaussians(w, length, low, top, sigma, until, rows, at, lines, memory)
        else:
            count = _peaks(w, length, low, top, sigma, until, rows)
        for k in range(begin, stop):
            key = np.int64(np.rint(when[k] * 1024)) - 1024 * low
            number = 0
            while number < count - 1 and until[number] < key:
                number += 1
            echoes.number[k] = before + number if count else -1
            for row in range(3):
                echoes.shapes[row, k] = rows[row, number]
            if k > begin:
                new[k] = echoes.number[k] != echoes.number[k - 1]
        before += count


@compiled()
def returns(beam, digitizer_m, hits, marks, subrays, neighbours, light, echoes, made):
    """Make the returns of waveforms of beams, see `waveform.returns_in`; returns their number.

    `digitizer_m` are the standard deviation of the system waveform in range and the samples in a
    metre; `hits` are `PulseHits`, `marks` `WaveMarks`, `light` `WaveLight`, `echoes` `WaveEchoes`,
    and `made` `MadeWaveReturns`.
    """
    sigma_m, per_m = digitizer_m
    energy = light.energy
    velocity = light.velocity
    distance = hits.distance
    number = echoes.number
    new = marks.new
    count = 0
    begin = 0
    while begin < len(beam):
        end = _end(beam, begin)
        several = False
        for k in range(begin + 1, end):
            several |= new[k]
        if several and len(neighbours.pairs):
            continue_surfaces(
                begin, end, new, new, marks.solid, hits, MEET * sigma_m, subrays, neighbours
            )
        for k in range(begin + 1, end + 1):
            if k < end and not new[k]:
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
                off = (distance[hit] - mean_m) / sigma_m
                spread += energy[hit] * (off * off)
            made.beam[count] = beam[begin]
            made.row[count] = hits.row[best, 0]
            made.distance[count] = mean_m
            made.energy[count] = sum_energy / subrays
            made.velocity[count] = sum_velocity / sum_energy
            made.width[count] = math.sqrt(1 + spread / sum_energy)
            # An echo with nothing else on its surface.
            if number[begin] >= 0 and number[begin] == number[k - 1]:
                made.distance[count] = echoes.shapes[0, begin] / per_m
                made.energy[count] = echoes.shapes[1, begin]
                made.width[count] = echoes.shapes[2, begin]
            count += 1
            begin = k
    return count
