"""Detection of withheld points and noise points, which LAS files mark as unusable.

According to ASPRS LAS 1.4 R15, withheld points should not be included in processing, as if they
were deleted. Class 7 is low noise, and class 18 is high noise, but only in point formats 6 to 10.
Programs that convert LAS files keep these columns under different names.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...numerics.arrays import AnyArray, Bools
from ...words import plural

NOISE_CLASSES = (7, 18)
LEGACY_NOISE_CLASSES = (7,)  # in point formats 0 to 5
_CLASS_COLUMN = "classification"
_WITHHELD_COLUMNS = ("withheld", "withheldflag", "classifwithheldflag")


class OmittedPoints(NamedTuple):
    """Number of omitted points for each reason."""

    withheld: int = 0
    noise: int = 0

    def omission_note(self) -> str:
        """Return a note that states the numbers, or an empty string if no points were omitted."""
        kinds = []
        if self.withheld:
            kinds.append(f"{plural(self.withheld, 'withheld point')}")
        if self.noise:
            kinds.append(f"{plural(self.noise, 'noise point')} (classes 7 and 18)")
        verb = "was" if sum(self) == 1 else "were"
        keeps = (
            f"To keep {'it' if verb == 'was' else 'them'}, use --keep-noise (keep_noise=True in "
            "Python)"
        )
        return f"{' and '.join(kinds)} {verb} skipped. {keeps}" if kinds else ""


@lru_cache(maxsize=64)
def _marking_columns(names: tuple[str, ...]) -> tuple[str | None, str | None]:
    """Return the names of the classification column and the withheld column, if present."""
    letters = {name: re.sub("[^a-z]", "", name.lower().removeprefix("scalar_")) for name in names}
    classes = (name for name in names if letters[name] == _CLASS_COLUMN)
    withheld = (name for name in names if letters[name] in _WITHHELD_COLUMNS)
    return next(classes, None), next(withheld, None)


def usable_points(
    columns: Mapping[str, AnyArray], noise_classes: Collection[int] = NOISE_CLASSES
) -> tuple[Bools | None, OmittedPoints]:
    """Return a mask of the usable points and the numbers of omitted points.

    Withheld points and noise points are not usable. The mask has shape (n,), or is None if all
    points are usable.

    Parameters
    ----------
    columns
        Columns of a file, named as in LAS or by a program that converts LAS files. Each has shape
        (n,).
    noise_classes
        Noise classes, which are `NOISE_CLASSES` or `LEGACY_NOISE_CLASSES`.
    """
    class_column, withheld_column = _marking_columns(tuple(columns))
    noise: Bools | None = None
    withheld: Bools | None = None
    if class_column is not None:
        noise = np.isin(np.asarray(columns[class_column]), list(noise_classes))
    if withheld_column is not None:
        withheld = np.asarray(columns[withheld_column]) != 0
    marks = [marks for marks in (withheld, noise) if marks is not None and marks.any()]
    if not marks:
        return None, OmittedPoints()
    withheld_count = 0 if withheld is None else int(np.count_nonzero(withheld))
    unusable = np.logical_or.reduce(marks)
    noise_count = int(np.count_nonzero(unusable)) - withheld_count
    return ~unusable, OmittedPoints(withheld_count, noise_count)
