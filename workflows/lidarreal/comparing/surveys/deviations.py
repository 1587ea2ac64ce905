"""Deviations between two clouds, and the statistics that surveyors report for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidarsim.numerics.arrays import Floats

NORMAL = ("normal_x", "normal_y", "normal_z")
STATISTICS = ("mean_m", "std_m", "rmse_m", "median_m", "p95_abs_m", "min_m", "max_m")


@dataclass(frozen=True, eq=False)
class Deviations:
    """Deviations of A from B at n positions."""

    points: Floats  # (n, 3): world coordinates in meters
    # {name: values of shape (n,)} in meters, such as `delta_h` or `distance`.
    components: dict[str, Floats]
    # Further entries of compare.json.
    figures: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    # Further values of shape (n,), such as `normal_x` and `level_of_detection`.
    columns: dict[str, Floats] = field(default_factory=dict)


def normal_columns(normals: Floats) -> dict[str, Floats]:
    """Return the columns of normals, of shape (n, 3)."""
    return dict(zip(NORMAL, normals.T, strict=True))


def statistics(values: Floats) -> dict[str, Any]:
    """Return statistics of deviations in meters, which are None if there are no deviations.

    ``std_m`` is the sample standard deviation about the mean, ``rmse_m`` the root mean square about
    zero, and ``p95_abs_m`` the empirical 95th percentile of the absolute values.

    Examples
    --------
    >>> found = statistics(np.array([0.01, 0.03]))
    >>> found["count"], round(found["mean_m"], 3), round(found["rmse_m"], 5)
    (2, 0.02, 0.02236)
    """
    count = len(values)
    if not count:
        return {"count": 0, **dict.fromkeys(STATISTICS)}
    figures = (
        values.mean(),
        values.std(ddof=1) if count > 1 else 0.0,
        np.sqrt(np.mean(values**2)),
        np.median(values),
        np.quantile(np.abs(values), 0.95),
        values.min(),
        values.max(),
    )
    return {"count": count, **dict(zip(STATISTICS, map(float, figures), strict=True))}
