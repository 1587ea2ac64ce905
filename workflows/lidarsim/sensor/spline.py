"""Curves through values that are twice continuously differentiable, and stand still at stops.

Between two times a value is a polynomial of fifth degree with given first and second derivatives
at both ends: those of the cubic spline, which the curve then equals, and zero at stops. Sums,
products, quotients and roots have one order, so that every processor has the same bits.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats, Indices


def knots_of(times: Floats, values: Floats) -> Floats:
    """Values (d, n) at times (n,), which stop together, and two derivatives there: (3, d, n)."""
    steps = np.diff(times)
    slopes = np.diff(values) / steps
    speeds = np.sqrt((slopes * slopes).sum(axis=0))
    rests = speeds * steps <= 1e-9  # metres, or halves of radians
    # Steps ten times as long as their neighbour, and as slow, are pauses without values, in which
    # a curve with the neighbour's speed would swing far out.
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
        rests[one] |= (steps[one] > 10 * steps[other]) & (10 * speeds[one] < speeds[other])
    still = np.append(rests, False) | np.append(False, rests)
    # Equal second derivatives on both sides: v[i] + before[i] v[i - 1] + after[i] v[i + 1] = given
    rows = np.zeros((2 + len(values), 32 + len(times) + 32))
    own = rows[:, 32:-32]
    before = own[0]
    after = own[1]
    first = own[2:]
    before[1:-1] = steps[1:] / (steps[1:] + steps[:-1]) / 2
    after[1:-1] = 0.5 - before[1:-1]
    first[:, 1:-1] = 3 * (before[1:-1] * slopes[:, :-1] + after[1:-1] * slopes[:, 1:])
    for end, few in ((0, np.s_[:4]), (-1, np.s_[:-5:-1])):
        # The slope there of the cubic through four (Newton).
        time = times[few]
        part = values[:, few]
        factor = 1.0
        for count in range(1, len(time)):
            part = np.diff(part) / (time[count:] - time[:-count])
            first[:, end] += factor * part[:, 0]
            factor *= time[0] - time[count]
    own[:, still] = 0
    # Cyclic reduction (Hockney, 1965) of all rows at once: `before` and `after`, 1/2 at most, are
    # squared each time, and at last below a rounding.
    for far in (1, 2, 4, 8, 16, 32):
        left, right = (rows[:, 32 + k : 32 + k + len(times)] for k in (-far, far))
        scale = 1 - before * left[1] - after * right[0]
        found = (first - before * left[2:] - after * right[2:]) / scale
        before[:] = -before * left[0] / scale
        after[:] = -after * right[1] / scale
        first[:] = found
    second = np.zeros_like(first)
    second[:, :-1] = (6 * slopes - 4 * first[:, :-1] - 2 * first[:, 1:]) / steps
    second[:, -1] = (4 * first[:, -1] + 2 * first[:, -2] - 6 * slopes[:, -1]) / steps[-1]
    second[:, still] = 0
    return np.array([values, first, second])


def on_curve(
    knots: Floats, steps: Floats, segment: Indices, since: Floats, slopes: bool
) -> tuple[Floats, Floats]:
    """Values and, if asked for, slopes (d, k), `since` (k,) after the knots `segment` (k,)."""
    # Times mostly come in order: coefficients are computed once for all in one segment.
    begins = np.flatnonzero(np.diff(segment, prepend=-1))
    counts = np.diff(begins, append=len(segment))
    used = segment.take(begins)
    step = steps.take(used)
    powers = np.stack([step / step, step, step * step / 2])[:, None]
    (p, v, a), (q, w, b) = (knots.take(used + k, axis=2) * powers for k in (0, 1))
    share = since / step.repeat(counts)
    change = q - p
    value, slope = np.zeros((2, len(p), len(segment)))
    # Of the polynomial in the share of the segment, by Horner.
    c = 10 * change - 6 * v - 4 * w - 3 * a + b
    d = 8 * v + 7 * w + 3 * a - 2 * b - 15 * change
    e = 6 * change - 3 * (v + w) - a + b
    for term in (e, d, c, a, v, p):
        if slopes:
            slope = slope * share + value
        value = value * share + term.repeat(counts, axis=1)
    return value, slope / step.repeat(counts)
