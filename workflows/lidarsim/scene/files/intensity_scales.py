"""Conversion of intensities in point cloud files to a common scale.

Scales are either Leica's signed scale or defined by the intensity limits in the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...numerics.arrays import AnyArray

LEICA_LOWEST = -2048
_LEICA_HIGHEST = 2047
_MIN_LEICA_SPAN = 256  # intensities in decibels are also negative, but their range is smaller
_PLAIN_STEPS = {1.0, *(2.0**n for n in range(1, 32)), *(float(f"1e{n}") for n in range(1, 9))}
_OTHER_SCALE = 16  # measured limits on the same scale differ by a smaller factor


class Limits(NamedTuple):
    """The lowest and highest intensity of a scan."""

    low: float
    high: float

    def is_plain(self) -> bool:
        """Return whether the limits are typical of a full scale, such as 0 to 1, 100 or 255."""
        steps = {self.high, self.high + 1}
        return self.low == 0 and not steps.isdisjoint(_PLAIN_STEPS)

    def apply(self, intensities: AnyArray) -> AnyArray:
        """Normalize intensities so that the limits become 0 and 1.

        Negative results are clipped to 0.
        """
        return np.maximum((intensities - self.low) / (self.high - self.low), 0.0)


def common_limits(limits: Sequence[Limits]) -> Sequence[Limits] | None:
    """Return the limits that convert the intensities of all scans to the same scale.

    Many programs write the lowest and highest measured intensity of each scan as its limits,
    although all scans have the same scale. Different limits are therefore interpreted as different
    scales only in two cases: if they differ by a factor of 16, or if all of them are plain limits,
    such as 0 to 255, or start at the lowest value of Leica's scale.

    Returns
    -------
    Sequence[Limits] or None
        The limits of each scan, or None if all intensities already have the same scale and start at
        0.
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
    """Shift negative intensities so that they start at zero.

    Negative intensities on Leica's scale (-2048 to 2047) are shifted by 2048. On other scales, the
    lowest intensity becomes 0. In this case, the second value is a note for the user. Otherwise, it
    is an empty string.
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
