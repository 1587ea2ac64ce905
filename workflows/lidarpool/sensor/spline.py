"""Curves through values at times that are twice continuously differentiable, and may stop.

Between two times each number is a polynomial of fifth degree with given values, first and second
derivatives at both ends (Hermite). The derivatives are those of the cubic spline, which the curve
then equals, except where it rests: there both are zero, so that it stands still.

All is sums, products and quotients in one order: the same bits on every processor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_SAME = 1e-9  # metres, or halves of radians: values this near are equal
# A step this many times as long as its neighbour, and as slow, is a pause, in which nobody noted
# values: a cubic would swing far out with its neighbour's speed.
_PAUSE = 10.0


class Spline:
    """A curve through values at times.

    Parameters
    ----------
    times
        (n,): ascending, seconds; at least two.
    groups
        (d, n) each: numbers that rest together, such as coordinates.
    """

    def __init__(self, times: Real, *groups: Real) -> None:
        self._steps = np.diff(times)
        values = np.ascontiguousarray(np.concatenate(groups))
        self._knots = np.stack([values, values, values])  # and first and second derivatives
        row = 0
        for group in groups:
            rows, row = slice(row, row + len(group)), row + len(group)
            self._knots[1:, rows] = _derivatives(times, values[rows])

    def at(self, segment: NDArray[np.intp], since: Real, slopes: bool) -> tuple[Real, Real]:
        """Values of all groups and their first derivatives, (d, k) each.

        Parameters
        ----------
        segment
            (k,): numbers of the times before those asked for.
        since
            (k,): seconds since then.
        slopes
            Whether derivatives are needed; else they are zero.
        """
        # Times mostly come in order: coefficients are computed once for all in one segment.
        begins = np.flatnonzero(np.diff(segment, prepend=-1))
        counts = np.diff(begins, append=len(segment)) if len(begins) > 1 else 1
        used = segment.take(begins)
        step = self._steps.take(used)
        (p, speed, bend), (q, speeds, bends) = (self._knots.take(used + k, axis=2) for k in (0, 1))
        change, speed, speeds = q - p, speed * step, speeds * step
        bend, bends = bend * step * step / 2, bends * step * step / 2
        # Of a polynomial in the share of the segment that has passed.
        terms = [
            6 * change - 3 * (speed + speeds) - bend + bends,
            8 * speed + 7 * speeds + 3 * bend - 2 * bends - 15 * change,
            10 * change - 6 * speed - 4 * speeds - 3 * bend + bends,
            bend,
            speed,
            p,
        ]
        step = step.repeat(counts)
        share = since / step
        value, slope = np.zeros((2, len(p), len(segment)))
        for term in terms:  # by Horner
            if slopes:
                slope *= share
                slope += value
            value *= share
            value += term.repeat(counts, axis=1)
        return value, slope / step


def _derivatives(times: Real, values: Real) -> tuple[Real, Real]:
    """Return first and second derivatives of a group's curve at its times, (d, n) each."""
    steps = np.diff(times)
    changes = np.diff(values)
    slopes = changes / steps
    moved = np.sqrt((changes * changes).sum(axis=0))
    rests, speeds = moved <= _SAME, moved / steps
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
        rests[one] |= (steps[one] > _PAUSE * steps[other]) & (_PAUSE * speeds[one] < speeds[other])
    still = np.append(rests, False) | np.append(False, rests)
    # Equal second derivatives on both sides: v[i] + before v[i - 1] + after v[i + 1] = given
    before, after, first = np.zeros_like(times), np.zeros_like(times), np.empty_like(values)
    before[1:-1] = steps[1:] / (steps[1:] + steps[:-1]) / 2
    after[1:-1] = 0.5 - before[1:-1]
    first[:, 1:-1] = 3 * (before[1:-1] * slopes[:, :-1] + after[1:-1] * slopes[:, 1:])
    first[:, 0] = _slope(times[:4], values[:, :4])
    first[:, -1] = _slope(times[:-5:-1], values[:, :-5:-1])
    first[:, still] = before[still] = after[still] = 0
    first = _solved(before, after, first)
    second = np.empty_like(values)
    second[:, :-1] = (6 * slopes - 4 * first[:, :-1] - 2 * first[:, 1:]) / steps
    second[:, -1] = (4 * first[:, -1] + 2 * first[:, -2] - 6 * slopes[:, -1]) / steps[-1]
    second[:, still] = 0
    return first, second


def _solved(before: Real, after: Real, given: Real) -> Real:
    """Solve ``v[i] + before[i] v[i - 1] + after[i] v[i + 1] = given[i]``: (d, n).

    By cyclic reduction (Hockney, 1965): every second row is eliminated, at all places at once.
    """
    if len(before) == 1:
        return given
    even, odd, found = np.s_[..., ::2], np.s_[..., 1::2], np.empty_like(given)
    # Rows that are kept: those that have an odd one before them, and after them.
    later, sooner = np.s_[..., 1:], np.s_[..., : len(before) // 2]
    inner = np.s_[..., : (len(before) - 1) // 2]  # odd ones that have an even one after them
    kept = [np.zeros_like(before[even]), np.zeros_like(after[even]), given[even].copy()]
    scale = np.ones_like(kept[0])
    down, up = before[even][later], after[even][sooner]
    scale[later] -= down * after[odd][inner]
    scale[sooner] -= up * before[odd]
    kept[0][later] = -down * before[odd][inner]
    kept[1][sooner] = -up * after[odd]
    kept[2][later] -= down * given[odd][inner]
    kept[2][sooner] -= up * given[odd]
    found[even] = solution = _solved(*(part / scale for part in kept))
    found[odd] = given[odd] - before[odd] * solution[sooner]
    found[odd][inner] -= after[odd][inner] * solution[later]
    return found


def _slope(times: Real, values: Real) -> Real:
    """Slope (d,) at the first of some times of the polynomial through all (Newton)."""
    slope, factor = np.zeros(len(values)), 1.0
    for count in range(1, len(times)):
        values = np.diff(values) / (times[count:] - times[:-count])
        slope += factor * values[:, 0]
        factor *= times[0] - times[count]
    return slope
