"""Random numbers for compiled loops: those of `lidarsim.sensor.random_numbers`, one at a time."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import inlined

from ..base.arrays import AnyArray, Ints

SHIFT_TO_INDEX = np.uint64(48)  # of random bits, so that one of 65,536 equal shares is left

_30 = np.uint64(30)
_27 = np.uint64(27)
_31 = np.uint64(31)
_11 = np.uint64(11)
_FIRST_FACTOR = np.uint64(0xBF58476D1CE4E5B9)
_SECOND_FACTOR = np.uint64(0x94D049BB133111EB)
_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_NUMBERS = np.uint64(256)  # of one ray
_NEXT = np.uint64(1)


class RandomKeys(NamedTuple):
    """What the random numbers of consecutive beams depend on, beside the number of each."""

    starts: AnyArray  # uint64 (purposes,), see `random_numbers.starts`; empty if none are drawn
    scan: int  # number of the first scan
    begins: Ints  # (scans,): numbers of the beams at which scans begin
    first: int  # number of the first beam


@inlined
def _mixed(x):
    """Return the last step of SplitMix64, as `random_numbers._mixed` does, of one number."""
    x = (x ^ (x >> _30)) * _FIRST_FACTOR
    x = (x ^ (x >> _27)) * _SECOND_FACTOR
    return x ^ (x >> _31)


@inlined
def bits(start, scan, ray, number):
    """Return 64 random bits: of a purpose, by the start of its hashes."""
    begin = _mixed(start + np.uint64(scan) * _GAMMA)
    return _mixed(begin + (np.uint64(ray) * _NUMBERS + np.uint64(number) + _NEXT) * _GAMMA)


@inlined
def uniform(start, scan, ray, number):
    """Return a number uniform in [0, 1), a multiple of 2**-53."""
    return np.float64(bits(start, scan, ray, number) >> _11) * 2.0**-53
