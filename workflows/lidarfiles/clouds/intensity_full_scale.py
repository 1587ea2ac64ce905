"""Full scale of the intensities in a cloud, for formats that store them as integers."""

from __future__ import annotations

import numpy as np

from lidarsim.columns.cloud import CloudLike

_SATURATED_SHARE = 0.01  # maximum fraction of points that are stored as the highest integer
_HIGHEST = 65_535  # integer that represents the full scale
_MIN_EXPONENT = -149  # exponent of the smallest float32
_EXPONENTS = 300  # number of exponents that are counted


def compute_full_scale(cloud: CloudLike) -> float | None:
    """Return the full scale of the intensities in a cloud.

    The full scale is the smallest power of two at which at most 1 % of the points are stored as
    65,535. It depends on the points only, not on their order or on how they are divided into
    chunks, so that files do not depend on how a survey was run.

    Returns
    -------
    1 for a cloud whose intensities are all zero, and None for a cloud without the column
    `intensity`.
    """
    if all(column.name != "intensity" for column in cloud.table):
        return None
    counts = np.zeros(_EXPONENTS, np.int64)
    for chunk in cloud.chunks():
        # Intensities from half a step below the full scale are rounded up to it.
        intensities = chunk["intensity"].astype(np.float64) * (_HIGHEST / (_HIGHEST - 0.5))
        _, exponents = np.frexp(intensities[intensities > 0])
        counts += np.bincount(exponents - _MIN_EXPONENT, minlength=_EXPONENTS)
    if not counts.any():
        return 1.0
    # Intensities are below the power of two of their exponent.
    saturated = counts.sum() - np.cumsum(counts)
    enough = (saturated <= _SATURATED_SHARE * len(cloud)) & (np.cumsum(counts) > 0)
    return float(2.0 ** (int(enough.argmax()) + _MIN_EXPONENT))
