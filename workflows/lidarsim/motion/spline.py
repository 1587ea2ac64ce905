"""Twice continuously differentiable curves that interpolate values and rest at stops.

Between two knots, a curve is a polynomial of degree five. The first and second derivatives at its
ends are zero at stops and those of the cubic spline elsewhere, so that the curve is identical to
the cubic spline away from stops. All operations are performed in a fixed order, so that the results
are bitwise identical on every processor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Bools, Floats, Indices

# Number of empty equations before the first and after the last, as required by the last step of the
# cyclic reduction.
_PAD = 32


def fit_knots(times: Floats, values: Floats) -> Floats:
    """Return the values and the first two derivatives of a curve at its knots.

    Parameters
    ----------
    times
        Times of the knots, in ascending order. Shape (n,).
    values
        Components of the curve. All of them stop at the same knots. Shape (d, n).

    Returns
    -------
    array
        Values, first derivatives and second derivatives. Shape (3, d, n).
    """
    steps = np.diff(times)
    slopes = np.diff(values) / steps
    resting = is_stationary(steps, slopes)
    still = np.append(resting, False) | np.append(False, resting)
    # The second derivatives on both sides of a knot are equal if its slope v[i] satisfies
    # v[i] + lower[i] v[i - 1] + upper[i] v[i + 1] = first[i].
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


def is_stationary(steps: Floats, slopes: Floats) -> Bools:
    """Return whether a curve is stationary between each pair of adjacent knots.

    Parameters
    ----------
    steps
        Time between adjacent knots. Shape (n - 1,).
    slopes
        Mean slope of each component between adjacent knots. Shape (d, n - 1).
    """
    speeds = np.sqrt((slopes * slopes).sum(axis=0))
    resting = speeds * steps <= 1e-9  # in meters, or half radians for quaternions
    # A step that is ten times as long and ten times as slow as its neighbor is treated as a pause
    # without knots. Otherwise, the speed of the neighbor would cause a large overshoot.
    for step, neighbor in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
        longer = steps[step] > 10 * steps[neighbor]
        resting[step] |= longer & (10 * speeds[step] < speeds[neighbor])
    return np.asarray(resting)


def _end_slopes(times: Floats, values: Floats) -> Floats:
    """Return the initial slopes of cubic polynomials through four values each.

    An initial slope is the slope at the first of the four times. The polynomials are in Newton
    form. `values` has shape (d, 4), or fewer columns for a short curve, and the result has shape
    (d,).
    """
    slopes = np.zeros(len(values))
    differences = values
    factor = 1.0
    for order in range(1, len(times)):
        differences = np.diff(differences) / (times[order:] - times[:-order])
        slopes += factor * differences[:, 0]
        factor *= times[0] - times[order]
    return slopes


def _reduce(equations: Floats) -> None:
    """Solve padded tridiagonal equations in place by cyclic reduction (Hockney 1965).

    `equations` has shape (2 + d, n). Rows 0 and 1 contain the coefficients of the previous and the
    next unknown. The other rows contain the right-hand sides, which are replaced by the solutions.
    The coefficients are at most 1/2 and are squared in each step, so that they are negligible after
    the last step.
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
    """Coefficients of polynomials of degree five.

    Each has shape (d, m). The argument of the polynomials is the fraction of the segment, from 0 to
    1.
    """

    constant: Floats
    linear: Floats
    square: Floats
    cubic: Floats
    quartic: Floats
    quintic: Floats


def evaluate_curve(
    knots: Floats, steps: Floats, segment: Indices, since: Floats, order: int = 0
) -> list[Floats]:
    """Evaluate a curve and its derivatives at the given points.

    Parameters
    ----------
    knots
        Knots from `fit_knots`. Shape (3, d, n).
    steps
        Time from each knot to the next. Shape (n - 1,).
    segment
        Index of the last knot before each point. Shape (k,).
    since
        Time since this knot, in the unit of `steps`. Shape (k,).
    order
        Highest derivative, from 0 to 2.

    Returns
    -------
    list
        Values, followed by the derivatives up to `order`, each with shape (d, k).
    """
    # Most times are sorted, so the coefficients are computed once for each run of points in the
    # same segment.
    run_starts = np.flatnonzero(np.diff(segment, prepend=-1))
    counts = np.diff(run_starts, append=len(segment))
    run_segments = segment.take(run_starts)
    step = steps.take(run_segments)
    fraction = since / step.repeat(counts)
    # In Horner's method, each row is a derivative divided by the factorial of its order.
    rows = [*np.zeros((order + 1, knots.shape[1], len(segment)))]
    for term in reversed(_polynomials(knots, run_segments, step)):
        for row in range(order, 0, -1):
            rows[row] = rows[row] * fraction + rows[row - 1]
        rows[0] = rows[0] * fraction + term.repeat(counts, axis=1)
    scale = step.repeat(counts)
    for row, factor in enumerate([1.0, 2.0][:order], 1):
        for _ in range(row):
            rows[row] = rows[row] / scale
        rows[row] = factor * rows[row]
    return rows


def _polynomials(knots: Floats, segments: Indices, step: Floats) -> _Polynomials:
    """Return the polynomials on segments of the given durations."""
    powers = np.stack([step / step, step, step * step / 2])[:, None]
    # p, v and a are the value and the scaled derivatives at the start, and q, w and b at the end.
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
