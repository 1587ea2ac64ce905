"""Return numbers of points, as far as they are known."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.numerics.arrays import AnyArray
from lidarsim.sweeps.sweeps import Sweeps

RETURN_COLUMNS = ("return_number", "returns")


def return_numbers(points: Cloud, sweeps: Sweeps) -> tuple[AnyArray, AnyArray] | None:
    """Return the number of each return, starting at 1, and the number of returns of its pulse.

    Both arrays have shape (n,). The result is None if the points do not have both columns, unless
    no sensor reports more than one return per pulse.
    """
    if {*RETURN_COLUMNS} <= points.columns.keys():
        return points["return_number"], points["returns"]
    if sweeps.has_single_returns:
        ones = np.ones(len(points), np.uint8)
        return ones, ones
    return None


def known_columns(names: Collection[str], sweeps: Sweeps) -> set[str]:
    """Return the columns with these names, and the columns that follow from the return mode."""
    return {*names, *(RETURN_COLUMNS if sweeps.has_single_returns else ())}
