"""Parts that loops over pulses share, where each loop is compiled on its first call."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

from raybeam.compiled import compiled, inlined, noinline

from ...base.arrays import Bools, Floats, Ints

SLOPE = 0.5  # largest gap of the planes of one surface, by the distance between neighboring hits


class SampledHits(NamedTuple):
    """Arrays for loops to write sampled hits of sub-rays to: (k,) each."""

    ray: Ints  # sub-ray
    distance: Floats  # meters
    energy: Floats

    def first(self, count: int) -> SampledHits:
        """Return the first hits, which a loop has written."""
        return SampledHits(self.ray[:count], self.distance[:count], self.energy[:count])


class Neighbors(NamedTuple):
    """Neighboring sub-rays of a beam, and planes of hits.

    Without pairs no surface continues.
    """

    subrays: int  # number in a beam
    pairs: Ints  # (k, 2): neighboring sub-rays of a beam
    normals: Floats  # (3, n): of the surfaces of hits
    directions: Floats  # (3, n): of the rays of hits


class SurfaceMarks(NamedTuple):
    """Marks of hits in the order of `PulseHits`: (n,) each."""

    solid: Bools  # whether the hit is on a surface that may continue
    starts_return: Bools  # whether a return starts at the hit
    starts_surface: Bools  # False if the last hit's surface continues; may be `starts_return`


class PulseHits(NamedTuple):
    """Hits of beams in the order of beams and distances, (n,) each, and scratch memory."""

    subray: Ints  # number among the sub-rays of all beams
    distance: Floats  # meters
    row: Ints  # (n, 2): row among the hits of `Neighbors`, and scratch memory
    subray_hits: Ints  # scratch memory (n * sub-rays of a beam,)
    changes: Ints  # scratch memory (n + 1,)


@inlined
def beam_of(ray, subrays):
    """Return the beam of a sub-ray."""
    return ray if subrays == 1 else ray // subrays  # a division takes as long as all else


@inlined
def scan_row(scan_starts, beam, row):
    """Return the row of the scan of a beam, searched from the row of an earlier beam."""
    while row + 1 < len(scan_starts) and scan_starts[row + 1] <= beam:
        row += 1
    return row


@compiled()
def thin_out(ray, scan_starts, keep_every, hit_counts, row_indices, number, return_counts):
    """Count the returns of each scan, and write every `keep_every`-th return of a scan.

    Scans begin at rays `scan_starts`; their `hit_counts` are added to. Of kept returns, writes the
    `row_indices`, the `number` in the pulse, from 1, and the number of returns of the pulse,
    `return_counts`, both at most 255. Returns the number of kept returns.
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
    """Return the range of the plane of a hit half-way to a neighboring hit, meters.

    `hit` and `neighbor` are rows in `Neighbors`; `inverse_distance` is of the hit, 1/m.
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
    if ratio < 1e-9:  # and not if it is unknown
        ratio = 1e-9
    return 2 / (inverse_distance * ratio)


@noinline
def continue_surfaces(begin, stop, marks, hits, gap_m, neighbors):  # noqa: C901, PLR0914 - a compiled loop
    """Clear `marks.starts_surface` at hits of a beam where the last hit's surface continues.

    The hits of the beam are rows `begin` to `stop` of `hits`, `PulseHits`, and of `marks`,
    `SurfaceMarks`; only `solid` hits are considered. Two neighboring sub-rays hit one surface if
    the planes through the two hits meet half-way between the hits, within `gap_m` or half of the
    distance between the hits. The inverse range of a plane is linear in the ray's direction, so two
    hits on one plane always meet, whatever the angle; half of the distance allows for rough ground.

    A sub-ray may have several hits, each behind the panes of glass that it hit before: the hits of
    neighboring sub-rays behind the same number of panes are compared.

    A beam of four sub-rays, with the pairs (0, 1), (1, 2) and (2, 3), has five hits. Sub-rays 0, 1
    and 2 graze the ground, sub-ray 3 meets a post, and sub-ray 0 meets a raindrop on its way:

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

    Pair (0, 1) clears the mark of the post as well: the post is between two hits of one surface.
    The element of `changes` behind the last hit is -1 in the end. Pair (2, 3), ground and post, is
    not on one surface. There are two returns, of the drop, and of the ground with the post.
    """
    subrays = neighbors.subrays
    solid = marks.solid
    starts_return = marks.starts_return
    starts_surface = marks.starts_surface
    distance = hits.distance
    row = hits.row
    subray_hits = hits.subray_hits
    changes = hits.changes
    count = stop - begin
    panes = 0
    for k in range(count * subrays):
        subray_hits[k] = -1
    # subray_hits: row of the hit of each sub-ray behind 0, 1, … panes of glass, or -1; a block of
    # `subrays` for each number of panes.
    for k in range(begin, stop):
        changes[k - begin] = 0
        if solid[k]:
            pane = 0
            while subray_hits[pane * subrays + hits.subray[k] % subrays] >= 0:
                pane += 1
            subray_hits[pane * subrays + hits.subray[k] % subrays] = k
            panes = max(panes, pane + 1)
    changes[count] = 0  # changes[k]: change of the number of surfaces that continue at hit k
    first_hit = begin
    for k in range(begin, stop):  # row[k, 1]: the first hit of the return of hit k
        if starts_return[k]:
            first_hit = k
        row[k, 1] = first_hit
    for pane in range(panes):
        for pair in range(len(neighbors.pairs)):
            hit = subray_hits[pane * subrays + neighbors.pairs[pair, 0]]
            neighbor = subray_hits[pane * subrays + neighbors.pairs[pair, 1]]
            if hit < 0 or neighbor < 0 or row[hit, 1] == row[neighbor, 1]:
                continue
            hit_m = _half_way(row[hit, 0], row[neighbor, 0], 1 / distance[hit], neighbors)
            neighbor_m = _half_way(row[neighbor, 0], row[hit, 0], 1 / distance[neighbor], neighbors)
            between_m = abs(distance[hit] - distance[neighbor])
            if abs(hit_m - neighbor_m) <= max(gap_m, SLOPE * between_m):
                changes[min(hit, neighbor) + 1 - begin] += 1
                changes[max(hit, neighbor) + 1 - begin] -= 1
    continuing = 0
    for k in range(begin, stop):
        continuing += changes[k - begin]
        if continuing > 0:
            starts_surface[k] = False
