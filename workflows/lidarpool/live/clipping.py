"""Triangles and lines cut off at a height."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float32]


def triangles_below(corners: Reals, height: float) -> tuple[Reals, NDArray[np.int64]]:
    """Cut triangles at a height and keep what is below.

    Parameters
    ----------
    corners
        (f, 3, 3), finite, metres.
    height
        Metres.

    Returns
    -------
    corners
        (n, 3, 3): whole triangles and pieces, wound as they were.
    source
        (n,): for each the triangle that it is of.
    """
    above = corners[:, :, 2] > height
    count = above.sum(axis=1)
    whole, one, two = (np.flatnonzero(count == n) for n in (0, 1, 2))
    # The corner that is alone on its side comes first.
    a, b, c = _turned(corners[one], above[one].argmax(axis=1))
    ab, ac = _crossing(a, b, height), _crossing(a, c, height)
    d, e, f = _turned(corners[two], (~above[two]).argmax(axis=1))
    pieces = [
        corners[whole],
        np.stack([ab, b, c], axis=1),
        np.stack([ab, c, ac], axis=1),
        np.stack([d, _crossing(d, e, height), _crossing(d, f, height)], axis=1),
    ]
    return np.concatenate(pieces), np.concatenate([whole, one, one, two])


def lines_below(ends: Reals, height: float) -> Reals:
    """Cut lines (n, 2, 3) at a height and keep what is below; those wholly above are dropped."""
    above = ends[:, :, 2] > height
    out = ends[~above.all(axis=1)].copy()
    above = above[~above.all(axis=1)]
    for end in (0, 1):
        cut = above[:, end]
        out[cut, end] = _crossing(out[cut, end], out[cut, 1 - end], height)
    return out


def _turned(corners: Reals, first: NDArray[np.int64]) -> tuple[Reals, Reals, Reals]:
    """Corners of triangles (n, 3, 3), in their order, beginning with that of this number (n,)."""
    rows = np.arange(len(corners))
    a, b, c = (corners[rows, (first + k) % 3] for k in range(3))
    return a, b, c


def _crossing(a: Reals, b: Reals, height: float) -> Reals:
    """Where lines from a to b, (n, 3) both and on two sides of a height, cross it."""
    share = (height - a[:, 2]) / (b[:, 2] - a[:, 2])
    out = a + share[:, None] * (b - a)
    out[:, 2] = height
    return out
