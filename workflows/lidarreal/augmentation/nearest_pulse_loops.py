"""Compiled loops that find the recorded pulses closest to given directions."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.elementary_loops import arctan2
from raybeam.compiled import compiled, inlined

_MIN_LOST_STEPS = 1.6  # minimum gap in steps that contains a lost pulse
_SAME_PULSE_STEPS = 0.05  # Closer returns of a ring belong to the same pulse.


class SortedReturns(NamedTuple):
    """Returns sorted by ring and azimuth, which can be searched by cell.

    The cells divide each ring into `columns` equal parts from -pi to pi.
    """

    row: Ints  # (m,): row of the return in the sweep
    azimuth: Floats  # (m,): radians, -pi to pi
    elevation: Floats  # (m,): radians
    first: Ints  # (m,): index of the first return of the same pulse
    starts: Ints  # (r * columns + 1,): index of the first return in each cell
    columns: int  # number of cells per ring


class CandidateRings(NamedTuple):
    """Rings that may contain the closest pulse to each of k rays.

    The candidates of a ray are the `ring_count` rings from `first_ring` on.
    """

    first_ring: Ints  # (k,)
    ring_count: Ints  # (k,)
    expected: Floats  # (k, c): elevation of each candidate where it has no return, in radians
    tolerance: Floats  # (k,): maximum elevation difference in radians


@inlined
def _column_of(azimuth, columns):
    column = int((azimuth + np.pi) * (columns / (2 * np.pi)))
    return min(max(column, 0), columns - 1)


@inlined
def _sort_cell(points, returns, begin, end):
    """Sort the returns of a cell by azimuth, and compute their directions."""
    for k in range(begin, end):
        index = returns.row[k]
        x, y, z = points[index, 0], points[index, 1], points[index, 2]
        angle = arctan2(y, x)
        height = arctan2(z, np.sqrt(x * x + y * y))
        place = k
        while place > begin and returns.azimuth[place - 1] > angle:
            returns.row[place] = returns.row[place - 1]
            returns.azimuth[place] = returns.azimuth[place - 1]
            returns.elevation[place] = returns.elevation[place - 1]
            place -= 1
        returns.row[place] = index
        returns.azimuth[place] = angle
        returns.elevation[place] = height


@inlined
def _group_pulses(returns, begin, end, step):
    """Find the first return of each pulse among the sorted returns of a ring."""
    first = begin
    for k in range(begin, end):
        if returns.azimuth[k] - returns.azimuth[first] > _SAME_PULSE_STEPS * step:
            first = k
        returns.first[k] = first


@compiled()
def sort_returns(points, ring, is_used, steps, cell, returns):
    """Sort the returns of some rings by ring and azimuth.

    Parameters
    ----------
    points
        Positions, with shape (n, 3).
    ring
        Index of each point's ring, or -1, with shape (n,).
    is_used
        Whether the returns of a ring are needed, with shape (r,).
    steps
        Azimuth difference between consecutive pulses of each ring in radians, with shape (r,).
    cell
        Temporary array of shape (n,).
    returns
        `SortedReturns` to which the result is written. `starts` contains zeros, and the other
        arrays have the shape (n,), of which the first m values are used.
    """
    starts, columns = returns.starts, returns.columns
    for k in range(len(points)):
        cell[k] = -1
        if ring[k] >= 0 and is_used[ring[k]]:
            column = _column_of(arctan2(points[k, 1], points[k, 0]), columns)
            cell[k] = ring[k] * columns + column
            starts[cell[k] + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    # While cells are filled, `starts` contains the next free index of each cell.
    for k in range(len(points)):
        if cell[k] >= 0:
            returns.row[starts[cell[k]]] = k
            starts[cell[k]] += 1
    for k in range(len(starts) - 1, 0, -1):
        starts[k] = starts[k - 1]
    starts[0] = 0
    for k in range(len(starts) - 1):
        _sort_cell(points, returns, starts[k], starts[k + 1])
    for k in range(len(steps)):
        _group_pulses(returns, starts[k * columns], starts[(k + 1) * columns], steps[k])


@inlined
def _nearest_in_ring(returns, ring, azimuth, step):
    """Return the closest return in a ring and its azimuth difference, or -1 for a lost pulse."""
    begin = returns.starts[ring * returns.columns]
    end = returns.starts[(ring + 1) * returns.columns]
    if begin == end:
        return -1, 0.0
    after = returns.starts[ring * returns.columns + _column_of(azimuth, returns.columns)]
    while after < end and returns.azimuth[after] < azimuth:
        after += 1
    before = after - 1 if after > begin else end - 1
    to_before = azimuth - returns.azimuth[before] + (0.0 if after > begin else 2 * np.pi)
    if after == end:
        after = begin
        to_after = returns.azimuth[after] + 2 * np.pi - azimuth
    else:
        to_after = returns.azimuth[after] - azimuth
    difference = min(to_before, to_after)
    if difference > step / 2 and to_before + to_after > _MIN_LOST_STEPS * step:
        return -1, 0.0
    return (before if to_before < to_after else after), difference


@compiled()
def find_pulses(azimuth, elevation, candidates, returns, steps, ray, squared):
    """Find the closest recorded pulse to each ray, and assign its returns to the ray.

    Parameters
    ----------
    azimuth, elevation
        Directions of the rays in radians, with shape (k,). Azimuths are from -pi to pi.
    candidates
        `CandidateRings` of the rays.
    returns
        `SortedReturns` of the candidates.
    steps
        Azimuth difference between consecutive pulses of each ring in radians, with shape (r,).
    ray
        Result: the ray to which each return is assigned, with shape (m,). It contains -1 at first.
    squared
        Temporary array with the squared angles between the pulses and their rays, of shape (m,).
    """
    for k in range(len(azimuth)):
        nearest = -1
        smallest = np.inf
        between = 0.0
        for j in range(candidates.ring_count[k]):
            ring = candidates.first_ring[k] + j
            index, across = _nearest_in_ring(returns, ring, azimuth[k], steps[ring])
            angle = candidates.expected[k, j] if index < 0 else returns.elevation[index]
            if abs(angle - elevation[k]) < smallest:
                smallest = abs(angle - elevation[k])
                nearest = index
                between = across
        if nearest < 0 or smallest > candidates.tolerance[k]:
            continue
        # If two rays are closest to the same pulse, the ray with the smaller angle receives it.
        first = returns.first[nearest]
        angle = between * between + smallest * smallest
        if ray[first] < 0 or angle < squared[first]:
            ray[first] = k
            squared[first] = angle
    for k in range(len(ray)):
        ray[k] = ray[returns.first[k]]
