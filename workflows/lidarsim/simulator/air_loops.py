"""Loops over pulses that sample the particles and the fog that beams meet: see air.py."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled

from ..base.arrays import Floats
from .pulse_loops import scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform


class ParticleTables(NamedTuple):
    """Particles of one kind that may be detected, see `air.seen_by_range`."""

    counts: Floats  # (k,): cumulative probabilities of 0, 1, … particles in a beam; the last is 1
    by_range: Floats  # (5, shares): see `air.DetectableParticles.by_range`
    step_mm: float  # diameter that exp(-1) of the particles exceed
    exponential: Floats  # quantiles of the exponential distribution


class FogTables(NamedTuple):
    """Fog that may be detected, see `air.FogCells`."""

    begin_m: float
    end_m: float
    cell_m: float
    energies: Floats  # (cells,)
    peaks: Floats  # ((cells + 1) * cells,)


@compiled()
def particles(beam, stop, subrays, tables, keys, reach, hits):
    """Sample the particles of a kind that beams `beam` to `stop` meet, while there is room.

    `reach` is how far the light of sub-rays gets. Writes `SampledHits`; returns the first beam that
    is left, and the number of hits.
    """
    exponential = tables.exponential
    by_range = tables.by_range
    starts = keys.starts
    count = 0
    row = 0
    while beam < stop and count + len(tables.counts) <= len(hits.ray):
        row = scan_row(keys.begins, keys.first + beam, row)
        scan = keys.scan + row
        number = keys.first + beam - keys.begins[row]
        probability = uniform(starts[0], scan, number, 0)
        particle = 0
        while tables.counts[particle] <= probability:
            index = np.int64(bits(starts[1], scan, number, particle) >> SHIFT_TO_INDEX)
            ray = beam * subrays
            if subrays > 1:
                ray += np.int64(bits(starts[2], scan, number, particle) % np.uint64(subrays))
            if by_range[0, index] < reach[ray]:
                rank = uniform(starts[3], scan, number, particle) * by_range[2, index]
                longer = tables.step_mm * exponential[np.int64(rank * len(exponential))]
                diameter = by_range[1, index] + longer
                light = by_range[3, index] * diameter * diameter
                hits.ray[count] = ray
                hits.distance[count] = by_range[0, index]
                hits.energy[count] = subrays * min(light, by_range[4, index])
                count += 1
            particle += 1
        beam += 1
    return beam, count


@compiled()
def fog(subrays, tables, keys, reach, hits):
    """Sample the peaks of fog in beams, as `particles` does; returns the number of hits."""
    cells = len(tables.energies)
    count = 0
    row = 0
    for beam in range(len(reach) // subrays):
        free_cells = (min(reach[beam * subrays], tables.end_m) - tables.begin_m) / tables.cell_m
        if not free_cells >= 1:
            continue
        foggy = cells if free_cells >= cells else np.int64(free_cells)
        row = scan_row(keys.begins, keys.first + beam, row)
        scan = keys.scan + row
        number = keys.first + beam - keys.begins[row]
        probability = foggy + uniform(keys.starts[0], scan, number, 0)
        cell = 0  # with the highest peak, by binary search
        upper = cells
        while cell < upper:
            middle = (cell + upper) // 2
            if tables.peaks[foggy * cells + middle] <= probability:
                cell = middle + 1
            else:
                upper = middle
        share = uniform(keys.starts[1], scan, number, 0)
        hits.ray[count] = beam * subrays
        hits.distance[count] = tables.begin_m + (cell + share) * tables.cell_m
        hits.energy[count] = subrays * tables.energies[cell]
        count += 1
    return count
