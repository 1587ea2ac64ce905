"""Twice continuously differentiable curves through values, which stand still at stops.

Between two times a value is a polynomial of fifth degree. Its first and second derivatives at both
ends are the derivatives of the cubic spline, which the curve then equals, and zero at stops. Sums,
products, quotients and roots have one order, so that every processor computes the same bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Bools, Floats, Indices

_PAD = 32  # empty equations before the first and after the last: the last distance of reduction


def knots_of(times: Floats, values: Floats) -> Floats:
    """Return values (d, n) at times (n,) and their first two derivatives: (3, d, n).

    The d values stop together.
    """
    steps = np.diff(times)
    slopes = np.diff(values) / steps
    resting = rests(steps, slopes)
    still = np.append(resting, False) | np.append(False, resting)
    # Equal second derivatives on both sides of a knot, of its slope v[i]:
    # v[i] + lower[i] v[i - 1] + upper[i] v[i + 1] = first[i]
    rows = np.zeros((2 + len(values), _PAD + len(times) + _PAD))
    equations = rows[:, _PAD:-_PAD]
    lower = equations[0]
    upper = equations[1]
    first = equations[2:]
    lower[1:-1] = steps[1:] / (steps[1:] + steps[:-1]) / 2
    upper[1:-1] = 0.5 - lower[1:-1]
    first[:, 1:-1] = 3 * (lower[1:-1] * slopes[:, :-1] + upper[1:-1] * slopes[:, 1:])
    first[:, 0] += _end_slopes(times[:4], values[:, :4])
    first[:, -1] += _end_slopes(times[:-5:-1], values[:, :-5:-1])
    equations[:, still] = 0
    _reduce(rows)
    second = np.zeros_like(first)
    second[:, :-1] = (6 * slopes - 4 * first[:, :-1] - 2 * first[:, 1:]) / steps
    second[:, -1] = (4 * first[:, -1] + 2 * first[:, -2] - 6 * slopes[:, -1]) / steps[-1]
    second[:, still] = 0
    return np.array([values, first, second])


def rests(steps: Floats, slopes: Floats) -> Bools:
    """Return whether values rest (n - 1,) during the steps (n - 1,) between times.

    `slopes` (d, n - 1) are the mean slopes in each step.
    """
    speeds = np.sqrt((slopes * slopes).sum(axis=0))
    resting = speeds * steps <= 1e-9  # meters, or halves of radians
    # Steps ten times as long as their neighbor, and as slow, are pauses without values. A curve
    # with the neighbor's speed would swing far out in a pause.
    for step, neighbor in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
        longer = steps[step] > 10 * steps[neighbor]
        resting[step] |= longer & (10 * speeds[step] < speeds[neighbor])
    return np.asarray(resting)


def _end_slopes(times: Floats, values: Floats) -> Floats:
    """Return the slopes (d,), at the first time, of the cubics through values (d, 4) (Newton)."""
    slopes = np.zeros(len(values))
    differences = values
    factor = 1.0
    for order in range(1, len(times)):
        differences = np.diff(differences) / (times[order:] - times[:-order])
        slopes += factor * differences[:, 0]
        factor *= times[0] - times[order]
    return slopes


def _reduce(equations: Floats) -> None:
    """Solve padded tridiagonal equations (2 + d, n) in place, by cyclic reduction (Hockney, 1965).

    Row 0 is the factor of the unknown before, row 1 of the unknown after; the others are the right
    sides, and then the solutions. The factors, 1/2 at most, are squared in each step, and at last
    are below a rounding.
    """
    count = equations.shape[1] - 2 * _PAD
    lower = equations[0, _PAD:-_PAD]
    upper = equations[1, _PAD:-_PAD]
    right_sides = equations[2:, _PAD:-_PAD]
    for distance in (1, 2, 4, 8, 16, _PAD):
        rows_before = equations[:, _PAD - distance : _PAD - distance + count]
        rows_after = equations[:, _PAD + distance : _PAD + distance + count]
        scale = 1 - lower * rows_before[1] - upper * rows_after[0]
        reduced = (right_sides - lower * rows_before[2:] - upper * rows_after[2:]) / scale
        lower[:] = -lower * rows_before[0] / scale
        upper[:] = -upper * rows_after[1] / scale
        right_sides[:] = reduced


class _Polynomials(NamedTuple):
    """Coefficients of polynomials of fifth degree, each (d, m), in the share of a segment."""

    constant: Floats
    linear: Floats
    square: Floats
    cubic: Floats
    quartic: Floats
    quintic: Floats


def on_curve(
    knots: Floats, steps: Floats, segment: Indices, since: Floats, order: int = 0
) -> list[Floats]:
    """Return the values of a curve and its derivatives up to an order, (d, k) each.

    Parameters
    ----------
    knots
        (3, d, n): of `knots_of`.
    steps
        (n - 1,): times from each knot to the next, in the unit of all times.
    segment
        (k,): numbers of the knots before the points.
    since
        (k,): times since these knots.
    order
        Highest derivative, 0 to 2.
    """
    # Times mostly come in order: coefficients are computed once for all points of a run in one
    # segment.
    run_starts = np.flatnonzero(np.diff(segment, prepend=-1))
    counts = np.diff(run_starts, append=len(segment))
    run_segments = segment.take(run_starts)
    step = steps.take(run_segments)
    share = since / step.repeat(counts)
    # Horner's method; a row is a derivative, divided by the factorial of its order
    rows = [*np.zeros((order + 1, knots.shape[1], len(segment)))]
    for term in reversed(_polynomials(knots, run_segments, step)):
        for row in range(order, 0, -1):
            rows[row] = rows[row] * share + rows[row - 1]
        rows[0] = rows[0] * share + term.repeat(counts, axis=1)
    scale = step.repeat(counts)
    for row, factor in enumerate([1.0, 2.0][:order], 1):
        for _ in range(row):
            rows[row] = rows[row] / scale
        rows[row] = factor * rows[row]
    return rows


def _polynomials(knots: Floats, segments: Indices, step: Floats) -> _Polynomials:
    """Return the polynomials of segments (m,), which take `step` (m,)."""
    powers = np.stack([step / step, step, step * step / 2])[:, None]
    # p, v, a: values and scaled derivatives at the start; q, w, b: at the end.
    (p, v, a), (q, w, b) = (knots.take(segments + k, axis=2) * powers for k in (0, 1))
    change = q - p
    return _Polynomials(
        constant=p,
        linear=v,
        square=a,
        cubic=10 * change - 6 * v - 4 * w - 3 * a + b,
        quartic=8 * v + 7 * w + 3 * a - 2 * b - 15 * change,
        quintic=6 * change - 3 * (v + w) - a + b,
    )
