"""Steps between the pulses of rings, and phases that the rings have in common.

Pulses without a return are missing from a recording. Differences between consecutive returns of a
ring are therefore whole multiples of the step, and all estimates are based on differences that
contain few lost pulses or on phases, which lost pulses do not affect.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints

MIN_STEP_RAD = np.radians(0.02)  # closer returns of a ring belong to the same pulse
_TURN = 2 * np.pi
_MIN_GAPS = 8  # minimum number of gaps of a ring to determine its step
_MAX_STEPS = 3.0  # maximum step of a ring relative to the typical step
_SMALL_GAPS = 0.1  # quantile of the gaps in a ring that contain no lost pulses
_MAX_DEVIATION = 0.5  # maximum relative deviation of gaps without lost pulses from the step
_REFINEMENTS = 5
_MAX_STRIDE = 4  # maximum ratio of the step of a ring to the smallest step
_MIN_MULTIPLES = 0.9  # minimum fraction of gaps that are multiples of the step of a ring
_MAX_LOST = 100  # maximum number of steps in a gap, so that rounding errors of steps do not matter
_MIN_COUNT = 50  # minimum number of steps of a ring in a sweep to refine the step
_ROUNDS = 6  # iterations of a fit of phases
_OUTLIER_SIGMAS = 4.0
_MIN_SIGMA = 1e-9
_BINS = 200  # bins of a sweep in which deviations that all rings have in common are determined


def ring_steps(gaps: Floats, ring: Ints, ring_count: int) -> Floats:
    """Return the step between consecutive pulses of each ring.

    In some sensors, certain rings fire at half the rate of the others. The step of a ring with few
    returns is assumed to be the typical step. In a ring that hits trees or the sky, most gaps may
    contain lost pulses. Gaps of several steps are therefore ignored.

    Parameters
    ----------
    gaps
        Differences between consecutive returns of a ring, in azimuth or time, greater than 0 and
        of shape (n,). Differences between returns of the same pulse must be excluded.
    ring
        Ring of each gap, of shape (n,).
    ring_count
        Number of rings.

    Returns
    -------
    numpy.ndarray
        Steps of shape (ring_count,). They are NaN if there are no gaps.
    """
    counts = np.bincount(ring, minlength=ring_count)
    steps = np.full(ring_count, np.nan)
    for row in np.flatnonzero(counts).tolist():
        steps[row] = _smallest_step(gaps[ring == row])
    if not len(gaps):
        return steps
    typical = np.median(steps[counts >= counts.max() / 2])
    is_known = (counts >= _MIN_GAPS) & (steps < _MAX_STEPS * typical)
    return np.where(is_known, steps, typical)


def stride(gaps: Floats, step: float) -> int:
    """Return the number of steps of which nearly all gaps of a ring are multiples.

    Most gaps of a ring that rarely returns span several steps, but not a multiple of them.
    """
    steps = np.rint(gaps / step)
    steps = steps[steps <= _MAX_STRIDE * _MAX_STEPS]
    if len(steps) < _MIN_GAPS:
        return 1
    strides = range(_MAX_STRIDE, 1, -1)
    return next((k for k in strides if (steps % k == 0).mean() > _MIN_MULTIPLES), 1)


def _smallest_step(gaps: Floats) -> float:
    """Return the typical gap without lost pulses.

    The smallest gaps are too small if azimuths are noisy, so the estimate is refined.
    """
    step = float(np.quantile(gaps, _SMALL_GAPS, method="inverted_cdf"))
    for _ in range(_REFINEMENTS):
        near = gaps[np.abs(gaps / step - 1) < _MAX_DEVIATION]
        step = float(np.median(near))
    return step


class RingSeries(NamedTuple):
    """Values of pulses, such as azimuths or times, sorted by sweep, ring and value.

    Values increase from pulse to pulse.
    """

    values: Floats  # (n,)
    ring: Ints  # (n,)
    is_same: np.ndarray  # (n - 1,): whether the next value has the same sweep and ring

    @classmethod
    def from_values(cls, values: Floats, ring: Ints, sweep: Ints) -> RingSeries:
        """Sort values. Those of unknown rings, which are -1, are omitted."""
        known = np.flatnonzero(ring >= 0)
        order = known[np.lexsort((values[known], ring[known], sweep[known]))]
        is_same = (np.diff(ring[order]) == 0) & (np.diff(sweep[order]) == 0)
        return cls(values[order], ring[order], is_same)

    def gaps(self, smallest: float) -> tuple[Floats, Ints]:
        """Return the differences that are larger than `smallest`, and their rings."""
        gaps = np.diff(self.values)
        used = self.is_same & (gaps > smallest)
        return gaps[used], self.ring[1:][used]

    def refine_step(self, step: float, smallest: float) -> float:
        """Refine a step with the values that are many steps apart."""
        gaps = np.diff(self.values)
        steps = np.rint(gaps / step)
        # A series ends where the ring changes, or where a gap is too wide to count its pulses.
        is_joined = self.is_same & (steps <= _MAX_LOST)
        series = np.append(0, np.cumsum(~is_joined))
        joined = np.where(is_joined & (gaps > smallest), steps, 0)
        counts = np.bincount(series[1:], np.where(is_joined, joined, 0))
        lengths = np.bincount(series[1:], np.where(is_joined, gaps, 0))
        used = counts >= _MIN_COUNT
        if not used.any():
            return step
        return float(np.average(lengths[used] / counts[used], weights=counts[used]))


class RingPhases(NamedTuple):
    """Model of angles that change linearly, with a phase for each sweep and for each ring.

    ``angle = rate * x + sweep_rad[sweep] + ring_rad[ring]``, in radians modulo a revolution.
    """

    rate: float  # radians per unit of x
    ring_rad: Floats  # (r,), with a circular mean of 0, NaN for rings without values
    sweep_rad: Floats  # (s,)
    ring_spread_rad: Floats  # (r,): standard deviations of the values of each ring
    sigma_rad: float  # standard deviation of all values, without outliers

    @classmethod
    def fit(cls, angle: Floats, x: Floats, rate: float, ring: Ints, sweep: Ints) -> RingPhases:
        """Fit the model to angles in radians, given an approximate rate.

        Deviations that all rings have in common at some time do not affect the phases of the rings.
        They occur if the rotation is uneven.

        Parameters
        ----------
        angle, x
            Angles in radians and the values on which they depend, of shape (n,). `x` starts at
            about 0 in each sweep.
        rate
            Approximate derivative of the angle with respect to `x`.
        ring, sweep
            Ring and sweep of each value, of shape (n,).
        """
        rings, sweeps = ring.max() + 1, sweep.max() + 1
        ring_rad, sweep_rad = np.zeros(rings), np.zeros(sweeps)
        center = np.bincount(sweep, x, sweeps) / np.maximum(np.bincount(sweep, minlength=sweeps), 1)
        offset = x - center[sweep]
        uneven = np.zeros(len(x))
        bins = _time_bins(x, sweep)
        rest = angle
        sigma = np.inf
        for number in range(_ROUNDS):
            rest = angle - rate * x - uneven
            sweep_rad = _circular_medians(rest - ring_rad[ring], sweep, sweeps)
            ring_rad = _circular_medians(rest - sweep_rad[sweep], ring, rings)
            shift = np.angle(np.nansum(np.exp(1j * ring_rad)))
            ring_rad = _wrapped(ring_rad - shift)
            rest = _wrapped(rest - sweep_rad[sweep] - shift - ring_rad[ring])
            sigma = max(1.4826 * float(np.median(np.abs(rest))), _MIN_SIGMA)
            used = np.abs(rest) < _OUTLIER_SIGMAS * sigma
            if number < _ROUNDS // 2:
                rate += float((rest * offset)[used].sum() / np.square(offset[used]).sum())
            else:
                uneven = uneven + _bin_medians(rest, bins)
        sweep_rad = _circular_medians(angle - rate * x - ring_rad[ring], sweep, sweeps)
        spread = [_sigma(rest[ring == row]) for row in range(rings)]
        return cls(rate, ring_rad, sweep_rad, np.array(spread), sigma)


def _time_bins(x: Floats, sweep: Ints) -> Ints:
    """Return the number of the bin of each value, with `_BINS` bins in each sweep."""
    count = int(sweep.max()) + 1
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, sweep, x)
    np.maximum.at(high, sweep, x)
    share = (x - low[sweep]) / np.maximum(high - low, 1e-300)[sweep]
    return sweep * _BINS + np.minimum((share * _BINS).astype(np.int64), _BINS - 1)


def _bin_medians(values: Floats, bins: Ints) -> Floats:
    """Return the median of the bin of each value."""
    return _medians(values, bins, int(bins.max()) + 1)[bins]


def _medians(values: Floats, group: Ints, count: int) -> Floats:
    """Return the median of each group, or NaN for groups without values."""
    order = np.lexsort((values, group))
    sizes = np.bincount(group, minlength=count)
    starts = np.cumsum(sizes) - sizes
    ordered = values[order]
    medians = np.full(count, np.nan)
    present = sizes > 0
    lower = ordered[(starts + (sizes - 1) // 2)[present]]
    upper = ordered[(starts + sizes // 2)[present]]
    medians[present] = (lower + upper) / 2
    return medians


def _circular_medians(angle: Floats, group: Ints, count: int) -> Floats:
    """Return the median of the angles in each group around their circular mean, in radians."""
    phasor = np.exp(1j * angle)
    sums = np.bincount(group, phasor.real, count) + 1j * np.bincount(group, phasor.imag, count)
    mean = np.angle(sums)
    return _wrapped(mean + _medians(_wrapped(angle - mean[group]), group, count))


def _wrapped(angle: Floats) -> Floats:
    """Return angles in radians, reduced to half a revolution on either side of 0."""
    return np.asarray((angle + np.pi) % _TURN - np.pi)


def _sigma(values: Floats) -> float:
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else float("nan")
