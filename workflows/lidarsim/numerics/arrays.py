"""Type aliases for arrays, named after their element types."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
UInts32 = NDArray[np.uint32]
UInts64 = NDArray[np.uint64]
Indices = NDArray[np.intp]
Integers = NDArray[np.integer[Any]]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
AnyFloats = NDArray[np.floating[Any]]
Records = NDArray[np.void]  # rows of named fields
AnyArray = NDArray[Any]


def to_writable(array: AnyArray, kind: type = np.float64) -> AnyArray:
    """Convert an array to the form that compiled loops require.

    The result has the given dtype and is contiguous and writable. The array is copied only if
    necessary.
    """
    return np.require(array, kind, ["C", "W"])
