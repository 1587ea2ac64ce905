"""Parts that loops over pulses share; a loop is compiled when it is first called."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

from raybeam.compiled import compiled, inlined, stage

from ..base.arrays import Floats, Ints

SLOPE = 0.5  # of the distance between neighbouring hits: what the slopes of one surface may miss


class SampledHits(NamedTuple):
    """Arrays to which loops write sampled hits of sub-rays: (k,) each."""

    ray: Ints  # sub-ray
    distance: Floats  # metres
    energy: Floats

    def first(self, count: int) -> SampledHits:
        """Return the first hits, which a loop has written."""
        return SampledHits(self.ray[:count], self.distance[:count], self.energy[:count])


class Neighbours(NamedTuple):
    """Where surfaces may continue from sub-ray to sub-ray; without pairs they do not."""

    pairs: Ints  # (k, 2): neighbouring sub-rays of a beam
    normals: Floats  # (3, n): of the surfaces of hits
    directions: Floats  # (3, n): of the rays of hits


class PulseHits(NamedTuple):
    """Hits of beams in the order of their distances, (n,) each, and scratch memory."""

    subray: Ints  # number among the sub-rays of all beams
    distance: Floats  # metres
    row: Ints  # (n, 2): row among the hits of `Neighbours`, and scratch memory
    subray_hits: Ints  # scratch memory (n * sub-rays of a beam,)
    changes: Ints  # scratch memory (n + 1,)


@inlined
def beam_of(ray, subrays):
    """Return the beam of a sub-ray."""
    return ray if subrays == 1 else ray // subrays  # a division takes as long as all else


@inlined
def scan_row(begins, beam, row):
    """Return the row of the scan of a beam, from the row of a beam before."""
    while row + 1 < len(begins) and begins[row + 1] <= beam:
        row += 1
    return row


@compiled()
def counted(ray, begins, keep_every, counts, rows, number, returns):
    """Count the returns of scans, which begin at some rays, and write those that are kept.

    Writes the rows of kept returns, their numbers in their pulses from 1, and how many returns a
    pulse has, at most 255; returns how many are kept.
    """
    count = 0
    scan = 0
    begin = 0
    stop = 0
    for k in range(len(ray)):
        if k == stop:
            begin = k
            scan = scan_row(begins, ray[k], scan)
            while stop < len(ray) and ray[stop] == ray[begin]:
                stop += 1
        if keep_every == 1 or counts[scan] % keep_every == 0:
            rows[count] = k
            number[count] = min(k + 1 - begin, 255)
            returns[count] = min(stop - begin, 255)
            count += 1
        counts[scan] += 1
    return count


@inlined
def _half_way(this, that, inverse_m, neighbours):
    """Return the range half-way to another hit, on the plane of the first."""
    normals = neighbours.normals
    directions = neighbours.directions
    x = normals[0, this]
    y = normals[1, this]
    z = normals[2, this]
    that_cosine = x * directions[0, that] + y * directions[1, that] + z * directions[2, that]
    this_cosine = x * directions[0, this] + y * directions[1, this] + z * directions[2, this]
    ratio = 1 + that_cosine / this_cosine
    if ratio < 1e-9:  # and not if it is unknown
        ratio = 1e-9
    return 2 / (inverse_m * ratio)


@stage
def continue_surfaces(begin, stop, new, apart, solid, hits, gap_m, subrays, neighbours):
    """Unmark in `apart` where a surface of a beam continues, by returns that begin at `new`.

    The hits of the beam are rows `begin` to `stop`, in the order of distances, of which `solid` are
    considered. Two neighbouring sub-rays hit one surface if the planes through the two hits meet
    half-way between them, within the gap or half of the distance between the hits. The inverse
    range of a plane is linear in the ray's direction, so two hits on one plane always meet,
    whatever the angle; half of the distance allows for rough ground.
    """
    distance = hits.distance
    row = hits.row
    subray_hits = hits.subray_hits
    changes = hits.changes
    count = stop - begin
    panes = 0
    for k in range(count * subrays):
        subray_hits[k] = -1
    for k in range(begin, stop):  # the hit of each sub-ray, after so many panes of glass
        changes[k - begin] = 0
        if solid[k]:
            pane = 0
            while subray_hits[pane * subrays + hits.subray[k] % subrays] >= 0:
                pane += 1
            subray_hits[pane * subrays + hits.subray[k] % subrays] = k
            panes = max(panes, pane + 1)
    changes[count] = 0
    first = begin
    for k in range(begin, stop):  # the first hit of the return of each hit
        if new[k]:
            first = k
        row[k, 1] = first
    for pane in range(panes):
        for pair in range(len(neighbours.pairs)):
            this = subray_hits[pane * subrays + neighbours.pairs[pair, 0]]
            that = subray_hits[pane * subrays + neighbours.pairs[pair, 1]]
            if this < 0 or that < 0 or row[this, 1] == row[that, 1]:
                continue
            this_m = _half_way(row[this, 0], row[that, 0], 1 / distance[this], neighbours)
            that_m = _half_way(row[that, 0], row[this, 0], 1 / distance[that], neighbours)
            between_m = abs(distance[this] - distance[that])
            if abs(this_m - that_m) <= max(gap_m, SLOPE * between_m):
                changes[min(this, that) + 1 - begin] += 1
                changes[max(this, that) + 1 - begin] -= 1
    inside = 0
    for k in range(begin, stop):
        inside += changes[k - begin]
        if inside > 0:
            apart[k] = False
