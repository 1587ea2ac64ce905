"""Random numbers of a campaign's jobs: hashes, the same on every machine and in every year.

A number depends on the campaign's seed, the job's number, what it is for, and how many were drawn
for that before. So a quantity that is added, removed or moved leaves the others as they are, and
so does the number of jobs.

Numbers are made of integers, of single operations on floats, and of the logarithms, roots and
powers of `decimal`, which are rounded correctly everywhere. Those of C and of NumPy differ in the
last bit from one processor or library to the next.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from decimal import Context, Decimal
from itertools import accumulate

import numpy as np

SIGMAS = 6.0  # normal numbers are drawn again beyond, one of 500 million
SHARE_LEAST = 0.01  # of a normal distribution that lies within limits

_EXACT = Context(prec=40)
_DIGITS = 12  # that numbers are rounded to, so that tables are readable and hold the exact number


class Draw:
    """Random numbers of one job for one purpose; each call draws the next.

    Examples
    --------
    >>> Draw(7, 417, "weather.visibility_km").uniform(0.2, 20)
    18.853258822
    """

    def __init__(self, seed: int, number: int, purpose: str) -> None:
        self._hash = hashlib.sha256(f"{seed}\n{number}\n{purpose}\n".encode())
        self._drawn = 0

    def bits(self, count: int = 64) -> int:
        """Draw so many bits, 256 at most."""
        self._drawn += 1
        digest = self._hash.copy()
        digest.update(str(self._drawn).encode())
        return int.from_bytes(digest.digest(), "big") >> (256 - count)

    def below(self, count: int) -> int:
        """Draw a whole number from 0 to count - 1."""
        return self.bits(128) * count >> 128

    def integer(self, low: int, high: int) -> int:
        """Draw a whole number, both ends included."""
        return low + self.below(high - low + 1)

    def unit(self) -> float:
        """Draw a number from 0 to 1, without 1."""
        return self.bits(53) * 2.0**-53

    def uniform(self, low: float, high: float) -> float:
        """Draw a number from an interval."""
        return _within(_short(low + (high - low) * self.unit()), low, high)

    def log_uniform(self, low: float, high: float) -> float:
        """Draw a number whose logarithm is uniform."""
        begin, end = (_EXACT.ln(Decimal(one)) for one in (low, high))
        share = _share(self.bits(53))
        drawn = _EXACT.exp(_EXACT.add(begin, _EXACT.multiply(share, _EXACT.subtract(end, begin))))
        return _within(_short(float(drawn)), low, high)

    def normal(self, mean: float, std: float, limits: tuple[float, float] | None = None) -> float:
        """Draw a normally distributed number; outside the limits it is drawn again."""
        low, high = limits or (mean - SIGMAS * std, mean + SIGMAS * std)
        while True:
            drawn = _short(mean + std * self._standard())
            if low <= drawn <= high:
                return drawn

    def _standard(self) -> float:
        """Polar method of Marsaglia and Bray (1964)."""
        while True:
            x, y = (_share(2 * self.bits(53) + 1 - 2**53) for _ in range(2))
            square = _EXACT.fma(x, x, _EXACT.multiply(y, y))
            if square < 1:
                ratio = _EXACT.divide(_EXACT.multiply(Decimal(-2), _EXACT.ln(square)), square)
                return float(_EXACT.multiply(x, _EXACT.sqrt(ratio)))

    def position(self, count: int, weights: Sequence[float] = ()) -> int:
        """Draw the position of one of several things, all alike or with weights."""
        if not weights:
            return self.below(count)
        ends = list(accumulate(weights))
        drawn = self.unit() * ends[-1]
        return next((i for i, end in enumerate(ends) if drawn < end), count - 1)

    def subset(self, count: int, chosen: int) -> list[int]:
        """Draw different numbers below `count`, in order (Floyd 1987)."""
        found: set[int] = set()
        for last in range(count - chosen, count):
            drawn = self.below(last + 1)
            found.add(last if drawn in found else drawn)
        return sorted(found)

    def order(self, count: int) -> list[int]:
        """Draw an order of the numbers below `count` (Fisher and Yates)."""
        found = list(range(count))
        for last in range(count - 1, 0, -1):
            other = self.below(last + 1)
            found[last], found[other] = found[other], found[last]
        return found

    def generator(self) -> np.random.Generator:
        """Return a generator of NumPy, for functions that draw for themselves."""
        return np.random.Generator(np.random.Philox(key=self.bits(128)))


def _share(bits: int) -> Decimal:
    return _EXACT.divide(Decimal(bits), Decimal(2**53))


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
