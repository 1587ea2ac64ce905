"""Scales of intensities in cloud files: Leica's signed scale, and limits that scans state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...numerics.arrays import AnyArray

LEICA_LOWEST = -2048  # Leica's scale ends at 2047
_LEICA_HIGHEST = 2047
_MIN_LEICA_SPAN = 256  # decibels, which are negative as well, span less
_PLAIN_STEPS = {1.0, *(2.0**n for n in range(1, 32)), *(float(f"1e{n}") for n in range(1, 9))}
_OTHER_SCALE = 16  # ratio of limits that measurements of the same scale do not reach


class Limits(NamedTuple):
    """Lowest and highest intensity of a scan."""

    low: float
    high: float

    def is_plain(self) -> bool:
        """Return True for the limits of a scale, such as 0 to 1, 100, 255 or 4096."""
        steps = {self.high, self.high + 1}
        return self.low == 0 and not steps.isdisjoint(_PLAIN_STEPS)

    def apply(self, intensities: AnyArray) -> AnyArray:
        """Return intensities (n,) as shares of the limits, at least 0."""
        return np.maximum((intensities - self.low) / (self.high - self.low), 0.0)


def scales_of(limits: Sequence[Limits]) -> Sequence[Limits] | None:
    """Return the limits by which the intensities of scans are brought to the same scale.

    Many programs write the lowest and highest intensity that a scan happens to have as its limits,
    although all scans have the same scale. Different limits are therefore different scales only if
    they differ by a factor of 16, or if all of them are plain limits such as 0 to 255.

    Returns
    -------
    None if the intensities have the same scale already, and it begins at 0.
    """
    if not limits:
        return None
    low = min(limit.low for limit in limits)
    highs = [max(limit.high, -limit.low) for limit in limits]
    are_scales = all(limit.is_plain() or limit.low == LEICA_LOWEST for limit in limits)
    if len(set(limits)) > 1 and (are_scales or max(highs) >= _OTHER_SCALE * min(highs)):
        return limits
    if low < 0:
        return [Limits(low, max(limit.high for limit in limits))] * len(limits)
    return None


def from_zero(intensities: AnyArray) -> tuple[AnyArray, str]:
    """Return intensities (n,) that begin at zero, and a clause on them if their scale is unknown.

    Negative intensities that fit Leica's scale, -2048 to 2047, are shifted by 2048, others so that
    the lowest becomes 0.
    """
    finite = intensities[np.isfinite(intensities)]
    low = float(finite.min(initial=0))
    high = float(finite.max(initial=low))
    if low >= 0:
        return intensities, ""
    if low >= LEICA_LOWEST and high <= _LEICA_HIGHEST and high - low >= _MIN_LEICA_SPAN:
        return intensities - LEICA_LOWEST, ""
    clause = (
        f"has intensities from {low:g} to {high:g} on an unknown scale. They were shifted so that "
        f"{low:g} becomes 0"
    )
    return intensities - low, clause
