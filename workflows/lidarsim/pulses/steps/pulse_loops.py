"""Functions shared by the compiled loops over pulses.

Each loop is compiled on first use.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

from raybeam.compiled import compiled, inlined, noinline

from ...numerics.arrays import Bools, Floats, Ints

SLOPE = 0.5  # largest gap between planes of one surface, relative to the distance of the hits


class SampledHits(NamedTuple):
    """Sampled hits on sub-rays, to which loops write.

    All arrays have shape (k,).
    """

    ray: Ints  # sub-ray
    distance: Floats  # meters
    energy: Floats

    def first(self, count: int) -> SampledHits:
        """Return the first `count` hits."""
        return SampledHits(self.ray[:count], self.distance[:count], self.energy[:count])


class SubrayNeighbors(NamedTuple):
    """Neighboring sub-rays of a beam, and planes of hits.

    If there are no pairs, no surface continues from one sub-ray to the next.
    """

    subrays: int  # number of sub-rays per beam
    pairs: Ints  # (k, 2): neighboring sub-rays of a beam
    normals: Floats  # (3, n): surface normals of the hits
    directions: Floats  # (3, n): directions of the rays that hit


class SurfaceMarks(NamedTuple):
    """Marks of hits, in the order of `PulseHits`.

    All arrays have shape (n,).
    """

    solid: Bools  # whether the hit is on a surface that may continue
    starts_return: Bools  # whether a return starts at the hit
    starts_surface: Bools  # False if the previous hit's surface continues; may be `starts_return`


class PulseHits(NamedTuple):
    """Hits sorted by beam and distance, and scratch memory.

    The arrays of hits have shape (n,).
    """

    subray: Ints  # number among the sub-rays of all beams
    distance: Floats  # meters
    row: Ints  # row among the hits of `SubrayNeighbors`
    return_begin: Ints  # scratch memory: first hit of the return that each hit belongs to
    subray_hits: Ints  # scratch memory (n * sub-rays per beam,)
    changes: Ints  # scratch memory (n + 1,)


@inlined
def beam_of(ray, subrays):
    """Return the beam of a sub-ray, given the number of sub-rays per beam."""
    return ray if subrays == 1 else ray // subrays  # the division would take most of the time


@inlined
def scan_row(scan_starts, beam, row):
    """Return the row of the scan that contains a beam, searching from an earlier beam's row."""
    while row + 1 < len(scan_starts) and scan_starts[row + 1] <= beam:
        row += 1
    return row


@compiled()
def thin_out(ray, scan_starts, keep_every, hit_counts, row_indices, number, return_counts):
    """Count the returns of each scan, and select every `keep_every`-th return.

    Scans begin at the rays `scan_starts`, and their counts are added to `hit_counts`. For each kept
    return, the function writes the row to `row_indices`, the number in the pulse (from 1) to
    `number`, and the number of returns of the pulse to `return_counts`. Both numbers are limited to
    255. Returns the number of kept returns.
    """
    count = 0
    scan = 0
    begin = 0
    stop = 0
    for k in range(len(ray)):
        if k == stop:
            begin = k
            scan = scan_row(scan_starts, ray[k], scan)
            while stop < len(ray) and ray[stop] == ray[begin]:
                stop += 1
        if keep_every == 1 or hit_counts[scan] % keep_every == 0:
            row_indices[count] = k
            number[count] = min(k + 1 - begin, 255)
            return_counts[count] = min(stop - begin, 255)
            count += 1
        hit_counts[scan] += 1
    return count


@inlined
def _half_way(hit, neighbor, inverse_distance, neighbors):
    """Return the range in meters to the plane of a hit, measured halfway to a neighboring ray.

    The plane is the tangent plane of the surface at the hit. `hit` and
    `neighbor` are rows in `SubrayNeighbors`, and `inverse_distance` is that of `hit`, in 1/m.
    """
    normals = neighbors.normals
    directions = neighbors.directions
    x = normals[0, hit]
    y = normals[1, hit]
    z = normals[2, hit]
    neighbor_cosine = (
        x * directions[0, neighbor] + y * directions[1, neighbor] + z * directions[2, neighbor]
    )
    hit_cosine = x * directions[0, hit] + y * directions[1, hit] + z * directions[2, hit]
    ratio = 1 + neighbor_cosine / hit_cosine
    if ratio < 1e-9:  # False if the ratio is NaN
        ratio = 1e-9
    return 2 / (inverse_distance * ratio)


@noinline
def continue_surfaces(begin, stop, marks, hits, gap_m, neighbors):  # noqa: C901, PLR0914 - a compiled loop
    """Clear `marks.starts_surface` at hits that continue the surface of the beam's previous hit.

    The hits of the beam are rows `begin` to `stop` of `hits`, a `PulseHits`, and of `marks`, a
    `SurfaceMarks`. Only `solid` hits are considered. Two neighboring sub-rays hit the same surface
    if the planes through their hits meet halfway between the hits, within `gap_m` or within half
    of the distance between the hits. The inverse range of a plane is linear in the ray's direction,
    so two hits on one plane always meet, whatever the angle. The tolerance of half the distance
    allows for rough ground.

    A sub-ray may have several hits, each behind the panes of glass that it hit before. Hits of
    neighboring sub-rays are compared if they are behind the same number of panes.

    For example, a beam of four sub-rays with the pairs (0, 1), (1, 2) and (2, 3) has five hits.
    Sub-rays 0, 1 and 2 graze the ground, sub-ray 3 hits a post, and sub-ray 0 also hits a raindrop:

    ==============================================  ======  ======  ======  ======  ======
    hit k                                           0 drop  1       2 post  3       4
    ==============================================  ======  ======  ======  ======  ======
    `distance`, meters                              8.0     10.0    10.6    11.0    12.2
    `subray`                                        0       0       3       1       2
    `solid`                                         no      yes     yes     yes     yes
    `starts_return`, by a gap of 0.3 m              yes     yes     yes     yes     yes
    `changes` by pair (0, 1), of hits 1 and 3       0       0       1       0       -1
    `changes` by pair (1, 2), of hits 3 and 4, too  0       0       1       0       0
    `continuing`, the sum of changes up to hit k    0       0       1       1       1
    `starts_surface`                                yes     yes     no      no      no
    ==============================================  ======  ======  ======  ======  ======

    Pair (0, 1) also clears the mark of the post, because the post is between two hits of one
    surface. The element of `changes` after the last hit is finally -1. Pair (2, 3), ground and
    post, is not on one surface. The result is two returns: the drop, and the ground with the post.
    """
    subrays = neighbors.subrays
    solid = marks.solid
    starts_return = marks.starts_return
    starts_surface = marks.starts_surface
    distance = hits.distance
    row = hits.row
    return_begin = hits.return_begin
    subray_hits = hits.subray_hits
    changes = hits.changes
    count = stop - begin
    panes = 0
    for k in range(count * subrays):
        subray_hits[k] = -1
    # subray_hits: row of the hit of each sub-ray behind 0, 1, … panes of glass, or -1, in blocks of
    # `subrays` elements for each number of panes.
    for k in range(begin, stop):
        changes[k - begin] = 0
        if solid[k]:
            pane = 0
            while subray_hits[pane * subrays + hits.subray[k] % subrays] >= 0:
                pane += 1
            subray_hits[pane * subrays + hits.subray[k] % subrays] = k
            panes = max(panes, pane + 1)
    changes[count] = 0  # changes[k]: change in the number of surfaces that continue at hit k
    first_hit = begin
    for k in range(begin, stop):
        if starts_return[k]:
            first_hit = k
        return_begin[k] = first_hit
    for pane in range(panes):
        for pair in range(len(neighbors.pairs)):
            hit = subray_hits[pane * subrays + neighbors.pairs[pair, 0]]
            neighbor = subray_hits[pane * subrays + neighbors.pairs[pair, 1]]
            if hit < 0 or neighbor < 0 or return_begin[hit] == return_begin[neighbor]:
                continue
            hit_m = _half_way(row[hit], row[neighbor], 1 / distance[hit], neighbors)
            neighbor_m = _half_way(row[neighbor], row[hit], 1 / distance[neighbor], neighbors)
            between_m = abs(distance[hit] - distance[neighbor])
            if abs(hit_m - neighbor_m) <= max(gap_m, SLOPE * between_m):
                changes[min(hit, neighbor) + 1 - begin] += 1
                changes[max(hit, neighbor) + 1 - begin] -= 1
    continuing = 0
    for k in range(begin, stop):
        continuing += changes[k - begin]
        if continuing > 0:
            starts_surface[k] = False
