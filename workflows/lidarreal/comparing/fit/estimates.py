"""Estimates with 95 % confidence intervals."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints

MIN_RAYS = 30  # minimum number of rays for an estimate or a point of a curve
_CONFIDENCE = 0.95  # confidence level of intervals
_CONFIDENCE_SIGMAS = 1.959964  # half width of the interval of a normal distribution


class Estimate(NamedTuple):
    """Estimate of a value, with its confidence interval."""

    value: float
    low: float
    high: float

    @classmethod
    def from_variance(cls, value: Any, variance: Any) -> Estimate:
        """Create an estimate of a normally distributed value with the given variance."""
        half = _CONFIDENCE_SIGMAS
        return cls(*(float(value + sigmas * np.sqrt(variance)) for sigmas in (0, -half, half)))

    @classmethod
    def from_values(cls, values: Floats) -> Estimate:
        """Estimate the mean of the given values."""
        return cls.from_variance(values.mean(), values.var() / len(values))

    @classmethod
    def from_shares(cls, counts: Floats, totals: Ints) -> Estimate:
        """Estimate the ratio of the sum of `counts` to the sum of `totals`, such as a loss rate.

        Both arrays have shape (n,). The Clopper-Pearson interval is computed for an effective
        number of independent pulses. For this number, the binomial variance equals the observed
        variance of the ratio over the n entries. It is at most the sum of `totals`. The interval is
        not empty even if the ratio is 0.
        """
        from scipy.stats import beta

        total = float(totals.sum())
        fraction = float(counts.sum()) / total
        fraction_variance = float(((counts - fraction * totals) ** 2).sum()) / total**2
        binomial_variance = fraction * (1 - fraction) / total
        pulses = (
            total * binomial_variance / fraction_variance
            if fraction_variance > binomial_variance > 0
            else total
        )
        tail = (1 - _CONFIDENCE) / 2
        lower = (
            beta.ppf(tail, fraction * pulses, (1 - fraction) * pulses + 1) if fraction > 0 else 0.0
        )
        upper = (
            beta.isf(tail, fraction * pulses + 1, (1 - fraction) * pulses) if fraction < 1 else 1.0
        )
        return cls(fraction, float(lower), float(upper))

    def is_within(self, share: float) -> bool:
        """Return whether the estimate is precise enough.

        Half of the confidence interval must be at most `share` times the value.
        """
        return self.high - self.low <= 2 * share * abs(self.value)

    def power(self, exponent: float, scale: float = 1.0) -> Estimate:
        """Return the estimate of the value raised to a power and multiplied by `scale`.

        Negative values are treated as 0.
        """
        value, *limits = (round(float(scale * max(number, 0.0) ** exponent), 9) for number in self)
        return Estimate(value, min(limits), max(limits))


def sandwich(design: Floats, residuals: Floats, patch: Ints | None = None) -> Floats:
    """Estimate the covariance of a least-squares fit whose residuals have unequal variances.

    `residuals` has shape (k,). If `patch` is given, residuals with the same patch number may be
    correlated, for example because they belong to the same surface.
    """
    inverse = np.linalg.pinv(design.T @ design, hermitian=True)
    score = design * residuals[:, None]
    if patch is not None:
        _, patch = np.unique(patch, return_inverse=True)
        sums = np.zeros((patch.max() + 1, score.shape[1]))
        np.add.at(sums, patch, score)
        score = sums * np.sqrt(len(sums) / max(len(sums) - 1, 1))
    covariance: Floats = inverse @ (score.T @ score) @ inverse
    return covariance
