"""Noise of ranges and angles, and lost returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..base.arguments import checked_fields
from ..base.declared import Seed, Share
from .counted import normal, uniform
from .materials import at_right_angles

# Detection threshold for signal plus noise, in standard deviations.
THRESHOLD_SIGMAS = 5.0
TARGET_REFLECTANCE = 0.1  # reflectance of stated ranges

_RANGE, _ACROSS, _UP, _DETECTION, _LOSS = range(1, 6)  # purposes of random numbers

Whole = NDArray[np.integer[Any]]
Real = NDArray[np.float64]


@dataclass(frozen=True)
@checked_fields
class Noise:
    """Noise of ranges and angles, and lost returns; without arguments there is none.

    The standard deviation of a range of r metres is ``range_m + range_per_m * r``. Rays are cast in
    directions with noise, and reported with angles without. Stated detection ranges are for
    surfaces at right angles in clear air.

    Raises
    ------
    LidarpoolError
        If a number is outside its range.
    """

    range_m: Annotated[
        float, Field(ge=0, le=1000, description="standard deviation of ranges, metres")
    ] = 0.0
    range_per_m: Annotated[
        float, Field(ge=0, le=1, description="standard deviation added for each metre of range")
    ] = 0.0
    angle_deg: Annotated[
        float, Field(ge=0, le=10, description="standard deviation of beam directions, in both axes")
    ] = 0.0
    dropout: Annotated[
        Share, Field(description="share of returns that are lost, whatever their energy")
    ] = 0.0
    detection_range_m: Annotated[
        float | None,
        Field(
            ge=0.001,
            le=1e8,
            description="range at which a surface of 10 % reflectance returns half the pulses; "
            "weaker returns are lost",
            examples=[100.0],
        ),
    ] = None
    seed: Annotated[Seed, Field(description="the same seed gives the same noise")] = 0

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
