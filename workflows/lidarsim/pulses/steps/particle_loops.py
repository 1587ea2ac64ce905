"""Compiled loops that sample the particles and the fog that beams meet (particles.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined

from ...numerics.arrays import Bytes, Floats, Floats32
from .pulse_loops import scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform


class ParticleTables(NamedTuple):
    """Tables for one kind of detectable particle (`particles.DetectableParticles`)."""

    counts: Floats  # (k,): cumulative probabilities of 0, 1, … particles in a beam; the last is 1
    by_range: Floats32  # (quantiles, 5), as in `particles.DetectableParticles.by_range`
    step_mm: float  # diameter that a fraction exp(-1) of the particles exceeds
    exponential: Floats32  # quantiles of the exponential distribution


class FogTables(NamedTuple):
    """Cells of detectable fog (`particles.FogCells`)."""

    begin_m: float  # range of the first cell
    end_m: float  # range where fog ends
    cell_m: float  # length of a cell
    energies: Floats  # (cells,): energy received from the fog in each cell
    peaks: Floats  # ((cells + 1) * cells,): cumulative probabilities (`particles.FogCells.peaks`)
    guide: Bytes  # (cells + 1, parts): where to search `peaks` (`particles.FogCells.guide`)


@inlined
def particle_energy(by_range, index, quantile, step_mm, exponential):
    """Return the energy that a sensor receives from a particle, if a beam has a single sub-ray.

    `index` is the particle's row in `ParticleTables.by_range`. `quantile`, in [0, 1), is the
    quantile of its diameter among the particles that can be detected at this range.
    """
    rank = quantile * by_range[index, 2]
    diameter = by_range[index, 1] + step_mm * exponential[np.int64(rank * len(exponential))]
    return min(by_range[index, 3] * diameter * diameter, by_range[index, 4])


@compiled()
def sample_particles(beam, stop, subrays, tables, keys, reach, hits):  # noqa: PLR0914 - a compiled loop
    """Sample particles of one kind along beams `beam` to `stop` until `hits` is full.

    `tables` is a `ParticleTables`, `keys` a `RandomKeys`, and `reach` (beams * subrays,) is the
    range that the light of each sub-ray reaches, in meters. The function writes `SampledHits`, and
    returns the first beam that has not been sampled and the number of hits.
    """
    # Inside the loop, numba would count references to the arrays of tuples.
    counts = tables.counts
    by_range = tables.by_range
    exponential = tables.exponential
    states = keys.states
    scan_starts = keys.scan_starts
    hit_ray = hits.ray
    hit_distance = hits.distance
    hit_energy = hits.energy
    count = 0
    scan_index = 0
    while beam < stop and count + len(counts) <= len(hit_ray):
        scan_index = scan_row(scan_starts, keys.first + beam, scan_index)
        number_in_scan = keys.first + beam - scan_starts[scan_index]
        probability = uniform(states[scan_index, 0], number_in_scan, 0)
        particle = 0
        while counts[particle] <= probability:
            index = np.int64(
                bits(states[scan_index, 1], number_in_scan, particle) >> SHIFT_TO_INDEX
            )
            ray = beam * subrays
            if subrays > 1:
                ray += np.int64(
                    bits(states[scan_index, 2], number_in_scan, particle) % np.uint64(subrays)
                )
            quantile = uniform(states[scan_index, 3], number_in_scan, particle)
            energy = particle_energy(by_range, index, quantile, tables.step_mm, exponential)
            hit_ray[count] = ray
            hit_distance[count] = by_range[index, 0]
            hit_energy[count] = subrays * energy
            # The next particle overwrites a particle behind the surface. A branch would be slower.
            count += int(by_range[index, 0] < reach[ray])
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
    parts = tables.guide.shape[1]
    count = 0
    scan_index = 0
    for beam in range(len(reach) // subrays):
        free_cells = (min(reach[beam * subrays], tables.end_m) - tables.begin_m) / tables.cell_m
        if not free_cells >= 1:
            continue
        fog_cells = cells if free_cells >= cells else np.int64(free_cells)
        scan_index = scan_row(keys.scan_starts, keys.first + beam, scan_index)
        number_in_scan = keys.first + beam - keys.scan_starts[scan_index]
        fraction = uniform(states[scan_index, 0], number_in_scan, 0)
        # Row n of the table is n plus the probabilities (`particles.FogCells.peaks`).
        probability = fog_cells + fraction
        cell = np.int64(tables.guide[fog_cells, np.int64(fraction * parts)])
        # The sum may be rounded up to the last probability, which belongs to the last cell.
        while cell < fog_cells - 1 and tables.peaks[fog_cells * cells + cell] <= probability:
            cell += 1
        position_in_cell = uniform(states[scan_index, 1], number_in_scan, 0)
        hits.ray[count] = beam * subrays
        hits.distance[count] = tables.begin_m + (cell + position_in_cell) * tables.cell_m
        hits.energy[count] = subrays * tables.energies[cell]
        count += 1
    return count
