"""Compiled loops over pulses that cross boxes of spray (spray.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined, noinline

from ...numerics.arrays import Floats, Floats32, Ints
from ...numerics.elementary_loops import exp
from .particle_loops import particle_energy
from .pulse_loops import beam_of, scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform

MAX_CLUMPS = 255  # maximum number of clumps that a beam can meet, limited by its random numbers
_GUIDE_PARTS = 1024  # number of parts of a lookup table for columns


class BoxPairs(NamedTuple):
    """Pairs of a box and a cell of rays that may meet it, sorted by cell.

    A cell consists of consecutive rays.
    """

    cell: Ints  # (p,): number of the cell
    box: Ints  # (p,): row of `SprayBoxes`
    cell_rays: int  # number of rays per cell


class SprayBoxes(NamedTuple):
    """Boxes of spray."""

    boxes: Floats  # (b, 12): center and half of the sides as vectors, in the scene frame, meters
    # (b, 2): first and last time of each box. The last time is `lasts_ns` after the box was
    # created.
    presence_ns: Floats
    # (b,): density when the box is created, as a multiple of `Survey.spray_g_m3`.
    density: Floats
    lasts_ns: float  # lifetime of a box
    decay_ns: float  # time until exp(-1) of the density is left


class BoxCrossings(NamedTuple):
    """Intervals in which beams are inside boxes.

    The crossings of a beam are consecutive.
    """

    beam: Ints  # (k,): number of the beam in the batch
    # (3, k): ranges in meters at which the beam enters and leaves the box, and the density of the
    # box at that time as a multiple of `Survey.spray_g_m3`.
    spans: Floats


class ClumpTables(NamedTuple):
    """Tables of detectable clumps of spray (`particles.DetectableParticles`)."""

    mean: float  # detectable clumps per beam in air of density `Survey.spray_g_m3`
    by_range: Floats32  # (columns, 5): columns of air, each with an equal fraction of `mean`
    step_mm: float  # diameter that a fraction exp(-1) of the drops exceeds
    exponential: Floats32  # quantiles of the exponential distribution


@noinline
def _ball_radii(boxes):
    radii = np.zeros(len(boxes))
    for b in range(len(boxes)):
        for side in range(3, 12):
            radii[b] += boxes[b, side] * boxes[b, side]
        radii[b] = 1.001 * np.sqrt(radii[b])
    return radii


@inlined
def _span_in_box(boxes, b, to_middle, direction, reach_m):  # noqa: PLR0914 - a compiled loop
    """Return the distances, in meters, at which a ray enters and leaves a box.

    The distances are ascending only if the ray meets the box. `to_middle` is the vector from the
    ray's origin to the center of the box.
    """
    p, q, r = to_middle
    u, v, w = direction
    enters = 0.0
    leaves = reach_m
    for side in range(3, 12, 3):
        x = boxes[b, side]
        y = boxes[b, side + 1]
        z = boxes[b, side + 2]
        half = (x * x + y * y) + z * z
        pace = (x * u + y * v) + z * w
        middle = (x * p + y * q) + z * r
        if pace != 0:
            near_side = (middle - half) / pace
            far_side = (middle + half) / pace
            enters = max(enters, min(near_side, far_side))
            leaves = min(leaves, max(near_side, far_side))
        elif abs(middle) > half:
            leaves = -1.0
    return enters, leaves


@inlined
def _write_crossing(k, b, time, span, spray_boxes, crossings, count):
    """Write the crossing of ray `k` through box `b` to row `count` if there is room for it.

    `span` is the result of `_span_in_box`, and `time` is the time of the ray in nanoseconds.
    """
    if count < len(crossings.beam):
        negative_age_ns = spray_boxes.presence_ns[b, 1] - spray_boxes.lasts_ns - time
        enters, leaves = span
        crossings.beam[count] = k
        crossings.spans[0, count] = enters
        crossings.spans[1, count] = leaves
        density = spray_boxes.density[b] * exp(negative_age_ns / spray_boxes.decay_ns)
        crossings.spans[2, count] = density


@compiled()
def find_crossings(rays, times, reach, pairs, spray_boxes, crossings):  # noqa: PLR0914 - a compiled loop
    """Write the crossings of rays through boxes, and return their number.

    `rays` (6, n) are origins and directions, `times` (n,) are in nanoseconds, and `reach` (n,) are
    the lengths of the rays in meters. `pairs` is a `BoxPairs`, and `spray_boxes` a `SprayBoxes`.
    All crossings are counted, but only as many are written as `crossings` can hold.
    """
    boxes = spray_boxes.boxes
    presence_ns = spray_boxes.presence_ns
    cell = pairs.cell
    count = 0
    begin = 0
    radii = _ball_radii(boxes)
    while begin < len(cell):
        end = begin
        while end < len(cell) and cell[end] == cell[begin]:
            end += 1
        first_ray = cell[begin] * pairs.cell_rays
        for k in range(first_ray, min((cell[begin] + 1) * pairs.cell_rays, len(times))):
            u = rays[3, k]
            v = rays[4, k]
            w = rays[5, k]
            for pair in range(begin, end):
                b = pairs.box[pair]
                p = boxes[b, 0] - rays[0, k]
                q = boxes[b, 1] - rays[1, k]
                r = boxes[b, 2] - rays[2, k]
                ahead = (p * u + q * v) + r * w
                radius = radii[b]
                aside_square = (p * p + q * q) + r * r - ahead * ahead
                if aside_square > radius * radius or ahead > reach[k] + radius:
                    continue  # the ray misses the bounding sphere of the box
                if not presence_ns[b, 0] <= times[k] <= presence_ns[b, 1]:
                    continue
                span = _span_in_box(boxes, b, (p, q, r), (u, v, w), reach[k])
                if span[0] < span[1]:
                    _write_crossing(
                        k, b, times[k], span, spray_boxes, crossings=crossings, count=count
                    )
                    count += 1
        begin = end
    return count


@noinline
def _column(ranges, guide, part_m, distance):
    """Return the first column whose range is at least the given distance.

    `ranges` are the ascending ranges of the columns in meters. The search starts at the column that
    `guide` has for the distance (`_guide`), where `part_m` is the length of a guide part. A search
    by numba would take long to compile.
    """
    column = guide[np.int64(min(distance / part_m, _GUIDE_PARTS))]
    while column < len(ranges) and ranges[column] < distance:
        column += 1
    return column


@noinline
def _guide(ranges, part_m):
    """Return a lookup table of the columns at which searches for a distance start.

    `guide[k]` is the first column at ``(k - 1) * part_m`` or farther. It is one part early, so that
    a rounded distance never starts its search too late.
    """
    guide = np.zeros(_GUIDE_PARTS + 4, np.int64)
    for part in range(1, len(guide)):
        guide[part] = _column(ranges, guide[part - 1 :], np.inf, part_m * (part - 1))
    return guide


@compiled()
def sample_clumps(k, crossings, subrays, tables, keys, reach, hits):  # noqa: PLR0914, PLR0915 - a compiled loop
    """Sample clumps of spray on beams, starting at crossing `k`, until `hits` is full.

    `tables` is a `ClumpTables`, `keys` a `RandomKeys`, and `reach` (beams * subrays,) is the range
    in meters that the light of each sub-ray reaches. The depth between two clumps, measured as the
    mean number of clumps in it, is exponentially distributed. The function writes `SampledHits`,
    and returns the first crossing that has not been sampled and the number of hits.
    """
    beam = crossings.beam
    spans = crossings.spans
    exponential = tables.exponential
    states = keys.states
    ranges = tables.by_range[:, 0]
    part_m = ranges[-1] / _GUIDE_PARTS
    clumps_per_column = tables.mean / len(ranges)
    guide = _guide(ranges, part_m)
    count = 0
    scan_index = 0
    while k < len(beam) and count + MAX_CLUMPS <= len(hits.ray):
        this_beam = beam[k]
        key = keys.first + this_beam
        scan_index = scan_row(
            keys.scan_starts, key, scan_index if keys.scan_starts[scan_index] <= key else 0
        )
        number_in_scan = key - keys.scan_starts[scan_index]
        clump = 0
        depth = exponential[
            np.int64(bits(states[scan_index, 0], number_in_scan, 0) >> SHIFT_TO_INDEX)
        ]
        begin = k
        max_depth = 0.0  # number of columns
        while k < len(beam) and beam[k] == this_beam:
            first_part = min(spans[0, k] / part_m, _GUIDE_PARTS)
            last_part = min(spans[1, k] / part_m, _GUIDE_PARTS)
            columns = guide[np.int64(last_part) + 3] - guide[np.int64(first_part)]
            max_depth += spans[2, k] * columns
            k += 1
        if depth > 1.001 * max_depth * clumps_per_column:
            continue  # a rough bound excludes most beams
        k = begin
        while k < len(beam) and beam[k] == this_beam:
            rate = spans[2, k] * clumps_per_column  # depth of a column in this box
            end = _column(ranges, guide, part_m, spans[1, k])
            position = np.float64(_column(ranges, guide, part_m, spans[0, k]))  # counted in columns
            while depth < (end - position) * rate and clump < MAX_CLUMPS:
                position += depth / rate
                column = np.int64(position)
                ray = this_beam * subrays
                if subrays > 1:
                    ray += np.int64(
                        bits(states[scan_index, 1], number_in_scan, clump) % np.uint64(subrays)
                    )
                if ranges[column] < reach[ray]:
                    quantile = uniform(states[scan_index, 2], number_in_scan, clump)
                    energy = particle_energy(
                        tables.by_range, column, quantile, tables.step_mm, exponential
                    )
                    hits.ray[count] = ray
                    hits.distance[count] = ranges[column]
                    hits.energy[count] = subrays * energy
                    count += 1
                clump += 1
                index = np.int64(
                    bits(states[scan_index, 0], number_in_scan, clump) >> SHIFT_TO_INDEX
                )
                depth = exponential[index]
            depth -= (end - position) * rate
            k += 1
    return k, count


@compiled()
def attenuate(crossings, subrays, extinction, reach, hits):
    """Multiply the energies of surface hits by the two-way transmission through spray.

    `hits` is a `SampledHits`, `extinction` is the extinction in 1/m of spray of density 1, and
    `reach` (beams * subrays,) is the range in meters that the light of each sub-ray reaches.
    """
    beam = crossings.beam
    spans = crossings.spans
    first = np.full(len(reach) // subrays, len(beam))  # first crossing of each beam
    for c in range(len(beam)):
        first[beam[c]] = min(c, first[beam[c]])
    for k in range(len(hits.ray)):
        hit_beam = beam_of(hits.ray[k], subrays)
        depth = 0.0
        c = first[hit_beam]
        while c < len(beam) and beam[c] == hit_beam:
            end = min(min(hits.distance[k], reach[hits.ray[k]]), spans[1, c])
            depth += spans[2, c] * max(end - spans[0, c], 0.0)
            c += 1
        if depth > 0:
            hits.energy[k] *= exp(-2 * extinction * depth)
