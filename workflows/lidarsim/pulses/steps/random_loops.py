"""Random numbers for compiled loops, identical to those of `lidarsim.numerics.random_numbers`."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import inlined

from ...numerics.arrays import Ints, UInts64

SHIFT_TO_INDEX = np.uint64(48)  # keeps the upper 16 of 64 bits as an index below 65,536

_30 = np.uint64(30)
_27 = np.uint64(27)
_31 = np.uint64(31)
_11 = np.uint64(11)
_FIRST_FACTOR = np.uint64(0xBF58476D1CE4E5B9)
_SECOND_FACTOR = np.uint64(0x94D049BB133111EB)
_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_NUMBERS = np.uint64(256)  # maximum number of random numbers of a ray for one purpose
_NEXT = np.uint64(1)


class RandomKeys(NamedTuple):
    """Keys for the random numbers of consecutive beams."""

    # (scans, purposes), from `random_numbers.scan_states`; no purposes if none are needed
    states: UInts64
    scan_starts: Ints  # (scans,): number of the first beam of each scan
    first: int  # number of the first beam


@inlined
def _mixed(x):
    """Apply the final step of SplitMix64 to a 64-bit number, like `random_numbers._mixed`."""
    x = (x ^ (x >> _30)) * _FIRST_FACTOR
    x = (x ^ (x >> _27)) * _SECOND_FACTOR
    return x ^ (x >> _31)


@inlined
def bits(state, ray, number):
    """Return 64 random bits for a ray and a number.

    `state` is the hash state of the ray's scan for a purpose (`RandomKeys.states`). `ray` is the
    number of the ray in its scan.
    """
    return _mixed(state + (np.uint64(ray) * _NUMBERS + np.uint64(number) + _NEXT) * _GAMMA)


@inlined
def uniform(state, ray, number):
    """Return a uniform random number in [0, 1) that is a multiple of 2**-53."""
    return np.float64(bits(state, ray, number) >> _11) * 2.0**-53
