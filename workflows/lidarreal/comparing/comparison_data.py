"""Values that the comparison of two clouds or recordings determines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lidarsim.numerics.arrays import Floats

from .range_image import RangeImages

RESIDUALS = ("bias_m", "rmse_m", "median_m", "mad_m", "p05_m", "p95_m")
# States of a cell. The first three name the clouds in which the cell has no return.
CELLS = ("in_both", "in_a_only", "in_b_only", "returns_in_both")


@dataclass(frozen=True, eq=False, repr=False)
class ComparisonData:
    """Statistics of a comparison, and the points and images from which its charts are drawn."""

    figures: dict[str, Any]  # content of compare.json; lengths are in meters, None is unknown
    images: RangeImages | None  # range images of the first pair of sweeps that has them
    residuals: Floats  # (k,), meters: A - B in cells with returns in both, possibly sampled
    distances: tuple[Floats, Floats]  # distances from A's points to B, and from B's to A, meters
    intensities: tuple[Floats, Floats]  # paired intensities in A and in B
    # Points of A and of B in meters, from the first pair of sweeps that has points in both, or from
    # whole clouds. The first entries of `distances` belong to these points.
    points: Sequence[Floats]
