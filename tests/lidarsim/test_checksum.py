"""Checksums are those of zlib, whichever library computes them."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from lidarsim.io.checksum import crc32


@pytest.mark.parametrize("size", [0, 1, 15, 64, 1000, 1 << 20])
def test_checksums_are_those_of_zlib(size):
    data = np.random.default_rng(size).bytes(size)
    assert crc32(data) == zlib.crc32(data)
    assert crc32(memoryview(data)[size // 3 :], 7) == zlib.crc32(data[size // 3 :], 7)
    assert crc32(data[size // 2 :], crc32(data[: size // 2])) == zlib.crc32(data)
