"""What callers give, as an array."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def as_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """Return an array of any kind, copied only if it is none yet.

    Raises
    ------
    ValueError
        If the rows are not alike, with the name of the argument, which NumPy does not know.
    """
    try:
        return np.asarray(values)
    except ValueError as error:
        raise ValueError(
            f"{name} must be an array or rows of numbers, each of the same length: {error}"
        ) from error
