"""Compiled loops that sample the particles and the fog that beams meet (particles.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined

from ...numerics.arrays import Floats
from .pulse_loops import scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform


class ParticleTables(NamedTuple):
    """Tables for one kind of detectable particle (`particles.DetectableParticles`)."""

    counts: Floats  # (k,): cumulative probabilities of 0, 1, … particles in a beam; the last is 1
    by_range: Floats  # (5, shares): rows as in `particles.DetectableParticles.by_range`
    step_mm: float  # diameter that a fraction exp(-1) of the particles exceeds
    exponential: Floats  # quantiles of the exponential distribution


class FogTables(NamedTuple):
    """Cells of detectable fog (`particles.FogCells`)."""

    begin_m: float  # range of the first cell
    end_m: float  # range where fog ends
    cell_m: float  # length of a cell
    energies: Floats  # (cells,): energy received from the fog in each cell
    peaks: Floats  # ((cells + 1) * cells,): cumulative probabilities (`particles.FogCells.peaks`)


@inlined
def write_particle(ray, column, quantile, subrays, tables, hits, row):
    """Write a sub-ray's hit on a particle to a row of `hits`, which is a `SampledHits`.

    `column` is the particle's column in `tables.by_range`. `quantile`, in [0, 1), is the quantile
    of its diameter among the particles that can be detected at this range.
    """
    by_range = tables.by_range
    exponential = tables.exponential
    rank = quantile * by_range[2, column]
    excess_mm = tables.step_mm * exponential[np.int64(rank * len(exponential))]
    diameter = by_range[1, column] + excess_mm
    light = by_range[3, column] * diameter * diameter
    hits.ray[row] = ray
    hits.distance[row] = by_range[0, column]
    hits.energy[row] = subrays * min(light, by_range[4, column])


@compiled()
def sample_particles(beam, stop, subrays, tables, keys, reach, hits):
    """Sample particles of one kind along beams `beam` to `stop` until `hits` is full.

    `tables` is a `ParticleTables`, `keys` a `RandomKeys`, and `reach` (beams * subrays,) is the
    range that the light of each sub-ray reaches, in meters. The function writes `SampledHits`, and
    returns the first beam that has not been sampled and the number of hits.
    """
    states = keys.states
    count = 0
    scan_index = 0
    while beam < stop and count + len(tables.counts) <= len(hits.ray):
        scan_index = scan_row(keys.scan_starts, keys.first + beam, scan_index)
        number_in_scan = keys.first + beam - keys.scan_starts[scan_index]
        probability = uniform(states[scan_index, 0], number_in_scan, 0)
        particle = 0
        while tables.counts[particle] <= probability:
            index = np.int64(
                bits(states[scan_index, 1], number_in_scan, particle) >> SHIFT_TO_INDEX
            )
            ray = beam * subrays
            if subrays > 1:
                ray += np.int64(
                    bits(states[scan_index, 2], number_in_scan, particle) % np.uint64(subrays)
                )
            if tables.by_range[0, index] < reach[ray]:
                quantile = uniform(states[scan_index, 3], number_in_scan, particle)
                write_particle(ray, index, quantile, subrays, tables, hits=hits, row=count)
                count += 1
            particle += 1
        beam += 1
    return beam, count


@compiled()
def sample_fog(subrays, tables, keys, reach, hits):
    """Sample the fog return of each beam into `hits`, and return the number of returns.

    `tables` is a `FogTables`, and `keys` and `reach` are as in `sample_particles`. A beam returns
    light from the cell with the highest peak in front of its surface, which is the surface hit by
    its first, central sub-ray. A beam whose surface is within the first cell returns nothing.
    """
    states = keys.states
    cells = len(tables.energies)
    count = 0
    scan_index = 0
    for beam in range(len(reach) // subrays):
        free_cells = (min(reach[beam * subrays], tables.end_m) - tables.begin_m) / tables.cell_m
        if not free_cells >= 1:
            continue
        fog_cells = cells if free_cells >= cells else np.int64(free_cells)
        scan_index = scan_row(keys.scan_starts, keys.first + beam, scan_index)
        number_in_scan = keys.first + beam - keys.scan_starts[scan_index]
        # Row n of the table is n plus the probabilities (`particles.FogCells.peaks`).
        probability = fog_cells + uniform(states[scan_index, 0], number_in_scan, 0)
        cell = 0  # the cell with the highest peak, found by binary search
        upper = cells
        while cell < upper:
            middle = (cell + upper) // 2
            if tables.peaks[fog_cells * cells + middle] <= probability:
                cell = middle + 1
            else:
                upper = middle
        position_in_cell = uniform(states[scan_index, 1], number_in_scan, 0)
        hits.ray[count] = beam * subrays
        hits.distance[count] = tables.begin_m + (cell + position_in_cell) * tables.cell_m
        hits.energy[count] = subrays * tables.energies[cell]
        count += 1
    return count
