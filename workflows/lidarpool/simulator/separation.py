"""Returns of pulses: hits that a receiver cannot tell apart are one return."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools, Floats, Ints
from ..sensor.disc import neighbours
from .hits import NO_SURFACE, Hits, Planes, numbers, runs, strongest
from .motion import products

SLOPE = 0.5  # of the distance between neighbouring hits: what the slopes of one surface may miss


def separated(hits: Hits, gap_m: float, each: int = 1, planes: Planes | None = None) -> Hits:
    """Make returns of hits: those of a beam within a distance of the next are one return.

    So are hits of neighbouring sub-rays on one surface, however far apart they are: a beam that
    grazes a road illuminates all of the road between them. A return's energy is the sum over its
    hits, its distance and velocity their means weighted by energy, its triangle and colour those of
    the strongest. Hits without energy are dropped.

    The hits of all sub-rays, `each` of a beam, are in the order of rays; `gap_m` is half of the
    pulse's length. Returns are in the order of beams and distances; their `ray` is the beam.
    """
    rows = np.arange(len(hits.ray))
    some = hits.energy > 0
    if not some.all():
        rows, hits = rows[some], hits.take(some)
    if not len(rows):
        return hits
    beam = hits.ray // each
    begins, counts = runs(beam)
    width = np.maximum.reduceat(hits.distance, begins) - np.minimum.reduceat(hits.distance, begins)
    new = np.zeros(len(rows), np.bool_)
    new[begins] = True
    # Few beams hit an edge or graze a surface, and only their hits are sorted.
    wide = np.flatnonzero(np.repeat(width > gap_m, counts))
    if len(wide):
        order = np.arange(len(rows))
        order[wide] = wide[np.lexsort((hits.distance[wide], beam[wide]))]
        rows, hits = rows[order], hits.take(order)
        new[1:] |= np.diff(hits.distance) > gap_m
        if planes is not None and each > 1:
            # Of those, the beams that fall into several returns.
            begins, counts = runs(beam[wide])
            several = np.add.reduceat(new[wide], begins, dtype=np.int64) > 1
            falls = wide[np.repeat(several, counts)]
            if len(falls):
                part, marks = hits.take(falls), new[falls]
                normal, direction = planes(rows[falls])
                new[falls] &= ~continued(part, marks, gap_m, each, normal, direction)
    begins = np.flatnonzero(new)
    which = np.cumsum(new) - 1
    energy = np.bincount(which, hits.energy).astype(np.float64)
    distance = np.bincount(which, hits.energy * hits.distance) / energy
    first = hits.take(strongest(hits.energy, begins, np.diff(begins, append=len(rows))))
    velocity = None
    if hits.velocity is not None:
        velocity = np.bincount(which, hits.energy * hits.velocity) / energy
    energy /= each
    return first._replace(ray=beam[begins], distance=distance, energy=energy, velocity=velocity)


def continued(
    hits: Hits, new: Bools, gap_m: float, each: int, normal: Floats, direction: Floats
) -> Bools:
    """Whether a surface continues from before each hit to behind it: no return begins, (n,).

    Two neighbouring sub-rays hit one surface if the planes through the two hits meet half-way
    between them, within the gap or half of the distance between the hits. The inverse range of a
    plane is linear in the ray's direction, so two hits on one plane always meet, whatever the
    angle; half of the distance allows for rough ground.

    The hits of each beam are sorted by distance; `new` are the returns by distances alone.
    """
    beam = hits.ray // each
    # The hit of each sub-ray, after so many panes of glass: a row for each beam and number of them.
    solid = np.flatnonzero(hits.triangle != NO_SURFACE)
    if not len(solid):
        return np.zeros(len(beam), np.bool_)
    order = solid[np.argsort(hits.ray[solid], kind="stable")]
    panes = np.zeros(len(beam), np.int64)
    panes[order] = numbers(hits.ray[order])
    most = int(panes.max()) + 1
    row = (np.cumsum(np.diff(beam, prepend=beam[0]) != 0)) * most + panes
    table = np.full((int(row.max()) + 1, each), -1)
    table[row[solid], hits.ray[solid] % each] = solid
    one, other = table[:, neighbours(each)].reshape(-1, 2).T
    number = np.cumsum(new)
    pair = (one >= 0) & (other >= 0) & (number[one] != number[other])
    one, other = one[pair], other[pair]
    near = 1 / hits.distance

    def half_way(this: Ints, that: Ints) -> Floats:
        """Ranges half-way to another hit, on the plane of the first."""
        plane, looks = normal[this].T, direction.T
        slope = products(plane, looks[:, that]) / products(plane, looks[:, this])
        return np.asarray(2 / (near[this] * np.maximum(1 + slope, 1e-9)))

    step = np.abs(half_way(one, other) - half_way(other, one))
    apart = np.abs(hits.distance[one] - hits.distance[other])
    meet = step <= np.maximum(gap_m, SLOPE * apart)
    low, high = np.sort([one[meet], other[meet]], axis=0)
    begin, end = (np.bincount(hit + 1, minlength=len(beam) + 1) for hit in (low, high))
    return np.asarray(np.cumsum(begin - end)[:-1] > 0)
