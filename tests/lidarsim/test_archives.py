"""Archives without compression: the bytes of zipfile, in pieces that are views of the arrays."""

from __future__ import annotations

import io
import sys
import zipfile
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarsim.io import archives
from lidarsim.io.archives import archive_pieces, read_arrays


def zipfile_bytes(arrays):
    """The same archive as Python's zipfile and NumPy write it."""
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            with archive.open(info, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), (1, 0))
    return memory.getvalue()


def assert_bytes_of_zipfile(data, arrays):
    # Before Python 3.11.4, zipfile wrote sizes of 64 bits only for large files.
    if sys.version_info >= (3, 11, 4):
        assert data == zipfile_bytes(arrays)


ARRAYS = {
    ".scans": np.array([3, 5]),
    ".samples": np.arange(24, dtype=np.float32).reshape(2, 4, 3),
    "x": np.arange(40, dtype=np.int32)[::2],
    "höhe": np.linspace(0, 1, 7),
    "waveform": np.zeros(3, "V46"),
    "none": np.zeros((0, 4, 3), np.float32),
}


def test_bytes_are_those_of_zipfile_and_numpy_reads_them():
    data = b"".join(archive_pieces(ARRAYS))
    assert_bytes_of_zipfile(data, ARRAYS)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
    with np.load(io.BytesIO(data)) as loaded:
        assert loaded.files == [*ARRAYS]
        assert all(np.array_equal(loaded[name], array) for name, array in ARRAYS.items())
    assert all(np.array_equal(a, ARRAYS[name]) for name, a in read_arrays(data).items())


@pytest.mark.parametrize("limit", [0, 150, 400, 800, 10_000])
def test_numbers_of_64_bits_are_where_zipfile_has_them(limit):
    """As of a part of more than 2 GiB, with a smaller limit."""
    with patch.object(zipfile, "ZIP64_LIMIT", limit), patch.object(archives, "_MAX_SIZE", limit):
        data = b"".join(archive_pieces(ARRAYS))
        assert_bytes_of_zipfile(data, ARRAYS)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None


@settings(max_examples=30)
@given(st.lists(st.integers(0, 9), max_size=5), st.sampled_from(["u1", "<i4", "<f8", ">u2"]))
def test_arrays_of_any_length(lengths, kind):
    arrays = {f"column{i}": np.arange(length).astype(kind) for i, length in enumerate(lengths)}
    data = b"".join(archive_pieces(arrays))
    assert_bytes_of_zipfile(data, arrays)
    assert all(np.array_equal(a, arrays[name]) for name, a in read_arrays(data).items())


def test_columns_are_not_copied():
    column = np.arange(1000)
    views = [piece for piece in archive_pieces({"x": column}) if isinstance(piece, memoryview)]
    assert len(views) == 1 and np.shares_memory(np.frombuffer(views[0], np.uint8), column)
