"""Noise of ranges and angles, and lost returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arguments import checked_fields
from .counted import normal, uniform
from .materials import at_right_angles
from .optics import check_numbers

# Detection threshold for signal plus noise, in standard deviations.
THRESHOLD_SIGMAS = 5.0
TARGET_REFLECTANCE = 0.1  # reflectance of stated ranges

_RANGE, _ACROSS, _UP, _DETECTION, _LOSS = range(1, 6)  # purposes of random numbers

Whole = NDArray[np.integer[Any]]
Real = NDArray[np.float64]


@dataclass(frozen=True)
@checked_fields
class Noise:
    """Noise; without arguments there is none.

    Parameters
    ----------
    range_m, range_per_m
        Standard deviation of a range of r metres: ``range_m + range_per_m * r``.
    angle_deg
        Standard deviation of beam directions, in each of the two directions across. The ray is
        cast there; the reported angle has no noise.
    dropout
        Share of returns that are lost whatever their energy, 0 to 1.
    detection_range_m
        Range at which half of the pulses from a surface of 10 % reflectance are detected, at right
        angles in clear air; None if all are detected, at any range.
    seed
        Another seed gives other noise.

    Raises
    ------
    LidarpoolError
        If a number is outside its range.
    """

    range_m: float = 0.0
    range_per_m: float = 0.0
    angle_deg: float = 0.0
    dropout: float = 0.0
    detection_range_m: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_numbers(self, {"range_m": (0, 1e3), "range_per_m": (0, 1), "angle_deg": (0, 10)})
        check_numbers(self, {"dropout": (0, 1), "detection_range_m": (1e-3, 1e8)})
        check_numbers(self, {"seed": (0, 2**63 - 1)})

    @property
    def loses(self) -> bool:
        """Whether returns can be lost."""
        return self.dropout > 0 or self.detection_range_m is not None

    def ranges(self, distance: Real, scan: Whole, ray: Whole, number: Whole) -> Real:
        """Return the reported ranges of returns (n,), metres, at least 0."""
        sigma = self.range_m + self.range_per_m * distance
        return np.maximum(distance + sigma * normal(self.seed, _RANGE, scan, ray, number), 0)

    def angles(self, scan: Whole, ray: Whole) -> tuple[Real, Real]:
        """Deviations of beams, across and up: (n,) and (n,), radians."""
        sigma = np.radians(self.angle_deg)
        return (
            sigma * normal(self.seed, _ACROSS, scan, ray),
            sigma * normal(self.seed, _UP, scan, ray),
        )

    def detected(self, energy: Real, scan: Whole, ray: Whole, number: Whole) -> NDArray[np.bool_]:
        """Whether returns (n,) are detected.

        The signal with its normally distributed noise has to pass a threshold: at an energy equal
        to the threshold half of the returns are detected, at 1.4 times as much 97.7 %, and at a
        fifth of it 3 in 100,000.
        """
        seen = uniform(self.seed, _LOSS, scan, ray, number) >= self.dropout
        if self.detection_range_m is not None:
            threshold = TARGET_REFLECTANCE * at_right_angles(self.detection_range_m)
            above = THRESHOLD_SIGMAS * (energy / threshold - 1)
            seen &= above + normal(self.seed, _DETECTION, scan, ray, number) > 0
        return seen
