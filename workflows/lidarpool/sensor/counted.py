"""Random numbers that depend only on their purpose, not on the order of drawing.

Each is a hash of (seed, purpose, scan, ray, number): the same on every worker and in every batch.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

_GAMMA = 0x9E3779B97F4A7C15
_NUMBERS = 256  # of one ray


def _mixed(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Last step of SplitMix64 (Steele, Lea and Flood 2014), in place."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x ^= x >> np.uint64(shift)
        x *= np.uint64(factor)
    x ^= x >> np.uint64(31)
    return x


def raw(
    seed: int, purpose: int, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> NDArray[np.uint64]:
    """64 random bits for each ray.

    Parameters
    ----------
    seed, purpose
        Whole numbers from 0 to 2**63.
    scan, ray, number
        (n,) or one for all: the ray within its scan, below 2**32, and the number, below 256.

    Returns
    -------
    uint64 (n,)
    """
    start = np.array([int(seed) * _GAMMA % 2**64], np.uint64)
    start = _mixed(_mixed(start) + np.uint64(purpose * _GAMMA % 2**64))
    # A stream of SplitMix64 for each scan, of which a ray has 256 numbers.
    begins = _mixed(start + np.asarray(scan).astype(np.uint64) * np.uint64(_GAMMA))
    steps = np.asarray(ray).astype(np.uint64) * np.uint64(_NUMBERS)
    steps = steps + np.asarray(number).astype(np.uint64) + np.uint64(1)
    return _mixed(begins + steps * np.uint64(_GAMMA))


def uniform(
    seed: int, purpose: int, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> NDArray[np.float64]:
    """Numbers uniform in [0, 1), multiples of 2**-53: (n,); arguments as of `raw`."""
    bits = raw(seed, purpose, scan, ray, number) >> np.uint64(11)
    return bits.astype(np.float64) * 2.0**-53


def normal(
    seed: int, purpose: int, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> NDArray[np.float64]:
    """Numbers of mean 0 and variance 1, normally distributed: (n,); arguments as of `raw`.

    They are quantiles of 65,536 equal shares of the distribution, so none is beyond 4.3.
    Logarithms and cosines of random numbers would not have the same bits on every machine.
    """
    return _quantiles()[raw(seed, purpose, scan, ray, number) >> np.uint64(48)]


@cache
def _quantiles() -> NDArray[np.float64]:
    shares = (np.arange(2**15) + 0.5) / 2**16
    low = np.array([NormalDist().inv_cdf(share) for share in shares])
    table = np.concatenate([low, -low[::-1]])
    # To single precision, in which logarithms are the same on every machine.
    return (table / np.sqrt((table**2).mean())).astype(np.float32).astype(np.float64)
