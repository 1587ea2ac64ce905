"""Loops over pulses that make, detect and select the returns of hits: see separation.py."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined, stage

from ..base.arrays import Bools, Floats, Ints
from .pulse_loops import PulseHits, beam_of, continue_surfaces, scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform

ALL, FIRST, LAST, STRONGEST, DUAL = range(5)  # modes, as of `separation.MODES`


class SubrayHits(NamedTuple):
    """Hits in the order of sub-rays: (n,) each."""

    ray: Ints  # sub-ray
    distance: Floats  # metres
    energy: Floats
    velocity: Floats  # radial, m/s; empty if returns have none
    solid: Bools  # whether a surface was hit; empty in the air


class Receiver(NamedTuple):
    """What a receiver tells apart, detects and reports."""

    subrays: int  # of a beam
    gap_m: float  # half of the pulse's length: what is closer is one return
    mode: int  # which returns are reported
    dropout: float  # share of returns that are lost
    threshold: float  # energy at which half of the returns are detected; 0 without detection
    threshold_sigmas: float  # the threshold in standard deviations of the noise
    quantiles: Floats  # of the normal distribution; empty without detection


class MadeReturns(NamedTuple):
    """Arrays to which returns are written: (k,) each."""

    beam: Ints
    row: Ints  # of the strongest hit; of hits in the air -1, -2, …
    distance: Floats  # metres
    energy: Floats
    velocity: Floats  # radial, m/s

    def first(self, count: int) -> MadeReturns:
        """Return copies of the first returns, which a loop has written."""
        return MadeReturns(
            self.beam[:count].copy(),
            self.row[:count].copy(),
            self.distance[:count].copy(),
            self.energy[:count].copy(),
            self.velocity[:count].copy(),
        )


class _PulseScratch(NamedTuple):
    """Memory for the hits of a beam, and of the returns that are made of them."""

    energy: Floats
    velocity: Floats
    solid: Bools
    new: Bools  # whether a return begins at a hit
    shown: Bools  # whether the mode reports a return


@stage
def _most_hits(ray, subrays):
    """Return the number of hits of a beam, at most."""
    most = 0
    begin = 0
    end = -1
    for k in range(len(ray)):
        if ray[k] >= end:
            begin = k
            end = (beam_of(ray[k], subrays) + 1) * subrays
        most = max(most, k + 1 - begin)
    return most


@stage
def _room_for_hits(size, subrays):
    """Return memory for `size` hits of a beam."""
    return PulseHits(
        np.empty(size, np.int64),
        np.empty(size),
        np.empty((size, 2), np.int64),
        np.empty(size * subrays, np.int64),
        np.empty(size + 1, np.int64),
    )


@stage
def _scratch(size):
    """Return memory for what else is known of `size` hits of a beam."""
    return _PulseScratch(
        np.empty(size),
        np.empty(size),
        np.empty(size, np.bool_),
        np.empty(size, np.bool_),
        np.empty(size, np.bool_),
    )


@inlined
def _keep(made, k, count):
    """Move a return to the end of those that are kept; returns their number then."""
    made.beam[count] = made.beam[k]
    made.row[count] = made.row[k]
    made.distance[count] = made.distance[k]
    made.energy[count] = made.energy[k]
    made.velocity[count] = made.velocity[k]
    return count + 1


@inlined
def _detected(energy, scan, beam, number, receiver, starts):
    """Return whether a return is detected, as `detection.detected` does."""
    quantiles = receiver.quantiles
    seen = receiver.dropout == 0 or uniform(starts[0], scan, beam, number) >= receiver.dropout
    if seen and receiver.threshold > 0:
        signal = receiver.threshold_sigmas * (energy / receiver.threshold - 1)
        seen = signal + quantiles[0] > 0  # whatever is drawn
        if not seen and signal + quantiles[-1] > 0:
            drawn = np.int64(bits(starts[1], scan, beam, number) >> SHIFT_TO_INDEX)
            seen = signal + quantiles[drawn] > 0
    return seen


@stage
def _mark(energy, begin, stop, mode, shown):
    """Mark what a mode reports of the returns of a pulse; of equally strong ones the nearest."""
    best = begin
    second = -1
    for k in range(begin + 1, stop):
        if energy[k] > energy[best]:
            best = k
    if mode == DUAL and best == stop - 1:
        for k in range(begin, stop - 1):
            if second < 0 or energy[k] > energy[second]:
                second = k
    for k in range(begin, stop):
        shown[k] = mode == ALL or k == second
    shown[begin] |= mode == FIRST
    shown[stop - 1] |= mode in (LAST, DUAL)
    shown[best] |= mode in (STRONGEST, DUAL)


@compiled()
def reported(ray, energy, mode, shown):
    """Mark what a mode reports of returns."""
    begin = 0
    while begin < len(ray):
        stop = begin + 1
        while stop < len(ray) and ray[stop] == ray[begin]:
            stop += 1
        _mark(energy, begin, stop, mode, shown)
        begin = stop


@compiled()
def returns(hits, air, neighbours, receiver, keys, made):
    """Make the returns of beams, see `separation.separated`; returns their number.

    `hits` of surfaces and hits in the `air` are `SubrayHits`; `made` are `MadeReturns`.
    """
    subrays = receiver.subrays
    gap_m = receiver.gap_m
    moves = len(hits.velocity) + len(air.velocity) > 0
    size = _most_hits(hits.ray, subrays) + _most_hits(air.ray, subrays)
    pulse = _room_for_hits(size, subrays)
    energy, velocity, solid, new, shown = _scratch(size)
    row = pulse.row
    distance = pulse.distance
    i = 0
    j = 0
    count = 0
    scan_index = 0
    while i < len(hits.ray) or j < len(air.ray):
        beam = beam_of(hits.ray[i] if i < len(hits.ray) else air.ray[j], subrays)
        if j < len(air.ray):
            beam = min(beam, beam_of(air.ray[j], subrays))
        end = (beam + 1) * subrays
        last = i
        last_air = j
        while last < len(hits.ray) and hits.ray[last] < end:
            last += 1
        while last_air < len(air.ray) and air.ray[last_air] < end:
            last_air += 1
        begin = count
        n = 0
        nearest_m = np.inf
        farthest_m = -np.inf
        best = i
        sum_energy = 0.0
        sum_distance = 0.0
        sum_velocity = 0.0
        for k in range(i, last):
            if hits.energy[k] > 0:
                nearest_m = min(nearest_m, hits.distance[k])
                farthest_m = max(farthest_m, hits.distance[k])
                sum_energy += hits.energy[k]
                sum_distance += hits.energy[k] * hits.distance[k]
                if moves:
                    sum_velocity += hits.energy[k] * hits.velocity[k]
                if n == 0 or hits.energy[k] > hits.energy[best]:
                    best = k
                n += 1
        if j == last_air and farthest_m - nearest_m <= gap_m:  # mostly one surface, and no air
            i = last
            if n == 0:
                continue
            made.beam[count] = beam
            made.row[count] = best
            made.distance[count] = sum_distance / sum_energy
            made.energy[count] = sum_energy / subrays
            if moves:
                made.velocity[count] = sum_velocity / sum_energy
            count += 1
        else:
            n = 0
            nearest_m = np.inf
            farthest_m = -np.inf
            while i < last or j < last_air:  # what is in the air first
                if j < last_air and (i == last or air.ray[j] <= hits.ray[i]):
                    row[n, 0] = -1 - j
                    distance[n] = air.distance[j]
                    energy[n] = air.energy[j]
                    j += 1
                else:
                    row[n, 0] = i
                    distance[n] = hits.distance[i]
                    energy[n] = hits.energy[i]
                    i += 1
                if energy[n] > 0:
                    nearest_m = min(nearest_m, distance[n])
                    farthest_m = max(farthest_m, distance[n])
                    n += 1
            if n == 0:
                continue
            apart = farthest_m - nearest_m > gap_m
            for k in range(1, n if apart else 0):  # few beams hit an edge or graze a surface
                row_k = row[k, 0]
                distance_k = distance[k]
                index = k
                while index > 0 and distance[index - 1] > distance_k:
                    row[index, 0] = row[index - 1, 0]
                    distance[index] = distance[index - 1]
                    index -= 1
                row[index, 0] = row_k
                distance[index] = distance_k
            several = False
            surface_number = -1
            number = 0
            for k in range(n):
                row_k = row[k, 0]
                solid[k] = row_k >= 0 and hits.solid[row_k]
                pulse.subray[k] = hits.ray[row_k] if row_k >= 0 else air.ray[-1 - row_k]
                energy[k] = hits.energy[row_k] if row_k >= 0 else air.energy[-1 - row_k]
                if moves:
                    velocity[k] = hits.velocity[row_k] if row_k >= 0 else air.velocity[-1 - row_k]
                new[k] = k == 0 or (apart and distance[k] - distance[k - 1] > gap_m)
                number += int(new[k])
                if solid[k]:  # surfaces can only continue if they are in several returns
                    several |= surface_number >= 0 and surface_number != number
                    surface_number = number
            if several and len(neighbours.pairs):
                continue_surfaces(0, n, new, new, solid, pulse, gap_m, subrays, neighbours)
            k = 0
            while k < n:  # a return
                best = k
                sum_energy = 0.0
                sum_distance = 0.0
                sum_velocity = 0.0
                while True:
                    sum_energy += energy[k]
                    sum_distance += energy[k] * distance[k]
                    if moves:
                        sum_velocity += energy[k] * velocity[k]
                    if energy[k] > energy[best]:
                        best = k
                    k += 1
                    if k == n or new[k]:
                        break
                made.beam[count] = beam
                made.row[count] = row[best, 0]
                made.distance[count] = sum_distance / sum_energy
                made.energy[count] = sum_energy / subrays
                if moves:
                    made.velocity[count] = sum_velocity / sum_energy
                count += 1
        stop = count
        if len(keys.starts):  # those that are detected
            scan_index = scan_row(keys.begins, keys.first + beam, scan_index)
            scan = keys.scan + scan_index
            number_in_scan = keys.first + beam - keys.begins[scan_index]
            count = begin
            for k in range(begin, stop):
                number = k - begin
                if _detected(made.energy[k], scan, number_in_scan, number, receiver, keys.starts):
                    count = _keep(made, k, count)
            stop = count
        if receiver.mode != ALL and stop - begin > 1:
            for k in range(begin, stop):
                energy[k - begin] = made.energy[k]
            _mark(energy, 0, stop - begin, receiver.mode, shown)
            count = begin
            for k in range(begin, stop):
                if shown[k - begin]:
                    count = _keep(made, k, count)
    return count
