"""Random numbers of the simulation: hashes, which depend on nothing but their key.

A random number is a hash of (seed, name, purpose, scan, ray, number): the same on every worker and
in every batch, whatever the order of drawing.
"""

from __future__ import annotations

from functools import cache
from hashlib import sha256
from statistics import NormalDist
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import Floats

_GAMMA = 0x9E3779B97F4A7C15
_NUMBERS = 256  # random numbers of one ray


class Purpose:
    """A use of random numbers, declared by the module that draws the numbers.

    Several instances of a use, such as kinds of particles or instruments, have a seed each
    (`named_seed`).

    Parameters
    ----------
    number
        The number of the purpose in hashes, below 2**32; it never changes, for bytes depend on it.
    use
        Description of the use, in a few words.

    Raises
    ------
    ValueError
        If another purpose has the number.
    """

    declared: ClassVar[dict[int, Purpose]] = {}  # {number: purpose}, of imported modules

    number: int
    use: str

    def __init__(self, number: int, use: str) -> None:
        earlier = Purpose.declared.setdefault(number, self)
        if earlier is not self:
            raise ValueError(
                f"random number stream {number} is already used for {earlier.use!r}, so {use!r} "
                "requires a different number"
            )
        self.number = number
        self.use = use

    def __repr__(self) -> str:
        return f"Purpose({self.number}, {self.use!r})"


def _mixed(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix 64-bit numbers in place: the last step of SplitMix64 (Steele, Lea and Flood 2014)."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x ^= x >> np.uint64(shift)
        x *= np.uint64(factor)
    x ^= x >> np.uint64(31)
    return x


def named_seed(seed: int, name: str) -> int:
    """Return a seed for a name, the same on every machine, or `seed` without a name."""
    if not name:
        return seed
    return int.from_bytes(sha256(f"{seed}\n{name}".encode()).digest()[:8], "little") >> 1


def starts(seed: int, *purposes: Purpose) -> NDArray[np.uint64]:
    """Return the starts of the hashes of purposes, with a seed below 2**63: uint64 (k,)."""
    start = _mixed(np.array([int(seed) * _GAMMA % 2**64], np.uint64))
    steps = [purpose.number * _GAMMA % 2**64 for purpose in purposes]
    return _mixed(start + np.array(steps, np.uint64))


def raw(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> NDArray[np.uint64]:
    """Return 64 random bits for each ray: uint64 (n,).

    The seed is below 2**63. Scan, ray and number are (n,), or a scalar for all: `ray` is the ray
    within its scan, below 2**32, and `number` is below 256.
    """
    start = starts(seed, purpose)
    # A stream of SplitMix64 for each scan. A ray has 256 numbers of the stream.
    streams = _mixed(start + np.asarray(scan).astype(np.uint64) * np.uint64(_GAMMA))
    steps = np.asarray(ray).astype(np.uint64) * np.uint64(_NUMBERS)
    steps = steps + np.asarray(number).astype(np.uint64) + np.uint64(1)
    return _mixed(streams + steps * np.uint64(_GAMMA))


def uniform(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> Floats:
    """Return numbers uniform in [0, 1), multiples of 2**-53: (n,).

    The seed is below 2**63. Scan, ray and number are (n,), or a scalar for all: `ray` is the ray
    within its scan, below 2**32, and `number` is below 256.
    """
    bits = raw(seed, purpose, scan, ray, number) >> np.uint64(11)
    return bits.astype(np.float64) * 2.0**-53


def normal(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> Floats:
    """Return normally distributed numbers of mean 0 and variance 1: (n,).

    The numbers are quantiles of 65,536 equal shares of the distribution, so none is beyond 4.3. The
    seed is below 2**63. Scan, ray and number are (n,), or a scalar for all: `ray` is the ray within
    its scan, below 2**32, and `number` is below 256.
    """
    return quantiles()[raw(seed, purpose, scan, ray, number) >> np.uint64(48)]


@cache
def quantiles() -> Floats:
    """Return the quantiles of 65,536 equal shares of the normal distribution."""
    shares = (np.arange(2**15) + 0.5) / 2**16
    lower_half = np.array([NormalDist().inv_cdf(share) for share in shares])
    table = np.concatenate([lower_half, -lower_half[::-1]])
    # Rounded to single precision, where C libraries agree about logarithms.
    return (table / np.sqrt((table**2).mean())).astype(np.float32).astype(np.float64)
