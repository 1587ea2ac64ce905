"""Loops over pulses that cross boxes of spray: see spray.py."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, stage

from ..base.arrays import Floats, Ints
from ..base.elementary_loops import exp
from .pulse_loops import beam_of, scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform

CLUMPS_MOST = 255  # clumps of spray that a beam meets: a ray has so many random numbers
_GUIDE_PARTS = 1024  # parts of a table in which a column is looked up


class CellPairs(NamedTuple):
    """Cells of consecutive rays and boxes that may meet, in the order of cells: (p,) each."""

    cell: Ints
    box: Ints
    cell_rays: int  # rays of a cell


class SprayBoxes(NamedTuple):
    """Boxes of spray."""

    boxes: Floats  # (b, 12): middles, and halves of their sides as vectors
    presence_ns: Floats  # (b, 2): when each is there
    density: Floats  # (b,): at first
    lasts_ns: float  # time after which a box is gone
    decay_ns: float  # time in which exp(-1) of the density is left


class Crossings(NamedTuple):
    """Beams in boxes; those of a beam follow each other."""

    beam: Ints  # (k,)
    spans: Floats  # (3, k): where each enters and leaves a box, metres, and the density there


class ClumpTables(NamedTuple):
    """Clumps of spray that may be detected, see `air.seen_by_range`."""

    mean: float  # clumps that a beam would meet at a density of 1
    by_range: Floats  # (5, shares): columns of equal shares of `mean`
    step_mm: float  # diameter that exp(-1) of the drops exceed
    exponential: Floats  # quantiles of the exponential distribution


@compiled()
def cross(rays, times, reach, pairs, spray_boxes, crossings):
    """Write where rays (6, n), which end at `reach` (n,), cross boxes, see `near_boxes`.

    Returns the number of crossings, of which as many are written as there is room for.
    """
    boxes = spray_boxes.boxes
    presence_ns = spray_boxes.presence_ns
    cell = pairs.cell
    count = 0
    begin = 0
    radii = np.zeros(len(boxes))
    for b in range(len(boxes)):
        for side in range(3, 12):
            radii[b] += boxes[b, side] * boxes[b, side]
        radii[b] = 1.001 * np.sqrt(radii[b])
    while begin < len(cell):
        end = begin
        while end < len(cell) and cell[end] == cell[begin]:
            end += 1
        first_ray = cell[begin] * pairs.cell_rays
        for k in range(first_ray, min((cell[begin] + 1) * pairs.cell_rays, len(times))):
            u = rays[3, k]
            v = rays[4, k]
            w = rays[5, k]
            time = times[k]
            for pair in range(begin, end):
                b = pairs.box[pair]
                p = boxes[b, 0] - rays[0, k]
                q = boxes[b, 1] - rays[1, k]
                r = boxes[b, 2] - rays[2, k]
                along = (p * u + q * v) + r * w
                radius = radii[b]
                aside = (p * p + q * q) + r * r - along * along
                if aside > radius * radius or along > reach[k] + radius:
                    continue  # the ray misses the ball around the box
                if not presence_ns[b, 0] <= time <= presence_ns[b, 1]:
                    continue
                enters = 0.0
                leaves = reach[k]
                for side in range(3, 12, 3):
                    x = boxes[b, side]
                    y = boxes[b, side + 1]
                    z = boxes[b, side + 2]
                    half = (x * x + y * y) + z * z
                    along = (x * u + y * v) + z * w
                    aside = (x * p + y * q) + z * r
                    if along != 0:
                        near_side = (aside - half) / along
                        far_side = (aside + half) / along
                        enters = max(enters, min(near_side, far_side))
                        leaves = min(leaves, max(near_side, far_side))
                    elif abs(aside) > half:
                        leaves = -1.0
                if enters < leaves:
                    if count < len(crossings.beam):
                        age_ns = presence_ns[b, 1] - spray_boxes.lasts_ns - time
                        crossings.beam[count] = k
                        crossings.spans[0, count] = enters
                        crossings.spans[1, count] = leaves
                        density = spray_boxes.density[b] * exp(age_ns / spray_boxes.decay_ns)
                        crossings.spans[2, count] = density
                    count += 1
        begin = end
    return count


@stage
def _column(ranges, guide, width_m, distance):
    """Return the first column at a distance or farther; numba's search takes long to compile."""
    column = guide[np.int64(min(distance / width_m, _GUIDE_PARTS))]
    while column < len(ranges) and ranges[column] < distance:
        column += 1
    return column


@compiled()
def clumps(k, crossings, subrays, tables, keys, reach, hits):
    """Sample the clumps of spray that beams meet, from crossing `k` on, while there is room.

    Depths between clumps are exponential. `reach` is how far the light of sub-rays gets. Writes
    `SampledHits`; returns the first crossing that is left, and the number of hits.
    """
    beam = crossings.beam
    spans = crossings.spans
    by_range = tables.by_range
    exponential = tables.exponential
    starts = keys.starts
    ranges = by_range[0]
    guide = np.zeros(_GUIDE_PARTS + 4, np.int64)
    width_m = ranges[-1] / _GUIDE_PARTS
    share = tables.mean / len(ranges)
    for part in range(1, len(guide)):
        guide[part] = _column(ranges, guide[part - 1 :], np.inf, width_m * (part - 1))
    count = 0
    row = 0
    while k < len(beam) and count + CLUMPS_MOST <= len(hits.ray):
        this = beam[k]
        number_in_run = keys.first + this
        row = scan_row(keys.begins, number_in_run, row if keys.begins[row] <= number_in_run else 0)
        scan = keys.scan + row
        number = number_in_run - keys.begins[row]
        clump = 0
        left = exponential[np.int64(bits(starts[0], scan, number, 0) >> SHIFT_TO_INDEX)]
        begin = k
        most = 0.0
        while k < len(beam) and beam[k] == this:  # most beams meet too little, by a rough bound
            first_part = min(spans[0, k] / width_m, _GUIDE_PARTS)
            last_part = min(spans[1, k] / width_m, _GUIDE_PARTS)
            columns = guide[np.int64(last_part) + 3] - guide[np.int64(first_part)]
            most += spans[2, k] * columns
            k += 1
        if left > 1.001 * most * share:
            continue
        k = begin
        while k < len(beam) and beam[k] == this:
            rate = spans[2, k] * share
            end = _column(ranges, guide, width_m, spans[1, k])
            place = np.float64(_column(ranges, guide, width_m, spans[0, k]))  # in columns
            while left < (end - place) * rate and clump < CLUMPS_MOST:
                place += left / rate
                column = np.int64(place)
                ray = this * subrays
                if subrays > 1:
                    ray += np.int64(bits(starts[1], scan, number, clump) % np.uint64(subrays))
                if ranges[column] < reach[ray]:
                    rank = uniform(starts[2], scan, number, clump) * by_range[2, column]
                    longer = tables.step_mm * exponential[np.int64(rank * len(exponential))]
                    diameter = by_range[1, column] + longer
                    light = by_range[3, column] * diameter * diameter
                    hits.ray[count] = ray
                    hits.distance[count] = ranges[column]
                    hits.energy[count] = subrays * min(light, by_range[4, column])
                    count += 1
                clump += 1
                left = exponential[np.int64(bits(starts[0], scan, number, clump) >> SHIFT_TO_INDEX)]
            left -= (end - place) * rate
            k += 1
    return k, count


@compiled()
def veil(crossings, subrays, extinction, reach, hits):
    """Multiply the energies of `SampledHits` of surfaces by what spray before them leaves."""
    beam = crossings.beam
    spans = crossings.spans
    first = np.full(len(reach) // subrays, len(beam))  # crossing of each beam
    for c in range(len(beam)):
        first[beam[c]] = min(c, first[beam[c]])
    for k in range(len(hits.ray)):
        this = beam_of(hits.ray[k], subrays)
        depth = 0.0
        c = first[this]
        while c < len(beam) and beam[c] == this:
            end = min(min(hits.distance[k], reach[hits.ray[k]]), spans[1, c])
            depth += spans[2, c] * max(end - spans[0, c], 0.0)
            c += 1
        if depth > 0:
            hits.energy[k] *= exp(-2 * extinction * depth)
