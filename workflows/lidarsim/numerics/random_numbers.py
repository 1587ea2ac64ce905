"""Counter-based random numbers for the simulation.

Each random number is a hash of its key, which consists of the seed, name, purpose, scan, ray and
number. It is therefore the same on every worker and in every batch, regardless of the order in
which numbers are drawn.
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
_ONE = np.uint64(1)
_NUMBERS = 256  # maximum number of random numbers per ray and purpose


class Purpose:
    """A purpose for which random numbers are drawn, declared by the module that draws them.

    If a purpose has several instances, such as kinds of particles or instruments, each instance has
    its own seed (`named_seed`).

    Parameters
    ----------
    number
        Number of the purpose in hashes, less than 2**32. It must never change because results
        depend on it.
    use
        Description of the purpose in a few words.

    Raises
    ------
    ValueError
        If the number is already used by a different purpose.
    """

    declared: ClassVar[dict[int, Purpose]] = {}  # {number: purpose}, for imported modules

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
    """Mix 64-bit numbers in place with the finalizer of SplitMix64 (Steele, Lea and Flood 2014)."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x ^= x >> np.uint64(shift)
        x *= np.uint64(factor)
    x ^= x >> np.uint64(31)
    return x


def hash_rows(*columns: NDArray[np.integer]) -> NDArray[np.uint64]:
    """Return a 64-bit hash of each row of integer columns.

    The columns and the result have shape (n,). Two different rows have the same hash with a
    probability of 2**-64.
    """
    state = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        state = _mixed(state * np.uint64(_GAMMA) + column.astype(np.int64).view(np.uint64) + _ONE)
    return state


def named_seed(seed: int, name: str) -> int:
    """Derive a seed from a seed and a name.

    The result is the same on every machine. If the name is empty, `seed` is returned unchanged.
    """
    if not name:
        return seed
    return int.from_bytes(sha256(f"{seed}\n{name}".encode()).digest()[:8], "little") >> 1


def initial_states(seed: int, *purposes: Purpose) -> NDArray[np.uint64]:
    """Return the initial hash state for each purpose.

    The seed must be less than 2**63. The result has dtype uint64 and shape (k,).
    """
    start = _mixed(np.array([int(seed) * _GAMMA % 2**64], np.uint64))
    steps = [purpose.number * _GAMMA % 2**64 for purpose in purposes]
    return _mixed(start + np.array(steps, np.uint64))


def scan_states(seed: int, purposes: tuple[Purpose, ...], scans: ArrayLike) -> NDArray[np.uint64]:
    """Return the hash state of each scan for each purpose.

    `scans` has shape (s,), and the result has shape (s, purposes).
    """
    steps = np.asarray(scans).astype(np.uint64) * np.uint64(_GAMMA)
    return _mixed(initial_states(seed, *purposes) + steps[:, None])


def raw(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> NDArray[np.uint64]:
    """Return 64 random bits for each ray.

    The seed must be less than 2**63. `scan`, `ray` and `number` are scalars or have shape (n,).
    `ray` is the index of the ray in its scan and must be less than 2**32, and `number` must be less
    than 256. The result has dtype uint64 and shape (n,).
    """
    start = initial_states(seed, purpose)
    # Each scan has its own SplitMix64 stream, in which each ray has 256 numbers.
    streams = _mixed(start + np.asarray(scan).astype(np.uint64) * np.uint64(_GAMMA))
    steps = np.asarray(ray).astype(np.uint64) * np.uint64(_NUMBERS)
    steps = steps + np.asarray(number).astype(np.uint64) + np.uint64(1)
    return _mixed(streams + steps * np.uint64(_GAMMA))


def uniform(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> Floats:
    """Draw numbers that are uniformly distributed in [0, 1).

    The numbers are multiples of 2**-53 and have shape (n,). See `raw` for the parameters.
    """
    bits = raw(seed, purpose, scan, ray, number) >> np.uint64(11)
    return bits.astype(np.float64) * 2.0**-53


def normal(
    seed: int, purpose: Purpose, scan: ArrayLike, ray: ArrayLike, number: ArrayLike = 0
) -> Floats:
    """Draw numbers from a normal distribution with mean 0 and variance 1.

    The distribution is approximated by 65,536 quantiles, so no magnitude exceeds 4.3. The result
    has shape (n,). See `raw` for the parameters.
    """
    return quantiles()[raw(seed, purpose, scan, ray, number) >> np.uint64(48)]


@cache
def quantiles() -> Floats:
    """Return 65,536 equally probable quantiles of the standard normal distribution."""
    fractions = (np.arange(2**15) + 0.5) / 2**16
    lower_half = np.array([NormalDist().inv_cdf(fraction) for fraction in fractions])
    table = np.concatenate([lower_half, -lower_half[::-1]])
    # The logarithms of different C libraries agree once they are rounded to single precision.
    return (table / np.sqrt((table**2).mean())).astype(np.float32).astype(np.float64)
